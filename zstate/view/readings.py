"""Readings: the poses of all frames of a buffer, read track by track."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.edge import Edge
from zstate.buffer.history import View
from zstate.buffer.layout import Layout
from zstate.buffer.tracks import JointTrack, PoseTrack, Track
from zstate.errors import InPast, InvalidInput, duration_text
from zstate.view.moment import Moment, Poses, Rows, Tree

HELD_NS = 500_000_000
"""So long beyond its newest sample a track is still drawn at that: robots end a recording one by one."""

Writers: TypeAlias = tuple[str | None, ...]


class Use(NamedTuple):
    """A track, and where its poses go: row ``rows[k]`` of a moment is edge ``edges[k]`` of the track."""

    track: Track
    rows: Rows
    edges: Rows


@dataclass(frozen=True, eq=False)
class Readings:
    """All of a buffer as it was laid out at ``version``, by ``writers``: one for each of ``uses``."""

    version: int
    writers: Writers
    tree: Tree
    uses: tuple[Use, ...]
    still: Poses

    def at(self, buffer: TransformBuffer, stamp: int | None) -> Moment:
        """Every pose at ``stamp`` [ns]; with None, that of each track's newest sample."""
        poses = self.still.copy()
        known = np.ones(len(poses), dtype=np.bool_)
        reasons: dict[int, str] = {}
        newest: list[int] = []
        for use in self.uses:
            view = use.track.history.view
            reason = _objection(use.track, view, stamp)
            if reason is None:
                poses[use.rows] = _read(buffer, use.track, view, stamp)[use.edges]
                newest.append(view.newest)
            else:
                known[use.rows] = False
                reasons.update(dict.fromkeys(use.rows.tolist(), reason))
        return Moment(max(newest, default=None) if stamp is None else stamp, self.tree, poses, known, reasons)


def readings_of(layout: Layout, writers: Writers) -> Readings:
    """How to read every frame of ``layout``."""
    names = _downwards(layout.edges)
    index = {name: row for row, name in enumerate(names)}
    edges = [layout.edges[name] for name in names]
    still = np.array([se3.IDENTITY if edge is None else edge.pose for edge in edges]).reshape(-1, 7)
    tree = Tree(
        names,
        np.array([-1 if edge is None else index[edge.parent] for edge in edges], dtype=np.intp),
        tuple("root" if edge is None else edge.kind for edge in edges),
        tuple(None if edge is None else edge.writer for edge in edges),
    )
    return Readings(layout.version, writers, tree, tuple(_uses(edges)), still)


def tracks_of(edges: Iterable[Edge | None]) -> tuple[Track, ...]:
    """The tracks behind all moving edges, once each."""
    moving = (edge.track for edge in edges if edge is not None and edge.track is not None)
    return tuple(dict.fromkeys(moving))


def _uses(edges: list[Edge | None]) -> Iterator[Use]:
    for track in tracks_of(edges):
        places = [(row, e.index) for row, e in enumerate(edges) if e is not None and e.track is track]
        rows, indices = np.array(places, dtype=np.intp).T
        yield Use(track, rows, indices)


def _downwards(edges: Mapping[str, Edge | None]) -> tuple[str, ...]:
    """The names of all frames, parents before children, robots as they were first mentioned."""
    below: dict[str, list[str]] = {}
    for name, edge in edges.items():
        if edge is not None:
            below.setdefault(edge.parent, []).append(name)
    ordered: list[str] = []
    waiting = [name for name in reversed(tuple(edges)) if edges[name] is None]
    while waiting:
        name = waiting.pop()
        ordered.append(name)
        waiting += reversed(below.get(name, ()))
    return tuple(ordered)


def _objection(track: Track, view: View, stamp: int | None) -> str | None:
    by = f" (writer {track.writer})" if track.writer else " (no writer)"
    if not view.size:
        what = "joint sample" if isinstance(track, JointTrack) else "sample"
        return f"no {what} of {track.name!r} has come{by}"
    if stamp is None:
        return None
    if stamp < view.oldest:
        return f"{duration_text(view.oldest - stamp)} before the oldest sample of {track.name!r}{by}"
    if stamp > view.newest + HELD_NS:
        return f"{duration_text(stamp - view.newest)} after the newest sample of {track.name!r}{by}"
    return None


def _read(buffer: TransformBuffer, track: Track, view: View, stamp: int | None) -> Poses:
    """``parent_from_child`` of every edge of the track, at its own newest sample at the latest."""
    if stamp is None or stamp >= view.newest:
        last = view.rows[view.end - 1]
        if isinstance(track, PoseTrack):
            return last.reshape(-1, 7)
        return track.kinematics.edge_poses(last[: track.model.position_count])
    if isinstance(track, PoseTrack):
        return _between(view, stamp)
    try:
        positions, _ = buffer.joint_positions(track, stamp)
    except (InPast, InvalidInput):  # the history has moved on meanwhile, or the robot was removed
        positions = view.rows[view.first, : track.model.position_count]
    return track.kinematics.edge_poses(positions)


def _between(view: View, stamp: int) -> Poses:
    stamps: NDArray[np.int64] = view.kept_stamps()
    after = max(int(stamps.searchsorted(stamp)), 1)
    before, later = view.kept_rows()[after - 1 : after + 1].reshape(2, -1, 7)
    ratio = (stamp - int(stamps[after - 1])) / int(stamps[after] - stamps[after - 1])
    pose = se3.interpolate(se3.columns(before), se3.columns(later), ratio, se3.ARRAYS)
    return np.stack(se3.normalize(pose, se3.ARRAYS), axis=-1)
