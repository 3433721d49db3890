"""Svg: the few shapes that the pictures are made of."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from typing import Literal
from xml.sax.saxutils import escape, quoteattr

Point = tuple[float, float]

FONT = "Inter, 'Helvetica Neue', Helvetica, Arial, 'DejaVu Sans', sans-serif"
INK, MUTED, LINE, PAPER, CARD, ALARM = "#1f2937", "#6b7280", "#9ca3af", "#ffffff", "#f9fafb", "#b91c1c"
WRITERS = ("#2563eb", "#d97706", "#059669", "#7c3aed", "#db2777", "#0891b2", "#65a30d", "#9f1239")

# Widths in units of the font's size, rather too wide: of the fonts above, whichever is there is used.
_NARROW, _WIDE = frozenset("iljtfrI.,:;'|!()[]{}/ -"), frozenset("mwMW@%")


def text_width(text: str, size: float) -> float:
    """About how wide ``text`` is at most, in the fonts that pictures use."""
    return size * sum(map(_letter_width, text))


def _letter_width(letter: str) -> float:
    if letter in _NARROW:
        return 0.40
    if letter in _WIDE or unicodedata.east_asian_width(letter) in "WF":
        return 1.0
    return 0.72 if letter.isupper() else 0.62


def _number(value: float) -> str:
    return f"{round(value, 1):g}"


class Svg:
    """A picture that grows as things are drawn into it; ``text`` is its file."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._shapes: list[str] = []
        self._right = self._bottom = 0.0

    def box(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        *,
        stroke: str = LINE,
        fill: str = CARD,
        radius: float = 5.0,
        dashed: bool = False,
    ) -> None:
        """A rectangle with round corners."""
        place = " ".join(
            f'{name}="{_number(value)}"'
            for name, value in (("x", x), ("y", y), ("width", width), ("height", height), ("rx", radius))
        )
        self._add(f'<rect {place} fill="{fill}" stroke="{stroke}"{_DASHES if dashed else ""}/>')
        self._reach(x + width, y + height)

    def words(
        self,
        x: float,
        y: float,
        text: str,
        *,
        size: float = 12.0,
        color: str = INK,
        bold: bool = False,
    ) -> None:
        """A line of text whose baseline begins at (x, y)."""
        weight = ' font-weight="600"' if bold else ""
        self._add(
            f'<text x="{_number(x)}" y="{_number(y)}" font-size="{_number(size)}" fill="{color}"{weight}>'
            f"{escape(text)}</text>"
        )
        self._reach(x + text_width(text, size), y + size / 3)

    def line(
        self,
        points: Sequence[Point],
        *,
        stroke: str = LINE,
        dashed: bool = False,
        shape: Literal["straight", "smooth"] = "straight",
        arrow: bool = False,
    ) -> None:
        """A line through ``points``; a smooth one leaves and enters each of them horizontally."""
        at = [f"{_number(x)} {_number(y)}" for x, y in points]
        path = f"M{at[0]}"
        for (before, _), (after, _), begin, end in zip(points, points[1:], points, at[1:], strict=False):
            middle = _number((before + after) / 2)
            bend = f"C{middle} {_number(begin[1])} {middle} {end.split()[1]} {end}"
            path += bend if shape == "smooth" else f"L{end}"
        self._add(f'<path d="{path}" fill="none" stroke="{stroke}" stroke-width="1.4"{_DASHES * dashed}/>')
        if arrow:
            self._arrow(points[-2], points[-1], stroke)
        for x, y in points:
            self._reach(x, y)

    def _arrow(self, before: Point, tip: Point, color: str) -> None:
        # Markers are left out by some programs that show SVG.
        back = -7.0 if before[0] <= tip[0] else 7.0
        corners = ((tip[0], tip[1]), (tip[0] + back, tip[1] - 4.0), (tip[0] + back, tip[1] + 4.0))
        self._add(
            f'<path d="M{"L".join(f"{_number(x)} {_number(y)}" for x, y in corners)}Z" fill="{color}"/>'
        )

    def _add(self, shape: str) -> None:
        self._shapes.append(shape)

    def _reach(self, x: float, y: float) -> None:
        self._right, self._bottom = max(self._right, x), max(self._bottom, y)

    def text(self, margin: float) -> str:
        """All of it, with ``margin`` beyond what reaches farthest."""
        width, height = _number(self._right + margin), _number(self._bottom + margin)
        return "\n".join(
            [
                f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
                f'viewBox="0 0 {width} {height}" font-family={quoteattr(FONT)} role="img">',
                f"<title>{escape(self._title)}</title>",
                f'<rect width="{width}" height="{height}" fill="{PAPER}"/>',
                *self._shapes,
                "</svg>",
            ]
        )


_DASHES = ' stroke-dasharray="4 3"'
