"""Snapshot: the poses of all frames of a buffer at one instant, and their products to any frame.

Poses are multiplied as dual quaternions ``r + e d`` with ``d = t r / 2`` (Clifford 1873), by one bilinear
form. A view does this thirty times a second and sleeps in between, so that each operation of numpy finds its
code and data gone from the caches: the number of operations counts, not the size of the arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.frame_tree import Edge, TreeSnapshot
from zstate.buffer.history_view import HistoryView
from zstate.buffer.interpolation import rows_around
from zstate.buffer.path import ViewReader
from zstate.buffer.tracks import JointTrack, PoseTrack, Track
from zstate.errors import UnknownFrame, format_duration

Poses: TypeAlias = NDArray[np.float64]
Rows: TypeAlias = NDArray[np.intp]
Mask: TypeAlias = NDArray[np.bool_]
Duals: TypeAlias = NDArray[np.float64]
"""(N, 8): the rotation's quaternion x y z w, then the dual part in the same order."""
JointReader: TypeAlias = Callable[[HistoryView, JointTrack, int], NDArray[np.float64]]
"""The joint positions of a track at a stamp, of a view of its history that covers it."""

_IDENTITY = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class FrameTable:
    """The frames of a snapshot and their parents. Frame i is ``names[i]``; parents precede children.

    Tables are compared by identity: each change of the tree or of a writer makes a new one.
    ``parents[i]`` is the row of its parent, -1 for a root. ``kinds`` are those of ``FrameInfo``: joint,
    pose, static or root; ``writers`` are those of the edges, as far as known. ``robots`` are the tracks
    by name, of the robots with a model; ``tracks[i]`` is that of the edge of frame i, None if it never moves.
    """

    names: tuple[str, ...]
    parents: Rows
    kinds: tuple[str, ...]
    writers: tuple[str | None, ...]
    robots: Mapping[str, JointTrack] = field(default_factory=dict[str, JointTrack])
    tracks: tuple[Track | None, ...] = ()

    @cached_property
    def index(self) -> Mapping[str, int]:
        """The row of each frame."""
        return {name: row for row, name in enumerate(self.names)}

    @cached_property
    def roots(self) -> Rows:
        """The row of each frame's root."""
        roots = np.arange(len(self.names))
        for row, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                roots[row] = roots[parent]
        return roots

    @cached_property
    def tracks_of(self) -> Mapping[str, tuple[Track, ...]]:
        """The tracks on which the place of each robot depends, by name.

        That of its joints, or without a model those of the edges to its frames, ``robot/frame``; then those
        of the edges above. A moving edge below a link of its model is not among them.
        """
        found: dict[str, dict[Track, None]] = {name: {track: None} for name, track in self.robots.items()}
        roots = {track.frame(track.model.root): name for name, track in self.robots.items()}
        for row, name in enumerate(self.names):
            prefix, separator, _ = name.partition("/")
            without_model = prefix if separator and prefix not in self.robots else None
            robot = roots.get(name, without_model)
            if robot is not None:
                tracks = (self.tracks[above] for above in self._rows_up(row))
                found.setdefault(robot, {}).update((track, None) for track in tracks if track is not None)
        return {robot: tuple(tracks) for robot, tracks in found.items()}

    def _rows_up(self, row: int) -> Iterator[int]:
        """A row, that of its parent, and so on up to the root."""
        while row >= 0:
            yield row
            row = int(self.parents[row])

    @cached_property
    def moving(self) -> tuple[Track, ...]:
        """All tracks, each once."""
        tracks = (*self.robots.values(), *(track for track in self.tracks if track is not None))
        return tuple(dict.fromkeys(tracks))

    def row(self, name: str) -> int:
        """The row of a frame. Raises UnknownFrame."""
        try:
            return self.index[name]
        except KeyError:
            near = get_close_matches(name, self.names, n=3)
            raise UnknownFrame(name, name, name=name, near_misses=near, frame_count=len(self.names)) from None


@dataclass(frozen=True, eq=False)
class FramePoses:
    """The pose of every frame in its parent, at one instant.

    ``poses[i]`` is ``parent_from_child`` of frame i of ``tree``: (N, 7), x y z [m], qx qy qz qw; the
    identity for roots and where ``known[i]`` is False. The reason for an unknown pose is ``reasons[i]``.
    ``stamp`` is the instant [ns]; of the newest samples, the newest of all, and None when nothing moves.
    """

    stamp: int | None
    tree: FrameTable
    poses: Poses
    known: Mask
    reasons: Mapping[int, str] = field(default_factory=dict[int, str])

    def poses_in(self, fixed: str) -> Poses:
        """The pose of every frame in ``fixed``: (N, 7), NaN where no known edges connect the two.

        Row i is ``fixed_from_frame``; the array is read-only. Raises UnknownFrame.
        """
        poses = self._poses_by_fixed.get(fixed)
        if poses is None:
            row = self.tree.row(fixed)
            tops, top_from_frame = self._from_top
            poses = from_dual(compose(invert(top_from_frame[row : row + 1]), top_from_frame))
            poses[tops != tops[row]] = np.nan
            poses.flags.writeable = False
            self._poses_by_fixed[fixed] = poses
        return poses

    @property
    def tops(self) -> tuple[Rows, Poses]:
        """The row of the highest frame that known edges lead up to from each one, and its pose in that."""
        tops, top_from_frame = self._from_top
        return tops, from_dual(top_from_frame)

    def poses_side_by_side(self, fixed: str, offsets: Mapping[int, Sequence[float]]) -> Poses:
        """As ``poses_in``, with other trees placed at ``offsets``, though no edge connects them.

        ``offsets`` are by the rows of their roots: x, y, z [m] in the root of the fixed frame's tree.
        """
        row = self.tree.row(fixed)
        tops, poses = self.tops
        shifts = np.full((len(poses), 3), np.nan)
        for root, offset in offsets.items():
            shifts[root] = offset
        shifts[tops[row]] = 0.0
        poses[:, :3] += shifts[tops]
        placed = from_dual(compose(invert(self._from_top[1][row : row + 1]), to_dual(poses)))
        placed[np.isnan(shifts[tops, 0])] = np.nan
        return placed

    @cached_property
    def _poses_by_fixed(self) -> dict[str, Poses]:
        return {}

    @cached_property
    def _from_top(self) -> tuple[Rows, Duals]:
        """The highest frame that known edges lead up to, and ``top_from_frame``.

        Each round doubles how far up every frame has come, so that a deep tree needs few of them.
        """
        rows = np.arange(len(self.tree.names))
        up = np.where(self.known & (self.tree.parents >= 0), self.tree.parents, rows)
        duals = to_dual(self.poses)
        duals[up == rows] = _IDENTITY
        while (up[up] != up).any():
            duals, up = compose(duals[up], duals), up[up]
        return up, duals


class SnapshotReader:
    """Reads all frames of a tree; of ``robots`` only, with the frames above theirs, if there are any."""

    def __init__(self, tree: TreeSnapshot, robots: Collection[str] = ()) -> None:
        shown = _restrict(tree, robots) if robots else tree
        names = _parents_first(shown.edges)
        index = {name: row for row, name in enumerate(names)}
        edges = [shown.edges[name] for name in names]
        self.table = FrameTable(
            names,
            np.array([-1 if edge is None else index[edge.parent] for edge in edges], dtype=np.intp),
            tuple("root" if edge is None else edge.kind for edge in edges),
            tuple(None if edge is None else edge.writer for edge in edges),
            shown.robots,
            tuple(None if edge is None else edge.track for edge in edges),
        )
        self._version = tree.version
        static = [se3.IDENTITY if edge is None else edge.pose for edge in edges]
        self._static = np.array(static).reshape(-1, 7)
        places: dict[Track, list[tuple[int, int]]] = {}
        for row, edge in enumerate(edges):
            if edge is not None and edge.track is not None:
                places.setdefault(edge.track, []).append((row, edge.index))
        # By track: row ``rows[k]`` of the table is edge ``edges[k]`` of the track.
        self._parts = {track: np.array(pairs, dtype=np.intp).T for track, pairs in places.items()}
        self._writers = [track.writer for track in self._parts]

    def is_current(self, version: int) -> bool:
        """Whether tree and writers are unchanged. A writer may become known after its first samples."""
        return version == self._version and self._writers == [track.writer for track in self._parts]

    def read(
        self, read_views: ViewReader, joint_positions: JointReader, stamp: int | None, hold_ns: int
    ) -> FramePoses:
        """As ``TransformBuffer.snapshot``."""
        poses = self._static.copy()
        known = np.ones(len(poses), dtype=np.bool_)
        reasons: dict[int, str] = {}
        newest: list[int] = []
        views = read_views(tuple(self._parts))
        for (track, (rows, edges)), view in zip(self._parts.items(), views, strict=True):
            reason = _reason_against(track, view, stamp, hold_ns)
            if reason is None:
                poses[rows] = _edge_poses(joint_positions, track, view, stamp)[edges]
                newest.append(view.newest)
            else:
                known[rows] = False
                reasons.update(dict.fromkeys(rows.tolist(), reason))
        at = max(newest, default=None) if stamp is None else stamp
        return FramePoses(at, self.table, poses, known, reasons)


def _restrict(tree: TreeSnapshot, robots: Collection[str]) -> TreeSnapshot:
    """The frames of ``robots``, and all frames above them."""
    names: set[str] = set()
    for name in tree.edges:
        above: str | None = name if name.partition("/")[0] in robots else None
        while above is not None and above not in names:
            names.add(above)
            edge = tree.edges[above]
            above = None if edge is None else edge.parent
    edges = {name: edge for name, edge in tree.edges.items() if name in names}
    return TreeSnapshot(
        tree.version, edges, {name: track for name, track in tree.robots.items() if name in robots}
    )


def _parents_first(edges: Mapping[str, Edge | None]) -> tuple[str, ...]:
    """The names of all frames, parents before children, roots in the order of their first mention."""
    children: dict[str, list[str]] = {}
    for name, edge in edges.items():
        if edge is not None:
            children.setdefault(edge.parent, []).append(name)
    ordered: list[str] = []
    stack = [name for name in reversed(tuple(edges)) if edges[name] is None]
    while stack:
        name = stack.pop()
        ordered.append(name)
        stack += reversed(children.get(name, ()))
    return tuple(ordered)


def _reason_against(track: Track, view: HistoryView, stamp: int | None, hold_ns: int) -> str | None:
    """The reason why a track has no poses at ``stamp``, None if it has."""
    by = f" (writer {track.writer})" if track.writer else " (no writer)"
    if not view.size:
        kind = "joint sample" if isinstance(track, JointTrack) else "sample"
        return f"no {kind} of {track.name!r} received{by}"
    if stamp is None:
        return None
    if stamp < view.oldest:
        return f"{format_duration(view.oldest - stamp)} before the oldest sample of {track.name!r}{by}"
    if stamp > view.newest + hold_ns:
        return f"{format_duration(stamp - view.newest)} after the newest sample of {track.name!r}{by}"
    return None


def _edge_poses(joint_positions: JointReader, track: Track, view: HistoryView, stamp: int | None) -> Poses:
    """``parent_from_child`` of every edge of the track, at its own newest sample at the latest."""
    if stamp is None or stamp >= view.newest:
        last = view.rows[view.end - 1]
        if isinstance(track, PoseTrack):
            return track.poses(last)
        return track.kinematics.edge_poses(last[: track.model.position_count])
    if isinstance(track, PoseTrack):
        around = rows_around(view, stamp)
        assert around is not None  # the view covers the stamp
        before, after, ratio, _ = around
        first, second = (se3.unstack(track.poses(view.rows[row])) for row in (before, after))
        return np.stack(se3.normalize(se3.interpolate(first, second, ratio, se3.ARRAYS), se3.ARRAYS), axis=-1)
    return track.kinematics.edge_poses(joint_positions(view, track, stamp))


def to_dual(poses: Poses) -> Duals:
    """Poses (N, 7), x y z qx qy qz qw, as dual quaternions."""
    rotations = poses[:, 3:]
    return np.concatenate((rotations, 0.5 * _product(poses[:, :3], rotations, _VECTOR_FIRST)), axis=1)


def from_dual(duals: Duals) -> Poses:
    """The poses (N, 7) of dual quaternions of length one."""
    rotations, dual = duals[:, :4], duals[:, 4:]
    return np.concatenate((2.0 * _product(dual, rotations, _VECTOR), rotations), axis=1)


def compose(a_from_b: Duals, b_from_c: Duals) -> Duals:
    """a_from_c, row by row; a single row is multiplied with all of the other."""
    return _product(a_from_b, b_from_c, _DUAL)


def invert(a_from_b: Duals) -> Duals:
    """b_from_a."""
    return a_from_b * _CONJUGATE


def _product(first: NDArray[np.float64], second: NDArray[np.float64], form: NDArray[np.float64]) -> Duals:
    """``sum_ij form[i, j, k] first_i second_j`` of each row."""
    matrices = (first @ form.reshape(len(form), -1)).reshape(len(first), *form.shape[1:])
    return (second[:, None] @ matrices)[:, 0]


_UNITS: Any = np.eye(4).tolist()
_FORM = np.array([[se3.multiply(first, second) for second in _UNITS] for first in _UNITS])
_DUAL = np.zeros((8, 8, 8))
_DUAL[:4, :4, :4] = _DUAL[:4, 4:, 4:] = _DUAL[4:, :4, 4:] = _FORM
_CONJUGATE = np.array((-1.0, -1.0, -1.0, 1.0) * 2)
_VECTOR_FIRST = np.ascontiguousarray(_FORM[:3])
"""A vector times a quaternion."""
_VECTOR = np.ascontiguousarray((_FORM * _CONJUGATE[None, :4, None])[:, :, :3])
"""The vector part of a quaternion times the conjugate of another."""
