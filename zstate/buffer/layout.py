"""Layout: what places what, at one moment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from zstate.buffer.edge import Edge
from zstate.buffer.tracks import JointTrack


class Layout(NamedTuple):
    """Every frame with the edge that places it, and every robot with its track.

    For those who read all of a buffer at once. ``version`` is that of the buffer: while it stays, so
    does the layout. The samples behind an edge are those of ``edge.track.history``.
    """

    version: int
    edges: Mapping[str, Edge | None]
    robots: Mapping[str, JointTrack]
