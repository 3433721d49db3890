"""Drawings of nodes and edges, written as SVG, for Graphviz (DOT) and for Markdown (Mermaid)."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.sax.saxutils import escape, quoteattr

from zstate.cli.output.layout import Point, layered_layout, tree_layout

FONT = "Inter, 'Helvetica Neue', Helvetica, Arial, 'DejaVu Sans', sans-serif"
INK, MUTED, LINE, PAPER, CARD, ALARM = "#1f2937", "#6b7280", "#9ca3af", "#ffffff", "#f9fafb", "#b91c1c"
PALETTE = ("#2563eb", "#d97706", "#059669", "#7c3aed", "#db2777", "#0891b2", "#65a30d", "#9f1239")

_NAME_SIZE, _TEXT_SIZE, _LEGEND_SIZE, _TITLE_SIZE = 13.0, 11.0, 12.0, 16.0
_MARGIN, _HEAD, _LEGEND_LINE = 20.0, 36.0, 18.0
_PAD, _BASELINE, _LINE_HEIGHT = 12.0, 16.0, 15.0
_DASHES = ' stroke-dasharray="4 3"'

# Widths in units of the font size, rather too wide: the viewer may have any of the fonts above.
_NARROW, _WIDE = frozenset("iljtfrI.,:;'|!()[]{}/ -"), frozenset("mwMW@%")
_BOLD = 1.05


@dataclass(frozen=True, slots=True)
class DrawnNode:
    """A box with lines of text, the first one bold.

    ``label`` is the text in DOT and Mermaid, by default the same lines; a ``bar`` is a filled left edge.
    """

    name: str
    lines: Sequence[str]
    label: str = ""
    rounded: bool = False
    stroke: str = LINE
    fill: str = CARD
    dashed: bool = False
    bar: bool = False
    text_color: str = MUTED

    @property
    def text(self) -> str:
        return self.label or "\n".join(self.lines)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in SVG."""
        widths = [text_width(line, _TEXT_SIZE) for line in self.lines[1:]]
        width = max(text_width(self.lines[0], _NAME_SIZE) * _BOLD, *widths, 0.0)
        return width + 2 * _PAD, _LINE_HEIGHT * len(self.lines) + 9.0


@dataclass(frozen=True, slots=True)
class DrawnEdge:
    """An edge from one node to another, by their names; its ``label`` is not in SVG."""

    start: str
    end: str
    label: str = ""
    stroke: str = LINE
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Drawing:
    """Nodes and edges. A "tree" is drawn from the top down, a "flow" from left to right with arrows.

    ``legend`` has (colour, text) pairs. ``name`` is that of the DOT graph.
    """

    name: str
    form: Literal["tree", "flow"]
    nodes: Sequence[DrawnNode]
    edges: Sequence[DrawnEdge]
    legend: Sequence[tuple[str, str]] = ()


def draw(drawing: Drawing, form: str, title: str) -> str:
    """The drawing as a file of this form: "svg", "dot" or "mermaid"; only SVG has the title."""
    if form == "svg":
        return svg(drawing, title)
    return dot(drawing) if form == "dot" else mermaid(drawing)


def svg(drawing: Drawing, title: str) -> str:
    """The drawing as an SVG file."""
    canvas = _Canvas()
    canvas.text(_MARGIN, _MARGIN + 12.0, title, size=_TITLE_SIZE, bold=True)
    top = _MARGIN + _HEAD
    for color, text in drawing.legend:
        canvas.box((_MARGIN, top - 15.0), (10.0, 10.0), fill=color, stroke=color, radius=2.0)
        canvas.text(_MARGIN + 18.0, top - 6.0, text, size=_LEGEND_SIZE, color=MUTED)
        top += _LEGEND_LINE

    is_tree = drawing.form == "tree"
    sizes = {node.name: node.size for node in drawing.nodes}
    layout = (tree_layout if is_tree else layered_layout)(
        sizes, [(one.start, one.end) for one in drawing.edges]
    )
    for edge in drawing.edges:
        points = [(x + _MARGIN, y + top) for x, y in layout.routes[edge.start, edge.end]]
        canvas.line(points, stroke=edge.stroke, dashed=edge.dashed, smooth=not is_tree)
        if not is_tree:
            canvas.arrowhead(points[-2], points[-1], edge.stroke)
    for node in drawing.nodes:
        x, y = layout.places[node.name][0] + _MARGIN, layout.places[node.name][1] + top
        width, height = sizes[node.name]
        radius = 14.0 if node.rounded else 5.0
        canvas.box(
            (x, y), (width, height), stroke=node.stroke, fill=node.fill, radius=radius, dashed=node.dashed
        )
        if node.bar:
            canvas.box((x, y), (4.0, height), fill=node.stroke, stroke=node.stroke, radius=2.0)
        name, *details = node.lines
        canvas.text(x + _PAD, y + _BASELINE, name, size=_NAME_SIZE, bold=True)
        for number, line in enumerate(details, 1):
            baseline = y + _BASELINE + _LINE_HEIGHT * number
            canvas.text(x + _PAD, baseline, line, size=_TEXT_SIZE, color=node.text_color)
    return canvas.file(title)


def dot(drawing: Drawing) -> str:
    """The drawing in the language of Graphviz."""

    def quoted(text: str) -> str:
        return json.dumps(text, ensure_ascii=False)

    lines = [f"digraph {drawing.name} {{", "  node [shape=box];"]
    if drawing.form == "flow":
        lines.insert(1, "  rankdir=LR;")
    for node in drawing.nodes:
        attributes = ["shape=ellipse"] * node.rounded
        attributes += [f"label={quoted(node.text)}"] * (node.text != node.name)
        suffix = f" [{', '.join(attributes)}]" if attributes else ""
        lines.append(f"  {quoted(node.name)}{suffix};")
    for edge in drawing.edges:
        label = f" [label={quoted(edge.label)}]" if edge.label else ""
        lines.append(f"  {quoted(edge.start)} -> {quoted(edge.end)}{label};")
    return "\n".join([*lines, "}"])


def mermaid(drawing: Drawing) -> str:
    """The drawing in the language of Mermaid."""
    numbers = {node.name: f"n{number}" for number, node in enumerate(drawing.nodes)}
    lines = ["graph TD" if drawing.form == "tree" else "graph LR"]
    for node in drawing.nodes:
        label = node.text.replace("#", "#35;").replace('"', "#quot;").replace("\n", "<br>")
        lines.append(f"  {numbers[node.name]}" + (f'(["{label}"])' if node.rounded else f'["{label}"]'))
    for edge in drawing.edges:
        label = f"|{edge.label}|" if edge.label else ""
        lines.append(f"  {numbers[edge.start]} -->{label} {numbers[edge.end]}")
    return "\n".join(lines)


def text_width(text: str, size: float) -> float:
    """About the greatest width of ``text`` in the fonts of the drawings."""
    width = 0.0
    for letter in text:
        if letter in _NARROW:
            width += 0.40
        elif letter in _WIDE or unicodedata.east_asian_width(letter) in "WF":
            width += 1.0
        else:
            width += 0.72 if letter.isupper() else 0.62
    return size * width


def _number(value: float) -> str:
    return f"{round(value, 1):g}"


class _Canvas:
    """SVG shapes, and the extent of what was drawn."""

    def __init__(self) -> None:
        self._shapes: list[str] = []
        self._right = self._bottom = 0.0

    def box(
        self,
        corner: Point,
        size: tuple[float, float],
        *,
        stroke: str,
        fill: str,
        radius: float,
        dashed: bool = False,
    ) -> None:
        values = zip(("x", "y", "width", "height", "rx"), (*corner, *size, radius), strict=True)
        place = " ".join(f'{name}="{_number(value)}"' for name, value in values)
        self._shapes.append(f'<rect {place} fill="{fill}" stroke="{stroke}"{_DASHES * dashed}/>')
        self._extend(corner[0] + size[0], corner[1] + size[1])

    def text(
        self, x: float, y: float, text: str, *, size: float, color: str = INK, bold: bool = False
    ) -> None:
        """A line of text whose baseline starts at (x, y)."""
        weight = ' font-weight="600"' if bold else ""
        self._shapes.append(
            f'<text x="{_number(x)}" y="{_number(y)}" font-size="{_number(size)}" fill="{color}"{weight}>'
            f"{escape(text)}</text>"
        )
        self._extend(x + text_width(text, size), y + size / 3)

    def line(self, points: Sequence[Point], *, stroke: str, dashed: bool, smooth: bool) -> None:
        """A line through ``points``; a smooth one leaves and enters each of them horizontally."""
        at = [f"{_number(x)} {_number(y)}" for x, y in points]
        path = f"M{at[0]}"
        for (before, _), (after, _), start, end in zip(points, points[1:], at, at[1:], strict=False):
            middle = _number((before + after) / 2)
            path += f"C{middle} {start.split()[1]} {middle} {end.split()[1]} {end}" if smooth else f"L{end}"
        self._shapes.append(
            f'<path d="{path}" fill="none" stroke="{stroke}" stroke-width="1.4"{_DASHES * dashed}/>'
        )
        for x, y in points:
            self._extend(x, y)

    def arrowhead(self, before: Point, tip: Point, color: str) -> None:
        # A path: some programs do not draw the markers of SVG.
        back = tip[0] + (-7.0 if before[0] <= tip[0] else 7.0)
        corners = (tip, (back, tip[1] - 4.0), (back, tip[1] + 4.0))
        path = "L".join(f"{_number(x)} {_number(y)}" for x, y in corners)
        self._shapes.append(f'<path d="M{path}Z" fill="{color}"/>')

    def _extend(self, x: float, y: float) -> None:
        self._right, self._bottom = max(self._right, x), max(self._bottom, y)

    def file(self, title: str) -> str:
        """The SVG file, with a margin around all shapes."""
        width, height = _number(self._right + _MARGIN), _number(self._bottom + _MARGIN)
        return "\n".join(
            [
                f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
                f'viewBox="0 0 {width} {height}" font-family={quoteattr(FONT)} role="img">',
                f"<title>{escape(title)}</title>",
                f'<rect width="{width}" height="{height}" fill="{PAPER}"/>',
                *self._shapes,
                "</svg>",
            ]
        )
