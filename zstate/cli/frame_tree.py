"""The tree that frames make: who is at the top, who hangs on whom, and what they are called in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo


def short_name(frame: FrameInfo) -> str:
    """The name without the robot's, where the parent belongs to the same robot."""
    robot, slash, bare = frame.name.partition("/")
    return bare if slash and (frame.parent or "").startswith(f"{robot}/") else frame.name


def roots(frames: Sequence[FrameInfo]) -> list[str]:
    """The names of the frames without a parent, sorted."""
    return sorted(frame.name for frame in frames if frame.parent is None)


def below(frames: Sequence[FrameInfo]) -> dict[str, list[str]]:
    """The names of each frame's children, sorted."""
    children: dict[str, list[str]] = {}
    for frame in frames:
        if frame.parent is not None:
            children.setdefault(frame.parent, []).append(frame.name)
    for names in children.values():
        names.sort()
    return children
