"""Tables of a file: loops unrolled, names filled in, conditions asked, and each checked."""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from zstate._util.suggestions import did_you_mean
from zstate.cli.up.sections import (
    NetworkSection,
    ProgramSection,
    RobotSection,
    RouterSection,
    StaticSection,
)
from zstate.cli.up.toml_file import TomlFile
from zstate.cli.up.values import Scope, holds
from zstate.errors import ConfigError, InvalidInput

SINGLE = ("router", "network")
LISTS = ("robot", "static", "program")
_LOOPED = ("robot", "program")
_OWN_KEYS = ("names", "count", "when")

Section = TypeVar("Section", RobotSection, StaticSection, ProgramSection, RouterSection, NetworkSection)


@dataclass(frozen=True, slots=True)
class Placed(Generic[Section]):
    """A table, and where it stands; ``turn`` counts the turns of a loop from 0."""

    section: Section
    file: TomlFile
    place: str
    turn: int = 0

    def error(self, text: str, key: str = "") -> ConfigError:
        """What is wrong with it, or with its ``key``."""
        return self.file.error(f"{self.place}.{key}" if key else self.place, text)

    def beside(self, path: str) -> str:
        """A path of the file, wherever `zstate up` is called."""
        return str(self.file.folder.resolve() / Path(path).expanduser())


def tables(file: TomlFile, kind: str, section: type[Section], scope: Scope) -> Iterator[Placed[Section]]:
    """The tables of that kind in ``file``, as often as their loops say. Raises ConfigError."""
    found = file.tables.get(kind, [])
    for number, table in enumerate([found] if kind in SINGLE and found != [] else found):
        place = f"{kind}[{number}]" if kind in LISTS else kind
        for turn, names in enumerate(_turns(file, place, table, scope)):
            inner = scope.with_names(names)
            if "name" in table:
                inner = inner.with_names(_filled(file, place, {"name": table["name"]}, inner))
            if _is_wanted(file, place, table, inner):
                own = {"name": inner.names["name"]} if {"name", "names"} & set(table) else {}
                rest = {key: value for key, value in table.items() if key not in (*_OWN_KEYS, "name")}
                values = {**_filled(file, place, rest, inner), **own}
                yield Placed(_converted(file, place, values, section), file, place, turn)


def _turns(file: TomlFile, place: str, table: dict[str, Any], scope: Scope) -> list[dict[str, Any]]:
    """What each turn of a loop adds to the names: ``name`` of ``names``, or ``number`` of ``count``."""
    if not {"names", "count"} & set(table):
        return [{}]
    if not place.startswith(_LOOPED):
        raise file.error(place, f"only {' and '.join(_LOOPED)} can be a loop of names or count")
    loop = _filled(file, place, {key: table[key] for key in ("names", "count") if key in table}, scope)
    if len(loop) > 1 or ("name" in table) is not ("count" in loop):
        raise file.error(place, "a loop is names = ['left', 'right'], or count = 3 and name = 'arm${number}'")
    if "names" in loop:
        names = loop["names"]
        listed = re.findall(r"[^\s,]+", names) if isinstance(names, str) else names
        return [{"name": name} for name in listed]
    if not str(loop["count"]).isdecimal():
        raise file.error(f"{place}.count", f"{loop['count']!r} is not how often")
    return [{"number": number} for number in range(1, int(loop["count"]) + 1)]


def _is_wanted(file: TomlFile, place: str, table: dict[str, Any], scope: Scope) -> bool:
    with _told_at(file, f"{place}.when"):
        return holds(scope.filled(table.get("when", True)))


def _filled(file: TomlFile, place: str, table: dict[str, Any], scope: Scope) -> dict[str, Any]:
    filled: dict[str, Any] = {}
    for key, value in table.items():
        with _told_at(file, f"{place}.{key}"):
            filled[key] = scope.filled(value)
    return filled


@contextmanager
def _told_at(file: TomlFile, place: str) -> Generator[None]:
    try:
        yield
    except InvalidInput as error:
        raise file.error(place, str(error)) from None


def _converted(file: TomlFile, place: str, values: dict[str, Any], section: type[Section]) -> Section:
    try:
        # Not strictly: what the environment and the command line say is text.
        return msgspec.convert(values, section, strict=False)
    except msgspec.ValidationError as error:
        text, _, inner = str(error).partition(" - at `$")
        unknown = re.search(r"unknown field `(.*)`", text)
        if unknown is None:
            raise file.error(f"{place}{inner.strip('`')}", text) from None
        known = (*section.__struct_fields__, *(_OWN_KEYS if place.startswith(_LOOPED) else ("when",)))
        hint = did_you_mean(unknown[1], known) or f"; there are {', '.join(known)}"
        raise file.error(f"{place}.{unknown[1]}", f"there is no such key{hint}") from None
