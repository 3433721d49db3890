"""Pose tracks: assigns the edges of inserted pose samples to tracks.

Edges that one publisher always sends together share a track, with one stamp column. The track is split
when one of them is inserted alone or withdrawn: an edge has one history, whichever writer sends it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.buffer.frame_tree import Edge, FrameTree
from zstate.buffer.tracks import PoseTrack, TrackOwner
from zstate.checks import QUATERNION_TOLERANCE, real_numbers
from zstate.errors import InsertRefused, InvalidInput
from zstate.transform import COVARIANCE_NUMBERS

EdgeNames: TypeAlias = tuple[str, str]
Poses: TypeAlias = NDArray[np.float64]
TrackRows: TypeAlias = list[tuple[PoseTrack, list[int]]]
"""Tracks, each with the rows of a sample that go into it, in the order of the track's edges."""


# Limit of the edges in the cache of orders: a writer may shuffle its edges from sample to sample.
_MAX_CACHED_EDGES = 100_000


class TooOld(Exception):
    """A sample is older than the history of one of its edges reaches; nothing was changed."""


class PoseTrackTable:
    """The tracks behind the edges that are inserted as poses. Used under the buffer's lock."""

    def __init__(self, tree: FrameTree, span_ns: int, owner: TrackOwner) -> None:
        self._tree = tree
        self._owner = owner
        self._span_ns = span_ns
        self._cache: dict[tuple[EdgeNames, ...], TrackRows] = {}
        self._cached_edges = 0
        # Samples whose edges are those of one track, in its order: nearly all.
        self._whole: dict[tuple[EdgeNames, ...], PoseTrack] = {}
        self._version = -1

    def whole_track(self, names: tuple[EdgeNames, ...]) -> PoseTrack | None:
        """The track of exactly these edges, in this order, if such a sample was inserted before."""
        return self._whole.get(names) if self._version == self._tree.version else None

    def track_rows(self, names: tuple[EdgeNames, ...], stamp: int, writer: str | None) -> TrackRows:
        """The tracks for a sample of these edges. Raises InsertRefused, or TooOld for too old a stamp."""
        if self._version != self._tree.version:
            self._clear()
        try:
            found = self._cache.get(names)
        except TypeError:  # of a list, which has no hash and is no name
            found = None
        if found is None:
            with self._tree.transaction():
                found = self._assign(names, stamp, writer)
            self._cached_edges += len(names)
            if self._version != self._tree.version or self._cached_edges > _MAX_CACHED_EDGES:
                self._clear()
            self._cache[names] = found
            if len(found) == 1 and found[0][1] == list(range(len(names))):
                self._whole[names] = found[0][0]
            self._version = self._tree.version
        _check_reached((track for track, _ in found), stamp)
        if writer is not None:
            for track, _ in found:
                track.writer = writer
        return found

    def _clear(self) -> None:
        self._cache.clear()
        self._whole.clear()
        self._cached_edges = 0

    def _assign(self, names: tuple[EdgeNames, ...], stamp: int, writer: str | None) -> TrackRows:
        edges = [self.check_edge(parent, child, writer) for parent, child in names]
        if len({child for _, child in edges}) < len(edges):
            raise InsertRefused(f"one child stands twice in {edges}", reason="second parent", edge=edges[0])
        existing = {id(track): track for track in map(self._track, edges) if track is not None}
        _check_reached(existing.values(), stamp)
        for track in existing.values():
            if sorted(track.edges) == sorted(edges):
                return [(track, [edges.index(edge) for edge in track.edges])]
        if not existing:
            return [(self._new_track(edges, writer), list(range(len(edges))))]
        for edge in edges:
            self.split_edge(edge)
        return [(self._track(edge) or self._new_track([edge], writer), [n]) for n, edge in enumerate(edges)]

    def check_edge(self, parent: str, child: str, writer: str | None) -> EdgeNames:
        """The edge that these names mean, if it is possible. Raises InsertRefused."""
        self._tree.check_names(parent, child)
        parent, child = self._tree.resolve_for_insert(parent), self._tree.resolve_for_insert(child)
        existing = self._tree.frames.get(child)
        if existing is not None and existing.robot is not None and existing.parent == parent:
            raise second_writer(parent, child, existing, writer)
        self._tree.check_edge(parent, child, writer)
        if existing is None:
            # Attached at once, so that the edges of one call are checked against each other.
            self._tree.attach(Edge(parent, child, "static", static_writer=writer))
        return parent, child

    def split_edge(self, edge: EdgeNames) -> None:
        """Move an edge that shares a track to a track of its own."""
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
        track.owner = self._owner
        for index, (parent, child) in enumerate(track.edges):
            self._tree.attach(Edge(parent, child, "pose", track=track, index=index))


def _check_reached(tracks: Iterable[PoseTrack], stamp: int) -> None:
    if not all(track.history.reaches(stamp) for track in tracks):
        raise TooOld


def second_writer(parent: str, child: str, existing: Edge, writer: str | None) -> InsertRefused:
    """The error for an edge that has another writer."""
    refused = f"; refused: {writer}" if writer else ""
    text = f"{parent!r} -> {child!r} is written by {existing.writer or 'hand'} already{refused}"
    return InsertRefused(f"{text}; one edge has one writer", reason="second writer", edge=(parent, child))


def check_poses(edges: Sequence[EdgeNames], poses: ArrayLike) -> Poses:
    """``poses`` as (N, 7), quaternions of length one. Raises InvalidInput or InsertRefused."""
    array = real_numbers(poses, "poses")
    if not edges or array.shape != (len(edges), 7):
        count = len(edges)
        raise InvalidInput(f"{count} edges take poses of shape ({count}, 7), at least one; got {array.shape}")
    with np.errstate(over="ignore", invalid="ignore"):  # the check below refuses the result
        x, y, z, w = (array[:, 3:] * array[:, 3:]).T
        norms: Poses = np.sqrt(x + y + z + w)  # in this order, as in the extension
    valid = np.isfinite(array).all(axis=1) & (np.abs(norms - 1.0) <= QUATERNION_TOLERANCE)
    if not valid.all():
        first = int(valid.argmin())
        parent, child = edges[first]
        text = (
            f"{parent!r} -> {child!r}: a pose is seven finite numbers, the last four a quaternion x y z w of "
            f"length 1; got {array[first].tolist()}"
        )
        raise InsertRefused(text, reason="not a pose", edge=(parent, child))
    return np.hstack((array[:, :3], array[:, 3:] / norms[:, None]))


def checked_rows(
    track: PoseTrack, poses: Sequence[Poses], covariances: Sequence[NDArray[np.float64] | None]
) -> NDArray[np.float64]:
    """Rows of the history of ``track``, of several instants of its edges. Raises InvalidInput."""
    count, edges = len(poses), len(poses) * track.edges
    rows = check_poses(edges, np.concatenate(poses)).reshape(count, -1)
    if not track.has_covariances:
        return rows
    from zstate.buffer.covariance_path import check_covariances  # noqa: PLC0415 - loaded, as it has some

    missing = np.full((len(track.edges), COVARIANCE_NUMBERS), np.nan)
    triangles = np.concatenate([missing if known is None else known for known in covariances])
    return np.hstack((rows, check_covariances(edges, triangles).reshape(count, -1)))
