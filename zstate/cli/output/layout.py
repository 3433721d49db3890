"""Layouts of graphs: positions of nodes and routes of edges.

``layered_layout`` draws any graph from left to right. ``tree_layout`` draws trees from the top down and folds
them to the shape of a page: in layers, the 60 frames of a humanoid would be 4000 pixels wide and 370 high.
Both take the size of each node as (width, height), and edges between different nodes, each once. The origin
is the upper left corner.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from itertools import combinations, pairwise
from math import sqrt
from statistics import fmean as mean

Point = tuple[float, float]
Size = tuple[float, float]
Pair = tuple[str, str]

_LAYER_GAP, _NODE_GAP = 90.0, 18.0
_SWEEPS = 12

_ACROSS, _BELOW, _INDENT, _STACKED = 14.0, 22.0, 22.0, 7.0
"""Between neighbours, below a parent, right of it along a rail, and between nodes on a rail."""

_RAIL = 9.0
"""Distance of a rail from the left edge of its parent."""

_TREE_GAP = 40.0
_PAGE_SHAPE = 1.6
_MAX_ARRANGEMENTS = 24


@dataclass(frozen=True, slots=True)
class Layout:
    """The upper left corner of each node, and the points of each edge."""

    places: dict[str, Point]
    routes: dict[Pair, list[Point]]


def layered_layout(sizes: Mapping[str, Size], edges: Sequence[Pair]) -> Layout:
    """Layered layout from left to right (Sugiyama, Tagawa and Toda, 1981).

    Edges that close a cycle are reversed, each node is placed right of its predecessors, the order within
    layers is changed to reduce crossings, and nodes then move up and down towards their neighbours.
    """
    order, forward = _break_cycles(sizes, edges)
    before, after = _successors(map(_reversed, forward.values())), _successors(forward.values())
    ranks: dict[str, int] = {}
    for node in order:  # right of all predecessors
        ranks[node] = max((ranks[other] + 1 for other in before.get(node, ())), default=0)
    for node in after.keys() - before.keys():  # close to the successors
        ranks[node] = min(ranks[end] for end in after[node]) - 1
    layers: list[list[str]] = [[] for _ in range(max(ranks.values(), default=-1) + 1)]
    for node in sizes:
        layers[ranks[node]].append(node)
    # A long edge has a placeholder without size in each layer that it passes.
    chains: list[list[str]] = []
    for number, (start, end) in enumerate(forward.values()):
        passed = {rank: f"\0{number} {rank}" for rank in range(ranks[start] + 1, ranks[end])}
        for rank, placeholder in passed.items():
            layers[rank].append(placeholder)
        chains.append([start, *passed.values(), end])
    links = [link for chain in chains for link in pairwise(chain)]
    layers = _reduce_crossings(layers, links)
    heights = {node: sizes.get(node, (0.0, 0.0))[1] for layer in layers for node in layer}
    middles = _middles(layers, heights, links)

    lefts, rights = list[float](), list[float]()
    for layer in layers:
        lefts.append(rights[-1] + _LAYER_GAP if rights else 0.0)
        rights.append(lefts[-1] + max(sizes.get(node, (0.0, 0.0))[0] for node in layer))
    places = {
        node: ((lefts[rank] + rights[rank] - sizes[node][0]) / 2, middles[node] - heights[node] / 2)
        for node, rank in ranks.items()
    }
    leaving = [(chain[0], middles[chain[1]]) for chain in chains]
    entering = [(chain[-1], middles[chain[-2]]) for chain in chains]
    starts, ends = _ports(leaving, places, sizes, side=1), _ports(entering, places, sizes, side=0)
    routes = dict[Pair, list[Point]]()
    for number, (chain, (edge, along)) in enumerate(zip(chains, forward.items(), strict=True)):
        between = [
            (x, middles[node])
            for rank, node in enumerate(chain[1:-1], ranks[chain[0]] + 1)
            for x in (lefts[rank], rights[rank])
        ]
        route = [starts[number], *between, ends[number]]
        routes[edge] = route if along == edge else route[::-1]
    return Layout(places, routes)


def _break_cycles(nodes: Iterable[str], edges: Sequence[Pair]) -> tuple[list[str], dict[Pair, Pair]]:
    """The nodes in the order of the data, and the direction of each edge in it.

    Of each cycle the edge that is last in ``edges`` is reversed.
    """
    kept = list(edges)
    while True:
        predecessors: dict[str, list[str]] = {node: [] for node in nodes}
        for start, end in kept:
            predecessors[end].append(start)
        try:
            order = list(TopologicalSorter(predecessors).static_order())
        except CycleError as error:
            cycle: list[str] = error.args[1]
            kept.remove(max(pairwise(cycle), key=kept.index))
        else:
            position = {node: number for number, node in enumerate(order)}
            return order, {
                one: one if position[one[0]] < position[one[1]] else _reversed(one) for one in edges
            }


def _successors(edges: Iterable[Pair]) -> dict[str, list[str]]:
    after: dict[str, list[str]] = {}
    for start, end in edges:
        after.setdefault(start, []).append(end)
    return after


def _reversed(edge: Pair) -> Pair:
    return edge[1], edge[0]


def _reduce_crossings(layers: list[list[str]], links: Sequence[Pair]) -> list[list[str]]:
    """The layers with few crossings: each node is placed near the mean position of its neighbours."""
    left, right = _successors(map(_reversed, links)), _successors(links)
    best, fewest = [list(layer) for layer in layers], _crossings(layers, links)
    for sweep in range(_SWEEPS):
        neighbours = left if sweep % 2 == 0 else right
        for layer in layers if sweep % 2 == 0 else layers[::-1]:
            order = {node: position for some in layers for position, node in enumerate(some)}
            layer.sort(key=lambda node: mean([order[other] for other in neighbours.get(node, [node])]))
        crossings = _crossings(layers, links)
        if crossings < fewest:
            best, fewest = [list(layer) for layer in layers], crossings
    return best


def _crossings(layers: Sequence[Sequence[str]], links: Sequence[Pair]) -> int:
    place = {node: (rank, at) for rank, layer in enumerate(layers) for at, node in enumerate(layer)}
    spans = sorted((place[start], place[end][1]) for start, end in links)
    return sum(
        one[0][0] == other[0][0] and one[0][1] < other[0][1] and one[1] > other[1]
        for one, other in combinations(spans, 2)
    )


def _middles(
    layers: Sequence[Sequence[str]], heights: Mapping[str, float], links: Sequence[Pair]
) -> dict[str, float]:
    """The y of the middle of each node; the top of the highest node is 0."""
    neighbours = _successors([*map(_reversed, links), *links])
    middles: dict[str, float] = {}
    for layer in layers:
        y = 0.0
        for node in layer:
            middles[node] = y + heights[node] / 2
            y += heights[node] + _NODE_GAP
    for _ in range(_SWEEPS):
        for layer in (*layers, *layers[::-1]):
            desired = [mean([middles[other] for other in neighbours.get(node, [node])]) for node in layer]
            middles.update(zip(layer, _spread_out(desired, [heights[node] for node in layer]), strict=True))
    top = min((middles[node] - height / 2 for node, height in heights.items()), default=0.0)
    return {node: middle - top for node, middle in middles.items()}


def _spread_out(desired: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Middles nearest to the desired ones, in the same order and without overlap."""
    offsets = [0.0]
    for above, below in pairwise(heights):
        offsets.append(offsets[-1] + (above + below) / 2 + _NODE_GAP)
    # Without the required distances the middles only have to ascend; neighbours that do not move as one.
    blocks: list[list[float]] = []
    for middle, offset in zip(desired, offsets, strict=True):
        blocks.append([middle - offset])
        while len(blocks) > 1 and mean(blocks[-2]) > mean(blocks[-1]):
            last = blocks.pop()
            blocks[-1] += last
    flat = [mean(block) for block in blocks for _ in block]
    return [y + offset for y, offset in zip(flat, offsets, strict=True)]


def _ports(
    attached: Sequence[tuple[str, float]],
    places: Mapping[str, Point],
    sizes: Mapping[str, Size],
    *,
    side: int,
) -> dict[int, Point]:
    """Where each edge touches its node, given as (node, y of the edge's next point).

    Edges are spread over the left (``side`` 0) or right (1) edge of a node in the order of their next points.
    """
    by_node: dict[str, list[tuple[float, int]]] = {}
    for number, (node, y) in enumerate(attached):
        by_node.setdefault(node, []).append((y, number))
    ports: dict[int, Point] = {}
    for node, ends in by_node.items():
        (x, y), (width, height) = places[node], sizes[node]
        for position, (_, number) in enumerate(sorted(ends), 1):
            ports[number] = (x + side * width, y + height * position / (len(ends) + 1))
    return ports


@dataclass(frozen=True, slots=True)
class _Arrangement:
    """One way to place a subtree, in coordinates from its upper left corner.

    ``middle`` is the x at which the line from the parent arrives, above the middle of the root. ``parts`` are
    subtrees with their corners. Without a ``name`` there is no root: the parts share a rail of the parent.
    """

    name: str | None
    width: float
    height: float
    middle: float
    parts: Sequence[tuple[_Arrangement, float, float]] = ()
    has_rail: bool = False


def tree_layout(sizes: Mapping[str, Size], edges: Sequence[Pair]) -> Layout:
    """Layout of trees from the top down, on a page that is not too wide.

    The children of a node are placed side by side below it, or under each other along a rail, or side by side
    with only the leaves along a rail. From the leaves up, arrangements that are both wider and higher than
    another are discarded; the one that fits the smallest page is used.
    """
    children = _successors(edges)
    entered = {end for _, end in edges}
    roots = [name for name in sizes if name not in entered]

    def page_size(way: _Arrangement) -> tuple[float, float]:
        return max(way.width / _PAGE_SHAPE, way.height), way.width

    trees = [min(_arrangements(root, children, sizes), key=page_size) for root in roots]
    area = sum((tree.width + _TREE_GAP) * (tree.height + _TREE_GAP) for tree in trees)
    page_width = max([sqrt(area * _PAGE_SHAPE), *(tree.width for tree in trees)])
    layout = Layout({}, {})
    x = y = row_height = 0.0
    for tree in trees:
        if x and x + tree.width > page_width:
            x, y, row_height = 0.0, y + row_height + _TREE_GAP, 0.0
        _place(tree, (x, y), sizes, layout)
        x, row_height = x + tree.width + _TREE_GAP, max(row_height, tree.height)
    return layout


def _arrangements(
    root: str, children: Mapping[str, Sequence[str]], sizes: Mapping[str, Size]
) -> list[_Arrangement]:
    """The arrangements of a tree that are not both wider and higher than another. Not recursive."""
    found: dict[str, list[_Arrangement]] = {}
    order = [root]
    for name in order:
        order += children.get(name, ())
    for name in reversed(order):
        below = [found.pop(child) for child in children.get(name, ())]
        best: list[_Arrangement] = []
        for way in sorted(_arrange(name, sizes[name], below), key=lambda way: (way.width, way.height)):
            if not best or way.height < best[-1].height:
                best.append(way)
        # Not too many, and as evenly chosen as possible.
        step = max(1.0, (len(best) - 1) / (_MAX_ARRANGEMENTS - 1))
        found[name] = [best[round(number * step)] for number in range(min(len(best), _MAX_ARRANGEMENTS))]
    return found[root]


def _arrange(name: str, size: Size, below: Sequence[list[_Arrangement]]) -> Iterator[_Arrangement]:
    if not below:
        yield _Arrangement(name, *size, size[0] / 2)
        return
    leaves = [ways for ways in below if not ways[0].parts]
    others = [ways for ways in below if ways[0].parts]
    yield from _side_by_side(name, size, below)
    if len(below) > 1 or leaves:
        for width in sorted({way.width for ways in below for way in ways}):
            # For each width of the column, its lowest arrangement.
            fitting = [[way for way in ways if way.width <= width] for ways in below]
            if all(fitting):
                yield _along_rail(name, size, [min(ways, key=lambda way: way.height) for ways in fitting])
    if len(leaves) > 1 and others:
        rail = [_along_rail(None, (0.0, 0.0), [way for way, *_ in leaves])]
        yield from _side_by_side(name, size, [rail, *others])


def _side_by_side(name: str, size: Size, below: Sequence[list[_Arrangement]]) -> Iterator[_Arrangement]:
    """For each height that the row of children can have, its narrowest arrangement."""
    for height in sorted({way.height for ways in below for way in ways}):
        fitting = [[way for way in ways if way.height <= height] for ways in below]
        if all(fitting):
            row = [min(ways, key=lambda way: way.width) for ways in fitting]
            lefts = [0.0]
            for way in row:
                lefts.append(lefts[-1] + way.width + _ACROSS)
            # The root is above the middle of the lines that arrive at its children.
            middle = (row[0].middle + lefts[-2] + row[-1].middle) / 2
            x, top = middle - size[0] / 2, size[1] + _BELOW
            shift = max(0.0, -x)
            width = max(lefts[-1] - _ACROSS + shift, x + shift + size[0])
            parts = [(way, left + shift, top) for way, left in zip(row, lefts, strict=False)]
            yield _Arrangement(name, width, top + max(way.height for way in row), middle + shift, parts)


def _along_rail(name: str | None, size: Size, column: Sequence[_Arrangement]) -> _Arrangement:
    width = max(size[0], _INDENT + max(way.width for way in column))
    parts, y = list[tuple[_Arrangement, float, float]](), size[1]
    for way in column:
        parts.append((way, _INDENT, y + _STACKED))
        y += _STACKED + way.height
    middle = _RAIL if name is None else size[0] / 2
    return _Arrangement(name, width, y, middle, parts, has_rail=True)


def _place(tree: _Arrangement, corner: Point, sizes: Mapping[str, Size], layout: Layout) -> None:
    """Add the nodes and edges of ``tree`` to ``layout``; ``corner`` is the upper left one."""
    stack: list[tuple[_Arrangement, float, float, str | None, float | None]] = [(tree, *corner, None, None)]
    while stack:
        way, left, top, parent, rail = stack.pop()
        if way.name is not None:
            size = sizes[way.name]
            layout.places[way.name] = corner = left + way.middle - size[0] / 2, top
            if parent is not None:
                ends = (layout.places[parent], sizes[parent]), (corner, size)
                layout.routes[parent, way.name] = _connect(*ends, rail)
            parent = way.name
        rail = left + _RAIL if way.has_rail else None
        stack += [(part, left + x, top + y, parent, rail) for part, x, y in reversed(way.parts)]


def _connect(parent: tuple[Point, Size], child: tuple[Point, Size], rail: float | None) -> list[Point]:
    """From the lower edge of the parent to the upper edge of the child, or along a rail to its left edge."""
    ((left, top), (width, height)), ((x, y), (child_width, child_height)) = parent, child
    start, bottom = left + width / 2, top + height
    bus = bottom + _BELOW / 2
    if rail is None:
        middle = x + child_width / 2
        return [(start, bottom), (start, bus), (middle, bus), (middle, y)]
    is_below_parent = left < rail < left + width
    start = [(rail, bottom)] if is_below_parent else [(start, bottom), (start, bus), (rail, bus)]
    return [*start, (rail, y + child_height / 2), (x, y + child_height / 2)]
