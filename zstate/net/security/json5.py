"""Settings as JSON5 that people read and change, and that zenohd takes."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

WIDTH = 100

Settings = Mapping[str, object]

_STEP = "  "
_BARE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def json5_text(settings: Settings, comments: Mapping[str, str] | None = None, head: str = "") -> str:
    """``settings`` as a document, beginning with the comment ``head``.

    ``comments`` are keyed by the path of what they stand above, such as "connect/endpoints".
    """
    lines = _comment(head)
    lines += _value(settings, "", "", comments or {}).splitlines()
    return "\n".join(lines) + "\n"


def _comment(text: str, indent: str = "") -> list[str]:
    return [f"{indent}// {line}".rstrip() for line in text.splitlines()]


def _value(value: object, indent: str, path: str, comments: Mapping[str, str]) -> str:
    # A comment below, or too little room, and it takes a line for each of its parts.
    if not any(_is_below(path, commented) for commented in comments):
        short = _short(value)
        if len(indent) + len(short) < WIDTH:
            return short
    if isinstance(value, Mapping):
        return _object(value, indent, path, comments)  # pyright: ignore[reportUnknownArgumentType]
    if isinstance(value, Sequence) and not isinstance(value, str):
        inner = indent + _STEP
        elements = [f"{inner}{_value(element, inner, path, {})}," for element in value]  # pyright: ignore
        return "\n".join(["[", *elements, f"{indent}]"])
    return _short(value)


def _is_below(path: str, commented: str) -> bool:
    return commented.startswith(f"{path}/" if path else "") and commented != path


def _object(value: Settings, indent: str, path: str, comments: Mapping[str, str]) -> str:
    inner = indent + _STEP
    lines = ["{"]
    for key, member in value.items():
        below = f"{path}/{key}" if path else key
        lines += _comment(comments.get(below, ""), inner)
        lines.append(f"{inner}{_name(key)}: {_value(member, inner, below, comments)},")
    return "\n".join([*lines, f"{indent}}}"])


def _short(value: object) -> str:
    if isinstance(value, Mapping):
        members = [f"{_name(key)}: {_short(member)}" for key, member in value.items()]  # pyright: ignore
        return f"{{ {', '.join(members)} }}" if members else "{}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(_short(element) for element in value)}]"  # pyright: ignore
    return json.dumps(value, ensure_ascii=False)


def _name(key: str) -> str:
    return key if _BARE.fullmatch(key) else json.dumps(key)
