"""A TOML file as written, and where in it something is wrong."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from zstate.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_PLACE = re.compile(r"(?P<table>\w+)(?:\[(?P<number>\d+)\])?(?:\.(?P<key>[\w-]+))?")
_HEADER = re.compile(r"\s*\[\[?\s*([\w-]+)")


class TomlFile:
    """One file: its ``tables`` as TOML has them, and ``shown``, what messages call it.

    Raises ConfigError for what cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.shown = str(path)
        self.folder = path.parent
        self._text = self._read()
        try:
            self.tables: dict[str, Any] = tomllib.loads(self._text)
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{self.shown} is not TOML: {error}", path=self.shown) from None

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
        begin = self._header_line(match["table"], int(match["number"] or 0), lines)
        key = match["table"] if begin is None else match["key"]
        for number, line in enumerate(lines[begin or 0 :], (begin or 0) + 1):
            if _HEADER.match(line):
                break
            if key and re.match(rf"\s*{re.escape(key)}\s*[.=]", line):
                return number
        return begin

    @staticmethod
    def _header_line(table: str, number: int, lines: list[str]) -> int | None:
        headers = (_HEADER.match(line) for line in lines)
        begins = [at for at, header in enumerate(headers, 1) if header and header[1] == table]
        return begins[number] if number < len(begins) else None

    def _read(self) -> str:
        try:
            return self.path.read_bytes().decode()
        except OSError as error:
            raise ConfigError(f"{self.shown!r} cannot be read: {error.strerror}", path=self.shown) from None
        except UnicodeDecodeError as error:
            raise ConfigError(f"{self.shown!r} is not UTF-8 text: {error.reason}", path=self.shown) from None
