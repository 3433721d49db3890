"""Text of panels as HTML. What comes out of the network is escaped, for a browser would run it.

Poses in numbers that a person reads.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

from zstate.se3 import rpy_from_quaternion

_BOX = "padding:0.1em 0.75em 0.4em 0.75em"  # as far from the edge as what the page itself puts there
_TABLE = "width:100%;border-collapse:collapse;font-size:0.8em;line-height:1.45"
_NUMBERS = "font-family:ui-monospace,Menlo,Consolas,monospace;white-space:pre-wrap;overflow-wrap:anywhere"
_MUTED = "opacity:0.65"

ALARM = "#c92a2a"
WARNING = "#b35c00"


def paragraph(text: str, *, color: str = "", muted: bool = False) -> str:
    """A few lines of plain text."""
    style = "font-size:0.8em;line-height:1.4;white-space:pre-line;overflow-wrap:anywhere"
    style += f";color:{color}" * bool(color) + f";{_MUTED}" * muted
    return _boxed(f'<div style="{style}">{escape(text)}</div>')


def heading(text: str, *, color: str = "") -> str:
    """What the following is about."""
    style = "font-size:0.85em;font-weight:600" + f";color:{color}" * bool(color)
    return f'<div style="{_BOX};padding-bottom:0"><span style="{style}">{escape(text)}</span></div>'


def pairs(rows: Iterable[tuple[str, str]]) -> str:
    """Names on the left, values on the right."""
    lines = (
        f'<tr><td style="{_MUTED};white-space:nowrap;padding-right:0.8em;vertical-align:top">{escape(name)}'
        f'</td><td style="{_NUMBERS}">{escape(value)}</td></tr>'
        for name, value in rows
    )
    return _boxed(f'<table style="{_TABLE}">{"".join(lines)}</table>')


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], colors: Sequence[str] = ()) -> str:
    """A table of plain texts; row i is written in ``colors[i]``, unless that is empty or not there."""
    cell = "padding:0.1em 0.5em 0.1em 0;vertical-align:top;overflow-wrap:anywhere"
    head = "".join(f'<th style="{cell};{_MUTED};text-align:left">{escape(text)}</th>' for text in headings)
    lines: list[str] = []
    for number, row in enumerate(rows):
        color = colors[number] if number < len(colors) else ""
        style = f' style="color:{color}"' if color else ""
        cells = "".join(f'<td style="{cell}">{escape(text)}</td>' for text in row)
        lines.append(f"<tr{style}>{cells}</tr>")
    return _boxed(f'<table style="{_TABLE}"><tr>{head}</tr>{"".join(lines)}</table>')


def _boxed(text: str) -> str:
    return f'<div style="{_BOX}">{text}</div>'


Rows = list[tuple[str, str]]


def pose_rows(pose7: Sequence[float]) -> Rows:
    """What there is to say of a pose, with the names of the numbers and their units."""
    x, y, z, qx, qy, qz, qw = pose7
    rpy = rpy_from_quaternion((qx, qy, qz, qw))
    return [
        ("xyz [m]", listed((x, y, z), 4)),
        ("distance [m]", digits(math.hypot(x, y, z), 4)),
        ("rpy [deg]", listed([math.degrees(angle) for angle in rpy], 2, width=7)),
        ("rpy [rad]", listed(rpy, 4)),
        ("quat xyzw", listed((qx, qy, qz, qw), 3)),
    ]


def listed(values: Sequence[float], precision: int, *, width: int = 0) -> str:
    """Numbers side by side, as wide whether or not they are negative; ``width`` is for larger ones."""
    return " ".join(f"{digits(value, precision):>{max(width, precision + 3)}}" for value in values)


def digits(value: float, precision: int) -> str:
    """A number with so many digits behind the point, and no negative zero."""
    return f"{round(value, precision) + 0.0:.{precision}f}"
