"""Cards: where the nodes of a tree stand, from the top down, on a page that is not too wide.

Side by side, the leaves of a humanoid would take ten screens. So each node has several ways to be drawn:
its children beside each other below it, or under each other along a rail, or those without children along
a rail beside the others. Of all combinations those are kept that no other one beats in both width and
height, from the leaves up; of those of the root the one that fits the smallest page is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Literal

ACROSS, BELOW, INDENT, STACKED = 14.0, 22.0, 22.0, 7.0
"""Between neighbours, below a parent, right of it along a rail, and between those on a rail."""

RAIL = 9.0
"""Where a rail runs, right of its parent's left edge."""

_WAYS = 24
_SHAPE = 1.6
_APART = 40.0


@dataclass(frozen=True, slots=True)
class Card:
    """A node in its place, and its ``parent``: joined along a rail at the x of ``rail``, or from above."""

    name: str
    x: float
    y: float
    width: float
    height: float
    parent: str | None
    rail: float | None


@dataclass(frozen=True, slots=True)
class _Way:
    """One way to draw a subtree: how large it becomes, and where its own card stands in it.

    A ``name`` of None is no node, but children of one that share a rail.
    """

    name: str | None
    width: float
    height: float
    card: tuple[float, float, float]
    form: Literal["across", "rail"]
    parts: tuple[_Way, ...]

    @property
    def anchor(self) -> float:
        """Where the line from above arrives."""
        x, width, _ = self.card
        return x + width / 2


def cards(
    roots: Sequence[str], children: Mapping[str, Sequence[str]], size_of: Callable[[str], tuple[float, float]]
) -> list[Card]:
    """A place for each node of the trees, parents first, beginning at (0, 0)."""
    trees = [min(_ways(root, children, size_of), key=_page) for root in roots]
    area = sum((way.width + _APART) * (way.height + _APART) for way in trees)
    page_width = max([sqrt(area * _SHAPE), *(way.width for way in trees)])
    placed: list[Card] = []
    x = y = row_height = 0.0
    for way in trees:
        if x and x + way.width > page_width:
            x, y, row_height = 0.0, y + row_height + _APART, 0.0
        placed += _placed(way, x, y)
        x, row_height = x + way.width + _APART, max(row_height, way.height)
    return placed


def _page(way: _Way) -> tuple[float, float]:
    """How high the page must be that it fits on, and how wide it is."""
    return max(way.width / _SHAPE, way.height), way.width


def _highest(row: Sequence[_Way]) -> float:
    return max(way.height for way in row)


def _rows_of(ways: Sequence[Sequence[_Way]]) -> Iterator[tuple[_Way, ...]]:
    """For each height that a row can have, the narrowest one of them."""
    for height in sorted({way.height for some in ways for way in some}):
        fitting = [[way for way in some if way.height <= height] for some in ways]
        if all(fitting):
            yield tuple(min(some, key=lambda way: way.width) for some in fitting)


def _columns_of(ways: Sequence[Sequence[_Way]]) -> Iterator[tuple[_Way, ...]]:
    """For each width that a column can have, the lowest one of them."""
    for width in sorted({way.width for some in ways for way in some}):
        fitting = [[way for way in some if way.width <= width] for some in ways]
        if all(fitting):
            yield tuple(min(some, key=lambda way: way.height) for some in fitting)


def _ways(
    root: str, children: Mapping[str, Sequence[str]], size_of: Callable[[str], tuple[float, float]]
) -> list[_Way]:
    """The ways to draw a tree; nothing recurses, however deep it is."""
    found: dict[str, list[_Way]] = {}
    order = [root]
    for name in order:
        order += children.get(name, ())
    for name in reversed(order):
        below = children.get(name, ())
        found[name] = _best(_ways_of_node(name, size_of(name), [found.pop(child) for child in below]))
    return found[root]


def _ways_of_node(name: str, size: tuple[float, float], below: Sequence[list[_Way]]) -> Iterator[_Way]:
    if not below:
        yield _Way(name, *size, (0.0, *size), "across", ())
        return
    leaves = [ways for ways in below if not ways[0].parts]
    others = [ways for ways in below if ways[0].parts]
    yield from (_across(name, size, row) for row in _rows_of(below))
    if len(below) > 1 or leaves:
        yield from (_along_rail(name, size, column) for column in _columns_of(below))
    if len(leaves) > 1 and others:
        rail = [_along_rail(None, (0.0, 0.0), [way for way, *_ in leaves])]
        yield from (_across(name, size, row) for row in _rows_of([rail, *others]))


def _across(name: str, size: tuple[float, float], row: Sequence[_Way]) -> _Way:
    width, middle = _span(row)
    x = middle - size[0] / 2
    shift = max(0.0, -x)
    whole = max(width + shift, x + shift + size[0])
    height = size[1] + BELOW + _highest(row)
    return _Way(name, whole, height, (x + shift, *size), "across", tuple(row))


def _span(row: Sequence[_Way]) -> tuple[float, float]:
    """How wide a row is, and the middle of where lines arrive at it."""
    width = sum(way.width for way in row) + ACROSS * (len(row) - 1)
    return width, (row[0].anchor + width - row[-1].width + row[-1].anchor) / 2


def _along_rail(name: str | None, size: tuple[float, float], column: Sequence[_Way]) -> _Way:
    width = max(size[0], INDENT + max(way.width for way in column))
    height = size[1] + sum(STACKED + way.height for way in column)
    card = (0.0, *size) if name is not None else (0.0, 2 * RAIL, 0.0)
    return _Way(name, width, height, card, "rail", tuple(column))


def _best(ways: Iterator[_Way]) -> list[_Way]:
    """Those that no other beats in both width and height; not too many, as evenly chosen as can be."""
    best: list[_Way] = []
    for way in sorted(ways, key=lambda way: (way.width, way.height)):
        if not best or way.height < best[-1].height:
            best.append(way)
    step = max(1.0, (len(best) - 1) / (_WAYS - 1))
    return [best[round(number * step)] for number in range(min(len(best), _WAYS))]


def _placed(root: _Way, x: float, y: float) -> Iterator[Card]:
    waiting: list[tuple[_Way, float, float, str | None, float | None]] = [(root, x, y, None, None)]
    while waiting:
        way, left, top, parent, rail = waiting.pop()
        card_x, width, height = way.card
        if way.name is not None:
            parent_of_card, parent = parent, way.name
            yield Card(way.name, left + card_x, top, width, height, parent_of_card, rail)
        rail = left + RAIL if way.form == "rail" else None
        places = _places(way, left, top)
        waiting += [(part, *place, parent, rail) for part, place in zip(way.parts, places, strict=True)][::-1]


def _places(way: _Way, left: float, top: float) -> Iterator[tuple[float, float]]:
    """Where each part begins."""
    card_x, width, height = way.card
    if way.form == "rail":
        y = top + height
        for part in way.parts:
            yield left + INDENT, y + STACKED
            y += STACKED + part.height
        return
    x = left + card_x + width / 2 - (_span(way.parts)[1] if way.parts else 0.0)
    for part in way.parts:
        yield x, top + height + BELOW
        x += part.width + ACROSS
