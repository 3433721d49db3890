"""A snapshot as the text of a TOML or JSON file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any, cast

import msgspec

from zstate.cli.snapshot.snapshot import Snapshot

_HEAD = "# Robots as they were, by `zstate snapshot save`; `zstate snapshot load FILE` says it all again.\n"
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
# What a literal text of TOML may not hold; a carriage return would come back as something else.
_NOT_LITERAL = re.compile(r"'''|[\x00-\x08\x0b-\x1f\x7f]")


def json_text(snapshot: Snapshot) -> str:
    """As one JSON document."""
    return json.dumps(_fields(snapshot), indent=2) + "\n"


def toml_text(snapshot: Snapshot) -> str:
    """As TOML, the URDF as it is."""
    return _HEAD + "\n".join(_table_lines("", _fields(snapshot))) + "\n"


def _fields(snapshot: Snapshot) -> dict[str, Any]:
    return cast("dict[str, Any]", _without_nothing(msgspec.to_builtins(snapshot)))


def _without_nothing(value: Any) -> Any:
    """Without what is None, which TOML has not, and without what is empty."""
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        kept = {key: _without_nothing(inner) for key, inner in table.items()}
        return {key: inner for key, inner in kept.items() if inner not in (None, [], {})}
    if isinstance(value, list | tuple):
        return [_without_nothing(inner) for inner in cast("list[Any]", value)]
    return value


def _table_lines(place: str, table: dict[str, Any]) -> Iterator[str]:
    """Values first: after the header of another table they would belong to that."""
    for key, value in table.items():
        if not _is_table(value) and not _is_list_of_tables(value):
            yield f"{_key(key)} = {_value(value)}"
    for key, value in table.items():
        name = f"{place}.{key}".lstrip(".")
        if _is_table(value):
            yield f"\n[{name}]"
            yield from _table_lines(name, value)
        elif _is_list_of_tables(value):
            for inner in value:
                yield f"\n[[{name}]]"
                yield from _table_lines(name, inner)


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and all(map(_is_table, cast("list[Any]", value)))


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _basic(key)


def _value(value: Any) -> str:
    if isinstance(value, str):
        return f"'''\n{value}'''" if "\n" in value and not _NOT_LITERAL.search(value) else _basic(value)
    if isinstance(value, list):
        return f"[{', '.join(map(_value, cast('list[Any]', value)))}]"
    return repr(value)


def _basic(text: str) -> str:
    # The escapes of JSON are those of TOML, but for one character that JSON leaves as it is.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
