"""The frame tree as a picture, and in the languages of Graphviz and of Mermaid."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

from zstate.cli.console import count_text, rate_text, sample_age_text
from zstate.cli.frame_tree import below, roots, short_name
from zstate.cli.pictures.cards import BELOW, Card, cards
from zstate.cli.pictures.svg import ALARM, LINE, MUTED, WRITERS, Svg, text_width
from zstate.clock import SYSTEM

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo

_NAME, _NOTE = 13.0, 11.0
_MARGIN, _HEAD = 20.0, 30.0
_HIGH, _LOW = 38.0, 24.0
_PAD = 12.0

# Who is silent for so long is worth a colour.
_OLD_NS = 1_000_000_000


def svg(frames: Sequence[FrameInfo], now: int, *, in_full: bool, title: str) -> str:
    """The tree from the top down, with kind, rate, age and writer of each edge; ``now`` [ns] tells ages."""
    return _Picture(frames, now, in_full=in_full).drawn(title)


class _Picture:
    def __init__(self, frames: Sequence[FrameInfo], now: int, *, in_full: bool) -> None:
        self._frames = {frame.name: frame for frame in frames}
        self._now = now
        self._in_full = in_full
        writers = dict.fromkeys(frame.writer for frame in frames if frame.writer)
        self._colors = {writer: WRITERS[n % len(WRITERS)] for n, writer in enumerate(writers) if writer}

    def drawn(self, title: str) -> str:
        svg = Svg(title)
        svg.words(_MARGIN, _MARGIN + 12.0, title, size=16.0, bold=True)
        left, top = _MARGIN, self._legend(svg, _MARGIN + _HEAD)
        frames = tuple(self._frames.values())
        places = {card.name: card for card in cards(roots(frames), below(frames), self._size)}
        for card in places.values():
            if card.parent is not None:
                self._join(svg, places[card.parent], card, (left, top))
        for card in places.values():
            self._draw(svg, card, left + card.x, top + card.y)
        return svg.text(_MARGIN)

    def _legend(self, svg: Svg, top: float) -> float:
        """Whose colour is whose; where it ends."""
        for writer, color in self._colors.items():
            svg.box(_MARGIN, top - 9.0, 10.0, 10.0, fill=color, stroke=color, radius=2.0)
            written = sum(frame.writer == writer for frame in self._frames.values())
            text = f"{writer}: {count_text(written, 'edge')}"
            svg.words(_MARGIN + 18.0, top, text, size=12.0, color=MUTED)
            top += 18.0
        return top + 6.0

    def _name(self, frame: FrameInfo) -> str:
        return frame.name if self._in_full else short_name(frame)

    def _note(self, frame: FrameInfo) -> str:
        if frame.kind not in ("joint", "pose"):
            return "" if frame.kind == "static" else frame.kind
        if frame.newest is None:
            return f"{frame.kind}, no sample"
        return f"{frame.kind} · {rate_text(frame.rate_hz)} · {sample_age_text(frame, self._now)}"

    def _size(self, name: str) -> tuple[float, float]:
        frame = self._frames[name]
        widest = max(text_width(self._name(frame), _NAME) * 1.05, text_width(self._note(frame), _NOTE))
        return widest + 2 * _PAD, _HIGH if self._note(frame) else _LOW

    def _draw(self, svg: Svg, card: Card, x: float, y: float) -> None:
        frame = self._frames[card.name]
        color = self._color(frame)
        svg.box(x, y, card.width, card.height, stroke=color, dashed=frame.kind == "static")
        if frame.kind != "static":
            svg.box(x, y, 4.0, card.height, fill=color, stroke=color, radius=2.0)
        svg.words(x + _PAD, y + 16.0, self._name(frame), size=_NAME, bold=True)
        svg.words(x + _PAD, y + 31.0, self._note(frame), size=_NOTE, color=self._note_color(frame))

    def _color(self, frame: FrameInfo) -> str:
        return self._colors.get(frame.writer or "", LINE)

    def _note_color(self, frame: FrameInfo) -> str:
        if frame.kind not in ("joint", "pose"):
            return MUTED
        newest = frame.newest_in(SYSTEM)
        is_old = frame.newest is None or (newest is not None and self._now - newest > _OLD_NS)
        return ALARM if is_old else MUTED

    def _join(self, svg: Svg, parent: Card, card: Card, shift: tuple[float, float]) -> None:
        left, top = shift
        begin, bottom = parent.x + parent.width / 2, parent.y + parent.height
        bus = bottom + BELOW / 2
        if card.rail is None:
            middle = card.x + card.width / 2
            points = [(begin, bottom), (begin, bus), (middle, bus), (middle, card.y)]
        else:
            side = card.y + card.height / 2
            if not parent.x < card.rail < parent.x + parent.width:
                points = [(begin, bottom), (begin, bus), (card.rail, bus)]
            else:
                points = [(card.rail, bottom)]
            points += [(card.rail, side), (card.x, side)]
        is_static = self._frames[card.name].kind == "static"
        svg.line([(left + x, top + y) for x, y in points], dashed=is_static)


def dot(frames: Sequence[FrameInfo]) -> str:
    """For Graphviz."""
    lines = ["digraph frames {", "  node [shape=box];"]
    for frame in frames:
        name = json.dumps(frame.name, ensure_ascii=False)
        if frame.parent is None:
            lines.append(f"  {name};")
        else:
            parent = json.dumps(frame.parent, ensure_ascii=False)
            lines.append(f'  {parent} -> {name} [label="{_edge_label(frame)}"];')
    return "\n".join([*lines, "}"])


def mermaid(frames: Sequence[FrameInfo]) -> str:
    """For Markdown."""
    numbers = {frame.name: f"f{number}" for number, frame in enumerate(frames)}
    lines = ["graph TD"]
    lines += [f'  {numbers[frame.name]}["{mermaid_text(frame.name)}"]' for frame in frames]
    lines += [
        f"  {numbers[frame.parent]} -->|{_edge_label(frame)}| {numbers[frame.name]}"
        for frame in frames
        if frame.parent is not None
    ]
    return "\n".join(lines)


def mermaid_text(text: str) -> str:
    """``text`` as it stands between quotes in Mermaid."""
    return text.replace("#", "#35;").replace('"', "#quot;")


def _edge_label(frame: FrameInfo) -> str:
    return frame.kind if frame.rate_hz is None else f"{frame.kind} {rate_text(frame.rate_hz)}"
