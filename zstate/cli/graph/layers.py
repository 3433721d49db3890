"""Layers: where the nodes of a graph stand, from left to right, and how its edges run between them.

The usual steps (Sugiyama, Tagawa and Toda, 1981): edges that close a circle count the other way round,
each node stands right of all before it, nodes of a layer change places until few edges cross, and then move
up and down towards their neighbours as far as there is room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from statistics import fmean as mean

Point = tuple[float, float]
Edge = tuple[str, str]

_ACROSS, _BETWEEN = 90.0, 18.0
_SWEEPS = 12


@dataclass(frozen=True, slots=True)
class Layout:
    """The upper left corner of each node, and the points through which each edge runs."""

    places: Mapping[str, Point]
    routes: Mapping[Edge, Sequence[Point]]


def layered(sizes: Mapping[str, tuple[float, float]], edges: Sequence[Edge]) -> Layout:
    """A place for each node of ``sizes`` (width, height), beginning at (0, 0), and a route for each edge.

    Edges are between different nodes, each once.
    """
    forward = _without_circles(list(sizes), edges)
    ranks = _ranks(list(sizes), list(forward.values()))
    chains = [_chain(number, *along, ranks) for number, along in enumerate(forward.values())]
    layers = _ordered(_layers(ranks, chains), _Neighbours(chains))
    heights = {node: sizes.get(node, (0.0, 0.0))[1] for layer in layers for node in layer}
    middles = _middles(layers, heights, _Neighbours(chains))
    lefts, rights = _columns(layers, sizes)
    places = {
        node: ((lefts[rank] + rights[rank] - sizes[node][0]) / 2, middles[node] - heights[node] / 2)
        for node, rank in ranks.items()
    }
    routes = dict[Edge, Sequence[Point]]()
    ports = _ports(places, sizes, chains, middles)
    for (edge, along), chain, ends in zip(forward.items(), chains, ports, strict=True):
        between = [
            (x, middles[node])
            for rank, node in enumerate(chain[1:-1], ranks[chain[0]] + 1)
            for x in (lefts[rank], rights[rank])
        ]
        route = [ends[0], *between, ends[1]]
        routes[edge] = route if along == edge else route[::-1]
    return Layout(places, routes)


def _without_circles(nodes: Sequence[str], edges: Sequence[Edge]) -> dict[Edge, Edge]:
    """Each edge, the other way round where it would close a circle."""
    after: dict[str, list[str]] = {node: [] for node in nodes}
    for begin, end in edges:
        after[begin].append(end)
    done: set[str] = set()
    open_now: set[str] = set()
    back: set[Edge] = set()
    entering = {end for _, end in edges}
    for root in sorted(nodes, key=lambda node: node in entering):
        stack = [(root, iter(after[root]))] if root not in done else []
        open_now |= {root} - done
        while stack:
            node, rest = stack[-1]
            for other in rest:
                if other in open_now:
                    back.add((node, other))
                elif other not in done:
                    open_now.add(other)
                    stack.append((other, iter(after[other])))
                    break
            else:
                stack.pop()
                open_now.discard(node)
                done.add(node)
    return {(begin, end): (end, begin) if (begin, end) in back else (begin, end) for begin, end in edges}


def _ranks(nodes: Sequence[str], edges: Sequence[Edge]) -> dict[str, int]:
    """How far right each node stands: behind all that lead to it, and close to what it leads to."""
    ranks = dict.fromkeys(nodes, 0)
    for _ in nodes:
        changed = False
        for begin, end in edges:
            if ranks[end] <= ranks[begin]:
                ranks[end] = ranks[begin] + 1
                changed = True
        if not changed:
            break
    led_to = {end for _, end in edges}
    for node in nodes:
        after = [ranks[end] for begin, end in edges if begin == node]
        if after and node not in led_to:
            ranks[node] = min(after) - 1
    return ranks


def _chain(number: int, begin: str, end: str, ranks: Mapping[str, int]) -> list[str]:
    """An edge with a nameless node on each layer that it passes."""
    return [begin, *(f"\0{number} {rank}" for rank in range(ranks[begin] + 1, ranks[end])), end]


def _layers(ranks: Mapping[str, int], chains: Sequence[list[str]]) -> list[list[str]]:
    layers: list[list[str]] = [[] for _ in range(max(ranks.values(), default=-1) + 1)]
    for node, rank in ranks.items():
        layers[rank].append(node)
    for chain in chains:
        for rank, node in enumerate(chain[1:-1], ranks[chain[0]] + 1):
            layers[rank].append(node)
    return layers


class _Neighbours:
    """Who stands beside whom along the edges: to the left, and to the right."""

    def __init__(self, chains: Sequence[list[str]]) -> None:
        self.pairs = [pair for chain in chains for pair in pairwise(chain)]
        self.left: dict[str, list[str]] = {}
        self.right: dict[str, list[str]] = {}
        for begin, end in self.pairs:
            self.right.setdefault(begin, []).append(end)
            self.left.setdefault(end, []).append(begin)

    def of(self, node: str) -> list[str]:
        return self.left.get(node, []) + self.right.get(node, [])


def _ordered(layers: list[list[str]], neighbours: _Neighbours) -> list[list[str]]:
    """The layers with few crossings: each node as near as can be to the mean place of its neighbours."""
    best, fewest = [list(layer) for layer in layers], _crossings(layers, neighbours)
    for sweep in range(_SWEEPS):
        beside = neighbours.left if sweep % 2 == 0 else neighbours.right
        for layer in layers if sweep % 2 == 0 else layers[::-1]:
            order = {node: place for some in layers for place, node in enumerate(some)}
            layer.sort(key=lambda node: mean([order[other] for other in beside.get(node, [node])]))
        crossings = _crossings(layers, neighbours)
        if crossings < fewest:
            best, fewest = [list(layer) for layer in layers], crossings
    return best


def _crossings(layers: Sequence[Sequence[str]], neighbours: _Neighbours) -> int:
    place = {node: (rank, at) for rank, layer in enumerate(layers) for at, node in enumerate(layer)}
    spans = sorted((place[begin], place[end][1]) for begin, end in neighbours.pairs)
    return sum(
        one[0][0] == other[0][0] and one[0][1] < other[0][1] and one[1] > other[1]
        for one, other in combinations(spans, 2)
    )


def _middles(
    layers: Sequence[Sequence[str]], heights: Mapping[str, float], neighbours: _Neighbours
) -> dict[str, float]:
    """How far down the middle of each node is; the highest node begins at 0."""
    middles: dict[str, float] = {}
    for layer in layers:
        y = 0.0
        for node in layer:
            middles[node] = y + heights[node] / 2
            y += heights[node] + _BETWEEN
    for _ in range(_SWEEPS):
        for layer in (*layers, *layers[::-1]):
            wished = [
                mean([middles[other] for other in neighbours.of(node)] or [middles[node]]) for node in layer
            ]
            middles.update(zip(layer, _apart(wished, [heights[node] for node in layer]), strict=True))
    top = min((middles[node] - height / 2 for node, height in heights.items()), default=0.0)
    return {node: middle - top for node, middle in middles.items()}


def _apart(wished: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Middles as near to those wished for as can be, in the same order and without covering each other."""
    offsets = [0.0]
    for above, below in pairwise(heights):
        offsets.append(offsets[-1] + (above + below) / 2 + _BETWEEN)
    # Without the room they need they only have to ascend: neighbours that do not move as one.
    blocks: list[list[float]] = []
    for wish, offset in zip(wished, offsets, strict=True):
        blocks.append([wish - offset])
        while len(blocks) > 1 and mean(blocks[-2]) > mean(blocks[-1]):
            last = blocks.pop()
            blocks[-1] += last
    flat = [mean(block) for block in blocks for _ in block]
    return [y + offset for y, offset in zip(flat, offsets, strict=True)]


def _columns(
    layers: Sequence[Sequence[str]], sizes: Mapping[str, tuple[float, float]]
) -> tuple[list[float], list[float]]:
    """Where each layer begins and ends."""
    lefts: list[float] = []
    rights: list[float] = []
    for layer in layers:
        lefts.append(rights[-1] + _ACROSS if rights else 0.0)
        rights.append(lefts[-1] + max(sizes.get(node, (0.0, 0.0))[0] for node in layer))
    return lefts, rights


def _ports(
    places: Mapping[str, Point],
    sizes: Mapping[str, tuple[float, float]],
    chains: Sequence[list[str]],
    middles: Mapping[str, float],
) -> list[tuple[Point, Point]]:
    """Where each edge leaves its first node on the right and enters its last one on the left."""
    leaving: dict[str, list[tuple[float, int]]] = {}
    entering: dict[str, list[tuple[float, int]]] = {}
    for number, chain in enumerate(chains):
        leaving.setdefault(chain[0], []).append((middles[chain[1]], number))
        entering.setdefault(chain[-1], []).append((middles[chain[-2]], number))
    begins = _spread(leaving, places, sizes, side=1)
    ends = _spread(entering, places, sizes, side=0)
    return [(begins[number], ends[number]) for number in range(len(chains))]


def _spread(
    edges: Mapping[str, list[tuple[float, int]]],
    places: Mapping[str, Point],
    sizes: Mapping[str, tuple[float, float]],
    *,
    side: int,
) -> dict[int, Point]:
    """The edges along one side of each node, in the order of their other ends."""
    found: dict[int, Point] = {}
    for node, ends in edges.items():
        (x, y), (width, height) = places[node], sizes[node]
        for place, (_, number) in enumerate(sorted(ends), 1):
            found[number] = (x + side * width, y + height * place / (len(ends) + 1))
    return found
