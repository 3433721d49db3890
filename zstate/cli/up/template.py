"""TOML files with the template features of `zstate up`, expanded in one pass before tables are checked.

These are ``include``, ``[parameters]``, ``${NAME}``, the loops ``names`` and ``count``, and ``when``.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from zstate._util.format import did_you_mean
from zstate.cli.commands import load_other_command, own_commands
from zstate.errors import ConfigError, InvalidInput

SINGLE = ("router", "network")
NO_LOOPS = (*SINGLE, "static")
LOOP_KEYS = ("names", "count", "when")

# Commands that are no tables, and why.
_NO_TABLES = {
    "up": 'include = ["FILE.toml"] starts the processes of another file',
    "demo": 'it starts processes of its own; [[robot]] with source = "sine" is a robot that moves',
    "init": "it writes a file, which `zstate up` then runs",
    "completion": "it is for a shell",
    "robots": "it prints names of models; a robot is [[robot]]",
    "wait": "its NAMEs would be the names of a loop; write [[program]] with run = 'zstate wait ...'",
}

_PLACE = re.compile(r"(?P<table>\w+)(?:\[(?P<number>\d+)\])?(?:\.(?P<key>[\w/-]+))?(?:\.(?P<inner>[\w-]+))?")
_HEADER = re.compile(r"\s*\[\[?\s*([\w./-]+)")
_REFERENCE = re.compile(r"\$?\$\{(?P<name>[^{}:]*)(?::-(?P<default>[^{}]*))?\}")
_TRUE = ("true", "yes", "on", "1")
_FALSE = ("false", "no", "off", "0", "")

Section = TypeVar("Section")


class TomlFile:
    """One file: its ``tables`` as TOML has them, and ``shown``, what messages call it.

    Raises ConfigError for what cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.shown = str(path)
        self.folder = path.parent
        try:
            self._text = path.read_bytes().decode()
            self.tables: dict[str, Any] = tomllib.loads(self._text)
        except OSError as error:
            raise ConfigError(f"{self.shown!r} cannot be read: {error.strerror}", path=self.shown) from None
        except UnicodeDecodeError as error:
            raise ConfigError(f"{self.shown!r} is not UTF-8 text: {error.reason}", path=self.shown) from None
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{self.shown} is not TOML: {error}", path=self.shown) from None
        except RecursionError:
            text = f"{self.shown} cannot be read: its brackets are nested too deeply"
            raise ConfigError(text, path=self.shown) from None

    def error(self, place: str, text: str) -> ConfigError:
        """What is wrong at ``place``, such as "robot[1].rate", with its line."""
        line = self.line(place)
        where = self.shown if line is None else f"{self.shown}:{line}"
        return ConfigError(f"{where}: {place}: {text}" if place else f"{where}: {text}", path=place)

    def line(self, place: str) -> int | None:
        """The line of that key, else of its table; None where the file does not show it as usual."""
        match = _PLACE.match(place)
        if match is None:
            return None
        lines = self._text.splitlines()
        headers = [_HEADER.match(line.replace('"', "")) for line in lines]
        table, key = match["table"], match["key"]
        if any(
            one and one[1] == f"{table}.{key}" for one in headers
        ):  # [velocity.wheels], [relative."pose/camera"]
            table, key = f"{table}.{key}", match["inner"]
        tables = [at for at, one in enumerate(headers, 1) if one and one[1] == table]
        begin = next(iter(tables[int(match["number"] or 0) :]), None)
        key = table if begin is None else key
        for number in range(begin or 0, len(lines)):
            if headers[number]:
                break
            if key and re.match(rf"\s*{re.escape(key)}\s*[.=]", lines[number]):
                return number + 1
        return begin


@dataclass(frozen=True, slots=True)
class Located(Generic[Section]):
    """A table and its position in a file; ``iteration`` counts the iterations of its loop from 0."""

    section: Section
    file: TomlFile
    place: str
    iteration: int = 0

    def error(self, text: str, key: str = "") -> ConfigError:
        """An error of the table, or of its ``key``."""
        return self.file.error(f"{self.place}.{key}" if key else self.place, text)

    def resolve(self, path: str) -> str:
        """A path relative to the file."""
        return str(self.file.folder.resolve() / Path(path).expanduser())


def substitute(value: Any, variables: Mapping[str, Any]) -> Any:
    """Replace ``${NAME}`` in ``value`` by the variables, or else by the environment.

    A text that is only a reference takes the type of its value. ``${NAME:-DEFAULT}`` is DEFAULT if NAME is
    unset or empty, ``$${`` is ``${``. Raises InvalidInput if a name is unknown.
    """
    if isinstance(value, dict):
        return {key: substitute(inner, variables) for key, inner in cast("dict[str, Any]", value).items()}
    if isinstance(value, list):
        return [substitute(inner, variables) for inner in cast("list[Any]", value)]
    if not isinstance(value, str):
        return value
    reference = _REFERENCE.fullmatch(value)
    if reference is not None and not value.startswith("$$"):
        return _referenced(reference, variables)

    def text(reference: re.Match[str]) -> str:
        if reference[0].startswith("$$"):
            return reference[0][1:]
        part = _referenced(reference, variables)
        if not isinstance(part, str | int | float):
            raise InvalidInput(f"${{{reference['name']}}} is {part!r}, which cannot be a part of a text")
        return str(part).lower() if isinstance(part, bool) else str(part)

    return _REFERENCE.sub(text, value)


def _referenced(reference: re.Match[str], variables: Mapping[str, Any]) -> Any:
    name, default = reference["name"].strip(), reference["default"]
    value = variables.get(name, os.environ.get(name))
    if default is not None and value in (None, ""):
        return default
    if value is None:
        raise InvalidInput(
            f"${{{name}}} is neither a parameter nor set in the environment"
            f"{did_you_mean(name, variables)}; ${{{name}:-DEFAULT}} would have a default"
        )
    return value


def expand(path: Path, settings: Mapping[str, str]) -> Iterator[tuple[str, Located[dict[str, Any]]]]:
    """The kind and the plain values of every table of a file and of those it includes.

    Included files come first; ``settings`` override parameters. Raises ConfigError with the position.
    """
    files = list(_with_includes(TomlFile(path), (), set()))
    for file in files:
        for name, value in file.tables.items():
            _check_table(file, name, value)
    variables = _parameters(files, settings)
    for file in files:
        for kind, value in file.tables.items():
            if kind in SINGLE:
                yield from _iterations(kind, Located(value, file, kind), variables)
            elif kind not in ("include", "parameters"):
                for number, table in enumerate(value):
                    yield from _iterations(kind, Located(table, file, f"{kind}[{number}]"), variables)


def _check_table(file: TomlFile, name: str, value: Any) -> None:
    """Raise ConfigError unless ``name`` is a table, in its form, or a command that may be one."""
    if name == "include":
        return
    commands = [one for one in own_commands() if one not in _NO_TABLES]
    known = ("robot", "program", "network", "parameters", *commands)
    if name in _NO_TABLES:
        raise file.error(name, f"`zstate {name}` cannot be a table: {_NO_TABLES[name]}")
    if name not in known and load_other_command(name) is None:
        raise file.error(name, f"there is no such table{did_you_mean(name, known)}")
    is_list = name not in (*SINGLE, "parameters")
    tables = cast("list[Any]", value if isinstance(value, list) else [value])
    if isinstance(value, list) is not is_list or not all(isinstance(one, dict) for one in tables):
        brackets = f"[[{name}]]" if is_list else f"[{name}]"
        raise file.error(name, f"write {brackets}, and below it key = value")


def parse_settings(texts: Sequence[str]) -> dict[str, str]:
    """Parameters as ``KEY=VALUE`` on a command line. Raises InvalidInput."""
    settings: dict[str, str] = {}
    for text in texts:
        key, sign, value = text.partition("=")
        if not sign or not key.strip():
            raise InvalidInput(f"{text!r} is not a parameter; write KEY=VALUE, such as speed=2")
        if key.endswith(":"):
            raise InvalidInput(f"{text!r} is written as for ROS; here it is {key[:-1]}={value}")
        settings[key.strip()] = value
    return settings


def evaluate_condition(condition: object) -> bool:
    """The value of ``when``: true, false, or ``A == B`` or ``A != B`` of texts. Raises InvalidInput."""
    if isinstance(condition, bool):
        return condition
    text = str(condition).strip()
    for sign, is_equality in (("==", True), ("!=", False)):
        left, found, right = (part.strip().strip("'\"") for part in text.partition(sign))
        if found:
            return (left == right) is is_equality
    if text.lower() not in _TRUE + _FALSE:
        raise InvalidInput(f"{text!r} is neither true nor false; write one of these, 'A == B' or 'A != B'")
    return text.lower() in _TRUE


def _with_includes(file: TomlFile, above: tuple[Path, ...], read: set[Path]) -> Iterator[TomlFile]:
    """``file`` after the files that it includes, each once; ``read`` holds the paths of those read so far."""
    chain = (*above, file.path.resolve())
    includes = file.tables.get("include", [])
    for name in [includes] if isinstance(includes, str) else includes:
        with _error_at(file, "include"):
            path = file.folder / Path(str(substitute(name, {}))).expanduser()
        if path.resolve() in chain:
            raise file.error("include", f"{name!r} includes this file again")
        if not path.is_file():
            raise file.error("include", f"there is no file {str(path)!r}")
        if path.resolve() not in read:
            read.add(path.resolve())
            yield from _with_includes(TomlFile(path), chain, read)
    yield file


def _parameters(files: Sequence[TomlFile], settings: Mapping[str, str]) -> dict[str, Any]:
    """The parameters of all files, later ones first; a setting needs the type of its parameter."""
    declared: dict[str, tuple[TomlFile, Any]] = {
        name: (file, value) for file in files for name, value in file.tables.get("parameters", {}).items()
    }
    for name in settings:
        if name not in declared:
            known = ", ".join(declared) or "none"
            text = f"has no parameter {name!r}{did_you_mean(name, declared)}; its [parameters]: {known}"
            raise ConfigError(f"{files[-1].shown} {text}", path=f"parameters.{name}")
    variables: dict[str, Any] = {}
    for name, (file, value) in declared.items():
        with _error_at(file, f"parameters.{name}"):
            is_set = name in settings
            variables[name] = _parsed_like(value, settings[name]) if is_set else substitute(value, variables)
    return variables


def _parsed_like(value: object, text: str) -> Any:
    """``text`` as a value of the type of ``value``."""
    if isinstance(value, str):
        return text
    try:
        parsed = tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        parsed = None
    types = (int, float) if type(value) in (int, float) else (type(value),)
    if type(parsed) not in types:
        raise InvalidInput(f"it is {value!r} in the file, and {text!r} is not of that type")
    return parsed


def _iterations(
    kind: str, table: Located[dict[str, Any]], variables: Mapping[str, Any]
) -> Iterator[tuple[str, Located[dict[str, Any]]]]:
    """The table with plain values, once for each iteration of its loop whose condition holds."""
    keys, file, place = table.section, table.file, table.place
    for iteration, loop_variables in enumerate(_loop_variables(kind, table, variables)):
        inner = {**variables, **loop_variables}
        if "name" in keys:
            inner |= _substituted(table, {"name": keys["name"]}, inner)
        with _error_at(file, f"{place}.when"):
            is_enabled = evaluate_condition(substitute(keys.get("when", True), inner))
        if is_enabled:
            rest = {key: value for key, value in keys.items() if key not in (*LOOP_KEYS, "name")}
            values = _substituted(table, rest, inner)
            if "name" in keys or "names" in keys:
                values["name"] = inner["name"]
            yield kind, Located(values, file, place, iteration)


def _loop_variables(
    kind: str, table: Located[dict[str, Any]], variables: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """The variables of each iteration: ``name`` from ``names``, or ``number`` from ``count``."""
    loop = {key: table.section[key] for key in ("names", "count") if key in table.section}
    if not loop:
        return [{}]
    if kind in NO_LOOPS:
        raise table.error(f"a loop of names or count starts processes; {kind} cannot be one")
    loop = _substituted(table, loop, variables)
    if len(loop) > 1 or ("name" in table.section) is not ("count" in loop):
        raise table.error("a loop is names = ['left', 'right'], or count = 3 and name = 'arm${number}'")
    if "names" in loop:
        names = loop["names"]
        listed = re.findall(r"[^\s,]+", names) if isinstance(names, str) else names
        return [{"name": name} for name in listed]
    if not str(loop["count"]).isdecimal():
        raise table.error(f"{loop['count']!r} is not a count", "count")
    return [{"number": number} for number in range(1, int(loop["count"]) + 1)]


def _substituted(
    table: Located[dict[str, Any]], values: Mapping[str, Any], variables: Mapping[str, Any]
) -> dict[str, Any]:
    substituted: dict[str, Any] = {}
    for key, value in values.items():
        with _error_at(table.file, f"{table.place}.{key}"):
            substituted[key] = substitute(value, variables)
    return substituted


@contextmanager
def _error_at(file: TomlFile, place: str) -> Generator[None]:
    """Adds the position to an InvalidInput."""
    try:
        yield
    except InvalidInput as error:
        raise file.error(place, str(error)) from None
