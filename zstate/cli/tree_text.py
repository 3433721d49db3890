"""The frame tree as lines of text, as wide as the terminal lets them be."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from zstate.cli.console import rate_text, sample_age_text
from zstate.cli.frame_tree import below, roots, short_name
from zstate.cli.layout import Guides, chain_lines, in_columns, letters_for, tree_lines
from zstate.errors import printable

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo

_HEADINGS = ("frame", "edge", "rate", "age", "writer")

Cells = Callable[["FrameInfo", int], tuple[str, ...]]


def _cells(frame: FrameInfo, now: int) -> tuple[str, ...]:
    """Kind, rate and age."""
    if frame.kind not in ("joint", "pose"):
        return frame.kind, "", ""
    return frame.kind, rate_text(frame.rate_hz), sample_age_text(frame, now)


def _fewer_cells(frame: FrameInfo, now: int) -> tuple[str, ...]:
    kind, rate, age = _cells(frame, now)
    return (f"{rate} {age}" if rate else kind,)


def tree_text(frames: Sequence[FrameInfo], now: int, *, in_full: bool, width: int | None = None) -> str:
    """One line for each frame; ``now`` [ns] tells ages.

    Where that is wider than ``width``, writers become letters that are explained below, then a frame that is
    its parent's only child stands right under it, and at last moving edges have no kind.
    """
    lines = _lines(frames, now, in_full=in_full, guides=tree_lines)
    if width is None or _fits(lines, width):
        return "\n".join(lines)
    letters = letters_for(frame.writer for frame in frames if frame.writer)
    legend = [f"{letter}: {printable(writer)}" for writer, letter in letters.items()]
    for guides, cells in ((tree_lines, _cells), (chain_lines, _cells), (chain_lines, _fewer_cells)):
        lines = _lines(frames, now, in_full=in_full, guides=guides, cells=cells, names=letters)
        if _fits(lines, width):
            break
    return "\n".join([*lines, *legend])


def _lines(
    frames: Sequence[FrameInfo],
    now: int,
    *,
    in_full: bool,
    guides: Guides,
    cells: Cells = _cells,
    names: Mapping[str, str] | None = None,
) -> list[str]:
    by_name, children = {frame.name: frame for frame in frames}, below(frames)
    rows: list[tuple[str, ...]] = [] if cells is _fewer_cells else [_HEADINGS]
    for root in roots(frames):
        for guide, name in guides(root, children):
            frame = by_name[name]
            writer = frame.writer or ""
            shown = name if in_full else short_name(frame)
            rows.append((guide + shown, *cells(frame, now), names.get(writer, "") if names else writer))
    return in_columns(rows)


def _fits(lines: Sequence[str], width: int) -> bool:
    return max(map(len, lines), default=0) <= width
