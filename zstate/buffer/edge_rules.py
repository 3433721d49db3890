"""The rule of a tree of frames that all checks share: no frame is placed on itself, and none in a loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from zstate.errors import InsertRefused


class Placement(Protocol):
    """What places a frame: on its ``parent``, by a ``writer``, None if that is not known."""

    @property
    def parent(self) -> str: ...

    @property
    def writer(self) -> str | None: ...


def loop_refusal(
    parent: str, child: str, writer: str | None, placement_of: Callable[[str], Placement | None]
) -> InsertRefused | None:
    """Why an edge of ``writer`` cannot be added: it would be its own parent, or close a loop; None if it can.

    ``placement_of(frame)`` is what places a frame now, None for a root. Edges that form a loop already, as
    those of several writers may, end the search.
    """
    if parent == child:
        text = f"{parent!r} -> {child!r}: a frame cannot be placed on itself"
        return InsertRefused(text, reason="self edge", edge=(parent, child))
    frame, ring = parent, {parent: None}
    while (above := placement_of(frame)) is not None and above.parent not in ring:
        ring[above.parent] = None
        if above.parent == child:
            path = " -> ".join(map(repr, reversed(ring)))
            text = (
                f"{parent!r} -> {child!r}{by(writer)} would close the loop {path} -> {child!r}; "
                f"{child!r} -> {frame!r} is written{by(above.writer) or ' by hand'}"
            )
            return InsertRefused(text, reason="loop", edge=(parent, child))
        frame = above.parent
    return None


def by(writer: str | None) -> str:
    """ " by WRITER", empty if it is not known."""
    return f" by {writer}" if writer else ""
