"""Footing: the part of the tree that decides how two frames are connected, or that they are not."""

from __future__ import annotations

from typing import NamedTuple

from zstate.buffer.edge import Edge


class Footing(NamedTuple):
    """What was found in the tree; as long as the same is found again, the rest of it does not matter.

    ``names`` are those that were asked for, each with the frame it means, or None. ``edges`` are frames,
    each with what places it, or None. Edges are compared as objects: what replaces one is another.
    ``domains`` are the clock domains of moving edges, one edge for each track.
    """

    names: tuple[tuple[str, str | None], ...] = ()
    edges: tuple[tuple[str, Edge | None], ...] = ()
    domains: tuple[tuple[Edge, str | None], ...] = ()
