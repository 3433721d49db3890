"""The graph as a picture, and in the languages of Graphviz and of Mermaid."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

from zstate.cli.graph.graph import Bundle, Graph
from zstate.cli.graph.layers import Edge, layered
from zstate.cli.pictures.frames import mermaid_text
from zstate.cli.pictures.svg import ALARM, CARD, INK, LINE, MUTED, WRITERS, Svg, text_width

_TEXT, _LINE_HEIGHT, _PAD = 12.0, 17.0, 12.0
_MARGIN, _HEAD = 20.0, 44.0
_PROGRAM = "#eef2ff"


class _Nodes:
    """The programs and bundles of a graph, each with lines of text, and the edges between them."""

    def __init__(self, graph: Graph) -> None:
        bundles = {f"bundle {number}": bundle for number, bundle in enumerate(graph.bundles)}
        self.bundles: dict[str, Bundle] = bundles
        self.lines = {name: _bundle_lines(bundle) for name, bundle in bundles.items()}
        self.lines |= {f"program {one}": _program_lines(one) for one in graph.programs}
        self.writes = [(f"program {one}", name) for name, bundle in bundles.items() for one in bundle.writers]
        self.reads = [(name, f"program {one}") for name, bundle in bundles.items() for one in bundle.readers]

    @property
    def edges(self) -> list[Edge]:
        return [*self.writes, *self.reads]

    def is_missed(self, name: str) -> bool:
        """Whether somebody reads what nobody writes."""
        bundle = self.bundles.get(name)
        return bundle is not None and not bundle.writers


def _bundle_lines(bundle: Bundle) -> list[str]:
    labels = [stream.label for stream in bundle.streams]
    return [bundle.robot, *labels] if bundle.robot else labels


def _program_lines(program: str) -> list[str]:
    """Its name, and where it runs."""
    name, at, place = program.partition("@")
    return [name, place] if at and name else [program]


def svg(graph: Graph, *, title: str) -> str:
    """Programs and streams from left to right; arrows go the way of the data."""
    nodes = _Nodes(graph)
    sizes = {name: _size(lines) for name, lines in nodes.lines.items()}
    layout = layered(sizes, nodes.edges)
    picture = Svg(title)
    picture.words(_MARGIN, _MARGIN + 12.0, title, size=16.0, bold=True)
    colors = {name: WRITERS[n % len(WRITERS)] for n, name in enumerate(_owners(nodes))}
    for edge, route in layout.routes.items():
        color = colors.get(edge[0] if edge[0] in colors else edge[1], LINE)
        points = [(x + _MARGIN, y + _MARGIN + _HEAD) for x, y in route]
        picture.line(points, stroke=color, shape="smooth", arrow=True)
    for name, (x, y) in layout.places.items():
        _draw(picture, nodes, name, (x + _MARGIN, y + _MARGIN + _HEAD), sizes[name])
    return picture.text(_MARGIN)


def _owners(nodes: _Nodes) -> Iterator[str]:
    """The programs that write: their lines, and those of what they write, have a colour each."""
    yield from dict.fromkeys(writer for writer, _ in nodes.writes)


def _size(lines: Sequence[str]) -> tuple[float, float]:
    width = max(text_width(line, _TEXT + (number == 0)) for number, line in enumerate(lines))
    return width + 2 * _PAD, _LINE_HEIGHT * len(lines) + _PAD


def _draw(
    picture: Svg, nodes: _Nodes, name: str, place: tuple[float, float], size: tuple[float, float]
) -> None:
    x, y = place
    is_bundle, missed = name in nodes.bundles, nodes.is_missed(name)
    stroke, fill = ALARM if missed else LINE, CARD if is_bundle else _PROGRAM
    picture.box(x, y, *size, stroke=stroke, fill=fill, radius=5.0 if is_bundle else 14.0, dashed=missed)
    for number, line in enumerate(nodes.lines[name]):
        baseline = y + _PAD / 2 + _LINE_HEIGHT * (number + 0.75)
        color = INK if number == 0 or is_bundle else MUTED
        picture.words(x + _PAD, baseline, line, size=_TEXT + (number == 0), color=color, bold=number == 0)


def dot(graph: Graph) -> str:
    """For Graphviz."""
    nodes = _Nodes(graph)
    lines = ["digraph zstate {", "  rankdir=LR;"]
    for name, words in nodes.lines.items():
        shape = "box" if name in nodes.bundles else "ellipse"
        label = json.dumps("\n".join(words), ensure_ascii=False)
        lines.append(f"  {json.dumps(name, ensure_ascii=False)} [shape={shape}, label={label}];")
    for begin, end in nodes.edges:
        lines.append(f"  {json.dumps(begin, ensure_ascii=False)} -> {json.dumps(end, ensure_ascii=False)};")
    return "\n".join([*lines, "}"])


def mermaid(graph: Graph) -> str:
    """For Markdown."""
    nodes = _Nodes(graph)
    numbers = {name: f"n{number}" for number, name in enumerate(nodes.lines)}
    lines = ["graph LR"]
    for name, words in nodes.lines.items():
        label = "<br>".join(map(mermaid_text, words))
        shaped = f'["{label}"]' if name in nodes.bundles else f'(["{label}"])'
        lines.append(f"  {numbers[name]}{shaped}")
    lines += [f"  {numbers[begin]} --> {numbers[end]}" for begin, end in nodes.edges]
    return "\n".join(lines)
