"""Panel text as HTML. Text from the network is escaped, because a browser would run it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from itertools import chain, repeat

from zstate.se3 import rpy_from_quaternion

_BOX = "padding:0.1em 0.75em 0.4em 0.75em"  # the margin of the page's own widgets
_TABLE = "width:100%;border-collapse:collapse;font-size:0.8em;line-height:1.45"
_NUMBERS = "font-family:ui-monospace,Menlo,Consolas,monospace;white-space:pre-wrap;overflow-wrap:anywhere"
_MUTED = "opacity:0.65"

ALARM = "#c92a2a"
WARNING = "#b35c00"

Rows = list[tuple[str, str]]


def paragraph(text: str, *, color: str = "", muted: bool = False) -> str:
    """Lines of plain text."""
    style = "font-size:0.8em;line-height:1.4;white-space:pre-line;overflow-wrap:anywhere"
    style += f";color:{color}" * bool(color) + f";{_MUTED}" * muted
    return _boxed(f'<div style="{style}">{escape(text)}</div>')


def heading(text: str, *, color: str = "") -> str:
    """A section heading."""
    style = "font-size:0.85em;font-weight:600" + f";color:{color}" * bool(color)
    return f'<div style="{_BOX};padding-bottom:0"><span style="{style}">{escape(text)}</span></div>'


def pairs(rows: Iterable[tuple[str, str]]) -> str:
    """A table of names and values."""
    lines = (
        f'<tr><td style="{_MUTED};white-space:nowrap;padding-right:0.8em;vertical-align:top">{escape(name)}'
        f'</td><td style="{_NUMBERS}">{escape(value)}</td></tr>'
        for name, value in rows
    )
    return _boxed(f'<table style="{_TABLE}">{"".join(lines)}</table>')


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], colors: Sequence[str] = ()) -> str:
    """A table of plain texts; row i has the colour ``colors[i]``, unless it is empty or missing."""
    cell = "padding:0.1em 0.5em 0.1em 0;vertical-align:top;overflow-wrap:anywhere"
    head = "".join(f'<th style="{cell};{_MUTED};text-align:left">{escape(text)}</th>' for text in headings)
    lines: list[str] = []
    for row, color in zip(rows, chain(colors, repeat("")), strict=False):
        style = f' style="color:{color}"' if color else ""
        cells = "".join(f'<td style="{cell}">{escape(text)}</td>' for text in row)
        lines.append(f"<tr{style}>{cells}</tr>")
    return _boxed(f'<table style="{_TABLE}"><tr>{head}</tr>{"".join(lines)}</table>')


def _boxed(text: str) -> str:
    return f'<div style="{_BOX}">{text}</div>'


def pose_rows(pose7: Sequence[float]) -> Rows:
    """Position, distance and rotation of a pose, with names and units."""
    x, y, z, qx, qy, qz, qw = pose7
    rpy = rpy_from_quaternion((qx, qy, qz, qw))
    return [
        ("xyz [m]", format_row((x, y, z), 4)),
        ("distance [m]", format_number(math.hypot(x, y, z), 4)),
        ("rpy [deg]", format_row([math.degrees(angle) for angle in rpy], 2, width=7)),
        ("rpy [rad]", format_row(rpy, 4)),
        ("quat xyzw", format_row((qx, qy, qz, qw), 3)),
    ]


def format_row(values: Sequence[float], precision: int, *, width: int = 0) -> str:
    """Numbers side by side, with room for a sign; ``width`` is the least width of each."""
    return " ".join(f"{format_number(value, precision):>{max(width, precision + 3)}}" for value in values)


def format_number(value: float, precision: int) -> str:
    """A number with ``precision`` decimals, and no negative zero."""
    return f"{round(value, precision) + 0.0:.{precision}f}"
