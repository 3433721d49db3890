"""A whole file of `zstate up`: every table, expanded and checked."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from zstate._util.format import did_you_mean
from zstate.cli.up.schema import (
    NetworkSection,
    ProgramSection,
    RobotSection,
    RouterSection,
    StaticSection,
)
from zstate.cli.up.template import Located, expand, valid_keys

_Section = TypeVar("_Section", RobotSection, StaticSection, ProgramSection, RouterSection, NetworkSection)


@dataclass(slots=True)
class Cell:
    """The tables of a file and of those it includes; its own router and network take precedence."""

    robot: list[Located[RobotSection]] = field(default_factory=list["Located[RobotSection]"])
    static: list[Located[StaticSection]] = field(default_factory=list["Located[StaticSection]"])
    program: list[Located[ProgramSection]] = field(default_factory=list["Located[ProgramSection]"])
    router: Located[RouterSection] | None = None
    network: Located[NetworkSection] | None = None


def read_cell(path: str, settings: Mapping[str, str] | None = None) -> Cell:
    """The file at ``path``, with ``settings`` for its parameters.

    Raises ConfigError with the file, the line, the table and the key.
    """
    cell = Cell()
    for kind, table in expand(Path(path), settings or {}):
        match kind:
            case "router":
                cell.router = _checked(kind, table, RouterSection)
            case "network":
                cell.network = _checked(kind, table, NetworkSection)
            case "robot":
                cell.robot.append(_checked(kind, table, RobotSection))
            case "static":
                cell.static.append(_checked(kind, table, StaticSection))
            case _:
                cell.program.append(_checked(kind, table, ProgramSection))
    return cell


def _checked(kind: str, table: Located[dict[str, Any]], section: type[_Section]) -> Located[_Section]:
    try:
        # Not strict: values from the environment and the command line are text.
        values = msgspec.convert(table.section, section, strict=False)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$")
        unknown = re.search(r"unknown field `(.*)`", text)
        if unknown is None:
            raise table.file.error(f"{table.place}{place.strip('`')}", text) from None
        valid = valid_keys(kind, section.__struct_fields__)
        hint = did_you_mean(unknown[1], valid) or f"; there are {', '.join(valid)}"
        raise table.error(f"there is no such key{hint}", unknown[1]) from None
    return Located(values, table.file, table.place, table.iteration)
