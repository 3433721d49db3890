"""FrameInfo: what ``frames()`` tells of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from zstate.buffer.domain import Domain
from zstate.buffer.edge import Edge
from zstate.buffer.tracks import coverage


@dataclass(frozen=True, slots=True)
class FrameInfo:
    """What is known of one frame and of the edge that places it.

    ``kind`` is "joint" or "pose" for moving edges, "static", or "root" for a frame without a parent.
    Stamps are nanoseconds; they, ``rate_hz`` and ``count`` tell of the samples kept. ``domain`` is the clock
    domain of the stamps: "system", the name of a simulated time, or None if that is not known.
    """

    name: str
    parent: str | None
    kind: Literal["joint", "pose", "static", "root"]
    writer: str | None
    rate_hz: float | None
    oldest: int | None
    newest: int | None
    count: int
    domain: str | None = None

    def newest_in(self, domain: str) -> int | None:
        """The newest stamp [ns] if it can be compared with a clock of ``domain``, else None."""
        return self.newest if self.domain in (None, domain) else None


def frame_info(name: str, edge: Edge | None, domain: Domain) -> FrameInfo:
    """What the tree and a track say of one frame."""
    if edge is None:
        return FrameInfo(name, None, "root", None, None, None, None, 0)
    if edge.track is None:
        return FrameInfo(name, edge.parent, "static", edge.writer, None, None, None, 0)
    facts = coverage(edge.track.history.view)
    return FrameInfo(
        name,
        edge.parent,
        edge.kind,
        edge.writer,
        facts.rate_hz,
        facts.oldest,
        facts.newest,
        facts.count,
        domain.of_edge(edge) or None,
    )
