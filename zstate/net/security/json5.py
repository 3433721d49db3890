"""JSON5 text of nested settings, with comments, that zenohd reads."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

WIDTH = 100

Settings = Mapping[str, object]

_INDENT = "  "
_BARE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def json5_text(settings: Settings, comments: Mapping[str, str] | None = None, head: str = "") -> str:
    """``settings`` as a document that begins with the comment ``head``.

    ``comments`` are keyed by the path of the setting below them, such as "connect/endpoints".
    """
    return "\n".join([*_comment(head), *_value(settings, "", "", comments or {}).splitlines()]) + "\n"


def _comment(text: str, indent: str = "") -> list[str]:
    return [f"{indent}// {line}".rstrip() for line in text.splitlines()]


def _value(value: object, indent: str, path: str, comments: Mapping[str, str]) -> str:
    below = f"{path}/" if path else ""
    # One line per member if a comment is below, or if one line for all is too long.
    if not any(commented.startswith(below) and commented != path for commented in comments):
        short = _short(value)
        if len(indent) + len(short) < WIDTH:
            return short
    inner = indent + _INDENT
    if isinstance(value, Mapping):
        lines = ["{"]
        for key, member in value.items():  # pyright: ignore
            lines += _comment(comments.get(below + key, ""), inner)  # pyright: ignore
            lines.append(f"{inner}{_name(key)}: {_value(member, inner, below + key, comments)},")  # pyright: ignore
        return "\n".join([*lines, f"{indent}}}"])
    if isinstance(value, Sequence) and not isinstance(value, str):
        elements = [f"{inner}{_value(element, inner, path, {})}," for element in value]  # pyright: ignore
        return "\n".join(["[", *elements, f"{indent}]"])
    return _short(value)


def _short(value: object) -> str:
    if isinstance(value, Mapping):
        members = [f"{_name(key)}: {_short(member)}" for key, member in value.items()]  # pyright: ignore
        return f"{{ {', '.join(members)} }}" if members else "{}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(_short(element) for element in value)}]"  # pyright: ignore
    return json.dumps(value, ensure_ascii=False)


def _name(key: str) -> str:
    return key if _BARE_NAME.fullmatch(key) else json.dumps(key)
