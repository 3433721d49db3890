"""Tables that notebooks show of values (``_repr_html_``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from html import escape
from typing import Any, cast

# Notebooks align cells to the right and collapse line breaks; a page of documentation leaves no room.
_CELL = 'style="text-align:left;white-space:pre-wrap;padding:0.1em 0.6em 0.1em 0"'


def html_of_fields(value: Any) -> str:
    """The fields of a dataclass that have a value, as HTML."""
    named = {field.name: getattr(value, field.name) for field in fields(value)}
    rows = [(name, _value_text(one)) for name, one in named.items() if one not in (None, "")]
    return html_table(type(value).__name__, rows)


def html_table(title: str, rows: Iterable[Sequence[str]], headings: Sequence[str] = ()) -> str:
    """Rows of plain texts as HTML, the first of each row being its name.

    Texts are escaped, because names come from the network. There are no colours, so that the table has
    those of the notebook's theme.
    """

    def line(cells: Sequence[str], heads: int) -> str:
        tags = ["th"] * heads + ["td"] * (len(cells) - heads)
        texts = map(escape, cells)
        return "".join(f"<{tag} {_CELL}>{text}</{tag}>" for tag, text in zip(tags, texts, strict=True))

    lines = [line(headings, len(headings))] * bool(headings) + [line(row, 1) for row in rows]
    body = "".join(f"<tr>{cells}</tr>" for cells in lines)
    table = f"<table><caption {_CELL}>{escape(title)}</caption>{body}</table>"
    return f'<div style="overflow-x:auto;font-size:0.9em">{table}</div>'


def _value_text(value: object) -> str:
    """A number with six digits, a line for each item of a mapping or tuple, and other values as printed."""
    if isinstance(value, Mapping):
        items = cast("Mapping[Any, Any]", value).items()
        return "\n".join(f"{_key_text(key)}: {one}" for key, one in items) or "none"
    if type(value) is tuple:
        return "\n".join(map(str, cast("tuple[object, ...]", value)))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _key_text(key: Any) -> str:
    return " ".join(map(str, key)) if isinstance(key, tuple) else str(key)  # pyright: ignore[reportUnknownArgumentType]
