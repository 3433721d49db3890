"""Feeds: which track takes which edge of a sample of poses.

Edges that one publisher always gives together share a track, with one stamp column. When one of
them is fed alone, or withdrawn, the track is split: an edge is one history whoever feeds it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from zstate.buffer.edge import Edge
from zstate.buffer.tracks import Home, PoseTrack
from zstate.buffer.tree import Tree
from zstate.errors import InsertRefused

EdgeNames = tuple[str, str]
# Each track with the rows of a sample that it takes, in the order of the track's edges.
Feed = list[tuple[PoseTrack, list[int]]]


class TooOld(Exception):
    """A sample is older than the history of one of its edges reaches; nothing was changed."""


class Feeds:
    """The tracks behind the edges that are inserted as poses. Used under the buffer's lock."""

    def __init__(self, tree: Tree, span_ns: int, home: Home) -> None:
        self._tree = tree
        self._home = home
        self._span_ns = span_ns
        self._known: dict[tuple[EdgeNames, ...], Feed] = {}
        self._version = -1

    def of(self, names: tuple[EdgeNames, ...], stamp: int, writer: str | None) -> Feed:
        """Where a sample of these edges goes.

        Raises InsertRefused for an edge that cannot be, TooOld for a stamp beyond a history.
        """
        if self._version != self._tree.version:
            self._known.clear()
        try:
            feed = self._known.get(names)
        except TypeError:  # of a list, which has no hash and is no name
            feed = None
        if feed is None:
            with self._tree.untouched_on_error():
                feed = self._make(names, stamp, writer)
            if self._version != self._tree.version:
                self._known.clear()
            self._known[names] = feed
            self._version = self._tree.version
        _refuse_old((track for track, _ in feed), stamp)
        if writer is not None:
            for track, _ in feed:
                track.writer = writer
        return feed

    def _make(self, names: tuple[EdgeNames, ...], stamp: int, writer: str | None) -> Feed:
        edges = [self.admit(parent, child, writer) for parent, child in names]
        if len({child for _, child in edges}) < len(edges):
            raise InsertRefused(f"one child stands twice in {edges}", reason="second parent", edge=edges[0])
        owners = {id(track): track for track in map(self._track, edges) if track is not None}
        _refuse_old(owners.values(), stamp)
        for track in owners.values():
            if sorted(track.edges) == sorted(edges):
                return [(track, [edges.index(edge) for edge in track.edges])]
        if not owners:
            return [(self._new_track(edges, writer), list(range(len(edges))))]
        for edge in edges:
            self.separate(edge)
        return [(self._track(edge) or self._new_track([edge], writer), [n]) for n, edge in enumerate(edges)]

    def admit(self, parent: str, child: str, writer: str | None) -> EdgeNames:
        """The edge that these names mean, once it is known to be possible. Raises InsertRefused."""
        self._tree.check_names(parent, child)
        parent, child = self._tree.named_for_insert(parent), self._tree.named_for_insert(child)
        existing = self._tree.frames.get(child)
        if existing is not None and existing.robot is not None and existing.parent == parent:
            raise second_writer(parent, child, existing, writer)
        self._tree.check_edge(parent, child, writer)
        if existing is None:
            # Attached at once, so that the edges of one call are checked against each other.
            self._tree.attach(Edge(parent, child, "static", own_writer=writer))
        return parent, child

    def separate(self, edge: EdgeNames) -> None:
        """Give an edge a track of its own, if it shares one."""
        track = self._track(edge)
        if track is not None and len(track.edges) > 1:
            for single in track.split():
                self._attach(single)

    def _track(self, edge: EdgeNames) -> PoseTrack | None:
        existing = self._tree.frames.get(edge[1])
        track = existing.track if existing is not None else None
        return track if isinstance(track, PoseTrack) else None

    def _new_track(self, edges: Sequence[EdgeNames], writer: str | None) -> PoseTrack:
        track = PoseTrack(tuple(edges), self._span_ns, writer)
        self._attach(track)
        return track

    def _attach(self, track: PoseTrack) -> None:
        track.home = self._home
        for index, (parent, child) in enumerate(track.edges):
            self._tree.attach(Edge(parent, child, "pose", track=track, index=index))


def _refuse_old(tracks: Iterable[PoseTrack], stamp: int) -> None:
    if not all(track.history.reaches(stamp) for track in tracks):
        raise TooOld


def second_writer(parent: str, child: str, existing: Edge, writer: str | None) -> InsertRefused:
    """The refusal of an edge that somebody else gives already."""
    return InsertRefused(
        f"{parent!r} -> {child!r} is written by {existing.writer or 'hand'} already"
        f"{f'; refused: {writer}' if writer else ''}; one edge has one writer",
        reason="second writer",
        edge=(parent, child),
    )
