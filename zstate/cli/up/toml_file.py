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
        try:
            self._text = path.read_bytes().decode()
            self.tables: dict[str, Any] = tomllib.loads(self._text)
        except OSError as error:
            raise ConfigError(f"{self.shown!r} cannot be read: {error.strerror}", path=self.shown) from None
        except UnicodeDecodeError as error:
            raise ConfigError(f"{self.shown!r} is not UTF-8 text: {error.reason}", path=self.shown) from None
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
        headers = [_HEADER.match(line) for line in lines]
        tables = [at for at, one in enumerate(headers, 1) if one and one[1] == match["table"]]
        begin = next(iter(tables[int(match["number"] or 0) :]), None)
        key = match["table"] if begin is None else match["key"]
        for number in range(begin or 0, len(lines)):
            if headers[number]:
                break
            if key and re.match(rf"\s*{re.escape(key)}\s*[.=]", lines[number]):
                return number + 1
        return begin
