"""The way from one frame to another, edge by edge."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo


class Leg(NamedTuple):
    """A step of the way: it leads to ``frame``, over the edge that places ``edge.name`` on its parent."""

    frame: str
    edge: FrameInfo


def path_between(frames: Sequence[FrameInfo], target: str, source: str) -> tuple[str, list[Leg]]:
    """The full name of ``target``, and the steps from there to ``source``. Both are known, and connected."""
    by_name = {frame.name: frame for frame in frames}
    begin, end = _full(target, by_name), _full(source, by_name)
    up, down = _upwards(begin, by_name), _upwards(end, by_name)
    shared = {edge.name for edge in up} & {edge.name for edge in down}
    legs = [Leg(edge.parent or "", edge) for edge in up if edge.name not in shared]
    return begin, legs + [Leg(edge.name, edge) for edge in reversed(down) if edge.name not in shared]


def _full(name: str, by_name: Mapping[str, FrameInfo]) -> str:
    """A frame by its full name; a bare one is that of some robot's frame."""
    bare = (frame for frame in by_name if frame.partition("/")[2] == name)
    return name if name in by_name else next(bare, name)


def _upwards(frame: str, by_name: Mapping[str, FrameInfo]) -> list[FrameInfo]:
    edges: list[FrameInfo] = []
    info = by_name.get(frame)
    while info is not None and info.parent is not None:
        edges.append(info)
        info = by_name.get(info.parent)
    return edges
