"""A whole file of `zstate up`: includes and parameters resolved, every table checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from zstate._util.suggestions import did_you_mean
from zstate.cli.up.parameters import parameter_scope
from zstate.cli.up.sections import (
    NetworkSection,
    ProgramSection,
    RobotSection,
    RouterSection,
    StaticSection,
)
from zstate.cli.up.tables import LISTS, SINGLE, Placed, tables
from zstate.cli.up.toml_file import TomlFile
from zstate.cli.up.values import Scope
from zstate.errors import InvalidInput

_KNOWN = (*LISTS, *SINGLE, "parameters", "include")


@dataclass(slots=True)
class Cell:
    """What a file and those it includes say; of a router or network said twice the including file's."""

    robot: list[Placed[RobotSection]] = field(default_factory=list["Placed[RobotSection]"])
    static: list[Placed[StaticSection]] = field(default_factory=list["Placed[StaticSection]"])
    program: list[Placed[ProgramSection]] = field(default_factory=list["Placed[ProgramSection]"])
    router: Placed[RouterSection] | None = None
    network: Placed[NetworkSection] | None = None


def read_cell(path: str, settings: Mapping[str, str] | None = None) -> Cell:
    """The file at ``path``, with ``settings`` for its parameters.

    Raises ConfigError naming the file, the line, the table and the key.
    """
    files = list(_with_includes(TomlFile(Path(path)), (), set()))
    for file in files:
        _check_names(file)
    scope = parameter_scope(files, settings or {})
    cell = Cell()
    for file in files:
        cell.router = next(tables(file, "router", RouterSection, scope), cell.router)
        cell.network = next(tables(file, "network", NetworkSection, scope), cell.network)
        cell.robot += tables(file, "robot", RobotSection, scope)
        cell.static += tables(file, "static", StaticSection, scope)
        cell.program += tables(file, "program", ProgramSection, scope)
    return cell


def _with_includes(file: TomlFile, above: tuple[Path, ...], read: set[Path]) -> Iterator[TomlFile]:
    """The files that ``file`` includes, each once and before whoever includes it; ``read`` is their paths."""
    chain = (*above, file.path.resolve())
    includes = file.tables.get("include", [])
    for name in [includes] if isinstance(includes, str) else includes:
        try:
            path = file.folder / Path(str(Scope({}).filled(name))).expanduser()
        except InvalidInput as error:
            raise file.error("include", str(error)) from None
        if path.resolve() in chain:
            raise file.error("include", f"{name!r} includes this file again")
        if not path.is_file():
            raise file.error("include", f"there is no file {str(path)!r}")
        if path.resolve() not in read:
            read.add(path.resolve())
            yield from _with_includes(TomlFile(path), chain, read)
    yield file


def _check_names(file: TomlFile) -> None:
    for name, value in file.tables.items():
        if name not in _KNOWN:
            raise file.error(name, f"there is no such table{did_you_mean(name, _KNOWN)}")
        is_right = _is_list_of_tables(value) if name in LISTS else isinstance(value, dict)
        if name != "include" and not is_right:
            brackets = f"[[{name}]]" if name in LISTS else f"[{name}]"
            raise file.error(name, f"write {brackets}, and below it key = value")


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, dict) for one in cast("list[Any]", value))
