"""Storage and lookups of a transform buffer, without waiting (tf2 ``BufferCore``)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from numbers import Real
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.format import did_you_mean
from zstate.buffer.feed import BufferFeed
from zstate.buffer.frame_tree import Edge, FrameInfo, PathDependencies, TreePath
from zstate.buffer.history import insert_together, keep_only_around
from zstate.buffer.history_view import HistoryView
from zstate.buffer.path import TransformPath, compile_path
from zstate.buffer.pose_tracks import EdgeNames, Poses, TooOld, check_poses, second_writer
from zstate.buffer.tracks import JointTrack, PoseTrack, Track
from zstate.checks import check_names, name_problem
from zstate.clock import Clock, check_stamp
from zstate.errors import InsertRefused, InvalidInput
from zstate.model.robot import RobotModel
from zstate.transform import UPPER_TRIANGLE, Transform

# The number of pairs of frames whose paths are cached; more than any program uses on purpose.
_MAX_CACHED_PATHS = 4096

CachedPath: TypeAlias = tuple[int, Callable[[object], Transform | None], TransformPath, PathDependencies]
"""The version of the tree at which a path is valid, its ``at``, the path, and what it depends on.

A plain tuple, and ``at`` looked up before: a lookup by name unpacks it in a tenth of its time.
"""


class BufferCore:
    """Inserts and lookups. A refused insert changes nothing.

    Inserts may come from any thread; a lock serialises them. Lookups take no lock.
    """

    def __init__(self, history_s: float, clock: Clock | None) -> None:
        if not isinstance(history_s, Real) or not 0.0 < history_s < 1e9:
            raise InvalidInput(f"history_s is a positive number of seconds, not {history_s!r}")
        self.history_s = history_s
        self.ignored = 0
        """The number of samples that were older than the history reaches."""
        inserts = type(self).insert_joints, type(self).insert_many
        has_own_inserts = inserts != (BufferCore.insert_joints, BufferCore.insert_many)
        feed = self._feed = BufferFeed(round(history_s * 1e9), clock, has_own_inserts=has_own_inserts)
        self._lock, self._tree, self._owner = feed.lock, feed.tree, feed.owner
        self._pose_tracks, self._waiters = feed.pose_tracks, feed.waiters
        self._writes = 0
        self._paths: dict[tuple[str, str], CachedPath] = {}
        self._stop_reason = ""

    @property
    def clock(self) -> Clock:
        """The clock that ages are measured by."""
        return self._feed.clock

    def stop(self, reason: str) -> None:
        """No more samples will come: waits fail at once, and errors name the reason. Lookups go on."""
        self._stop_reason = self._stop_reason or reason

    def add_robot(self, model: RobotModel, prefix: str = "") -> JointTrack:
        """Add all links of ``model``; its fixed joints need no samples. Returns the track for the others.

        With a ``prefix`` the frames are named ``prefix/link``. Raises InsertRefused if one of the links has a
        parent already, InvalidInput for a prefix that cannot begin a frame name.
        """
        if prefix != "":
            if problem := name_problem(prefix):
                raise InvalidInput(f"the prefix of a robot begins its frames' names; {problem}")
            prefix = prefix.removesuffix("/")
        track = JointTrack(model, prefix, self._feed.span_ns)
        track.owner = self._owner
        with self._lock, self._tree.transaction():
            if prefix and self._tree.robots.get(prefix) is not None:
                text = f"there is a robot {prefix!r} in this buffer; remove_robot first"
                raise InsertRefused(text, reason="second writer", edge=(prefix, model.root))
            # One string for each frame, as the child of its edge and as the parent of others.
            frames = {link: track.frame(link) for link in model.links}
            self._tree.add_frame(frames[model.root])
            for index, form in enumerate(track.forms):
                parent, child = frames[form.parent], frames[form.child]
                existing = self._tree.frames.get(child)
                if existing is not None and existing.parent == parent:
                    raise second_writer(parent, child, existing, f"the model of {model.name!r}")
                self._tree.check_edge(parent, child, f"the model of {model.name!r}")
                if form.kind == "fixed":
                    edge = Edge(parent, child, "static", pose=form.origin, robot=track)
                else:
                    edge = Edge(parent, child, "joint", track=track, index=index, robot=track)
                self._tree.attach(edge)
            self._tree.robots[prefix] = track
        self._waiters.notify()
        return track

    def remove_robot(self, track: JointTrack) -> None:
        """Remove a robot's edges and history. Its frames stay, without a parent.

        Its track accepts no more samples. Raises InsertRefused for a track that is not of this buffer.
        """
        with self._lock:
            self._owner.check(track)
            track.owner = None
            track.history.close()
            for name, edge in list(self._tree.frames.items()):
                if edge is not None and edge.robot is track:
                    if edge.track is not None:
                        edge.track.owner = None
                    self._tree.detach(name)
            if self._tree.robots.get(track.prefix) is track:
                self._tree.robots[track.prefix] = None

    def insert_joints(
        self, track: JointTrack, stamp: int, positions: ArrayLike, velocities: ArrayLike | None = None
    ) -> bool:
        """One instant ``stamp`` [ns] of a robot, whose ``track`` is what ``add_robot`` returned.

        ``positions`` and ``velocities`` are in the order of its ``joint_names``. Positions may also be a
        block: the same as float64, little-endian, in bytes. True, or False if it is older than the history
        reaches, which ``ignored`` counts. A second sample of one stamp replaces the first. Raises
        InvalidInput for wrong counts, NaN and infinity, and for a floating joint's quaternion that is not of
        length one; InsertRefused for the track of a robot that was removed, or of another buffer.
        """
        with self._lock:
            if track.owner is not self._owner:
                self._owner.check(track)
            inserted = None
            if track.has_plain_joints:
                inserted = track.history.try_insert(stamp, positions, velocities, track.position_count)
        if inserted:
            # Nearly every sample ends here, without the call in between.
            self._waiters.notify(track)
            return True
        if inserted is not None:
            return self._count(inserted=False)
        stamp = check_stamp(stamp)
        checked = track.check_positions(positions)
        rates = None if velocities is None else track.model.check_velocities(velocities)
        with self._lock:
            self._owner.check(track)  # again: the robot may have been removed since
            had_velocities = track.has_velocities
            inserted = track.insert(stamp, checked, rates)
            if track.has_velocities != had_velocities:
                self._tree.invalidate(track)
        return self._count(track, inserted=inserted)

    def _robot_track(self, robot: str) -> JointTrack:
        """The track of a robot by its name. Raises InvalidInput, which names the most similar ones."""
        check_names(robot)
        with self._lock:
            track = self._tree.find_robot(robot)
            if track is None:
                names = self._tree.robot_names()
                known = f"its robots: {', '.join(map(repr, names))}" if names else "it has no robot"
                raise InvalidInput(
                    f"there is no robot {robot!r} in this buffer{did_you_mean(robot, names)} ({known})"
                )
        return track

    def insert(self, transform: Transform, *, writer: str | None = None) -> bool:
        """One sample of a moving edge: ``transform.target`` is the parent, ``source`` the child.

        True, or False if it is older than the history reaches. Raises InsertRefused for a transform
        without a stamp, a self edge, a loop, a second parent, or an edge of a robot's model.
        """
        edge = (transform.target, transform.source)
        if transform.stamp is None:
            text = f"{edge[0]!r} -> {edge[1]!r} has no stamp; use insert_static for an edge that never moves"
            raise InsertRefused(text, reason="no stamp", edge=edge)
        covariance = transform.covariance
        triangle = None
        if covariance is not None:
            import_module("zstate.buffer.covariance_path")  # here, not in a lookup later

            triangle = covariance[UPPER_TRIANGLE][None]
        return self._insert_poses((edge,), transform.stamp, transform.pose7[None], triangle, writer)

    def insert_many(
        self,
        edges: Sequence[EdgeNames],
        stamp: int,
        poses: ArrayLike,
        *,
        covariances: ArrayLike | None = None,
        writer: str | None = None,
    ) -> bool:
        """One instant of many moving edges, all or nothing: row i is ``parent_from_child`` of ``edges[i]``.

        ``stamp`` [ns] is that of all. ``poses`` is (N, 7), x y z [m], qx qy qz qw; or a block: the same as
        float64, little-endian, in bytes. ``covariances``, if known, is (N, 21): the upper triangle of
        ``Transform.covariance`` row by row, or a row of NaN. ``writer`` and all else as in ``insert``.
        """
        if covariances is None and isinstance(poses, bytes) and isinstance(edges, tuple):
            with self._lock:
                track = self._pose_tracks.whole_track(edges)
                inserted = None if track is None else track.history.try_insert_poses(stamp, poses)
                if inserted and track is not None:
                    track.writer = writer or track.writer
            if inserted and track is not None:
                self._waiters.notify(track)
                return True
            if inserted is not None:
                return self._count(inserted=False)
        if isinstance(poses, bytes):
            numbers = np.frombuffer(poses, "<f8", len(poses) // 8)
            poses = numbers if len(poses) % 56 else numbers.reshape(-1, 7)
        try:
            names = tuple((parent, child) for parent, child in edges)
        except (TypeError, ValueError):
            raise InvalidInput(f"edges are pairs (parent, child) of frame names; got {edges!r}") from None
        triangles = None
        if covariances is not None:
            from zstate.buffer.covariance_path import check_covariances  # noqa: PLC0415 - most edges have none

            triangles = check_covariances(names, covariances)
        return self._insert_poses(names, check_stamp(stamp), check_poses(names, poses), triangles, writer)

    def _insert_poses(
        self,
        names: tuple[EdgeNames, ...],
        stamp: int,
        poses: Poses,
        covariances: NDArray[np.float64] | None,
        writer: str | None,
    ) -> bool:
        with self._lock:
            try:
                parts = self._pose_tracks.track_rows(names, stamp, writer)
            except TooOld:
                return self._count(inserted=False)
            values: list[NDArray[np.float64]] = []
            for track, rows in parts:
                had_covariances = track.has_covariances
                values.append(track.row(poses[rows], None if covariances is None else covariances[rows]))
                if track.has_covariances != had_covariances:
                    self._tree.invalidate(track)
            if len(parts) == 1:
                parts[0][0].history.insert(stamp, values[0])
            else:
                # Odd while tracks disagree: a reader that sees it reads again under the lock.
                self._writes += 1
                insert_together(tuple(track.history for track, _ in parts), stamp, tuple(values))
                self._writes += 1
        return self._count(*(track for track, _ in parts), inserted=True)

    def _count(self, *tracks: Track, inserted: bool) -> bool:
        if inserted:
            self._waiters.notify(*tracks)
        else:
            with self._lock:
                self.ignored += 1
        return inserted

    def insert_static(self, transform: Transform, *, writer: str | None = None) -> None:
        """An edge that never moves, valid at every instant; its stamp is not used, nor is its covariance.

        Static edges count as exact: the covariance of a lookup is that of its moving edges. Replaces the
        earlier edge of the child on that parent. Raises InsertRefused as ``insert``.
        """
        with self._lock, self._tree.transaction():
            edge = self._pose_tracks.check_edge(transform.target, transform.source, writer)
            self._pose_tracks.split_edge(edge)
            pose = tuple(transform.pose7.tolist())
            self._tree.attach(Edge(*edge, "static", pose=pose, static_writer=writer))  # type: ignore[arg-type]
        self._waiters.notify()

    def withdraw(self, child: str) -> None:
        """Remove the edge that places ``child``, with its history; the frame stays.

        Raises InvalidInput for an unknown frame, InsertRefused for a link of a robot's model.
        """
        check_names(child)
        with self._lock:
            name = self._tree.resolve_for_insert(child)
            if name not in self._tree.frames:
                near = self._tree.names.near(child)()
                hint = f"; did you mean {' or '.join(map(repr, near))}?" if near else ""
                raise InvalidInput(f"there is no frame {child!r} to withdraw{hint}")
            edge = self._tree.frames[name]
            if edge is not None and edge.robot is not None:
                text = f"{name!r} is placed by {edge.writer}; remove_robot removes the whole robot"
                raise InsertRefused(text, reason="second writer", edge=edge.names)
            if edge is not None:
                self._pose_tracks.split_edge(edge.names)
            self._tree.detach(name)

    def clear(self) -> None:
        """Remove every sample. Frames, static edges and robots stay."""
        with self._lock:
            tracks = [track for track in self._tree.moving() if track.history.view.size]
            for track in tracks:
                track.history.clear()
        self._waiters.notify_restart(*tracks)

    def keep_only_around(self, stamps: NDArray[np.int64]) -> None:
        """Remove all samples but the first, the last, and those that lookups at ``stamps`` [ns] need.

        Lookups there stay the same, whatever is inserted later: so a history of any length fits
        into memory if few instants of it are needed.
        """
        with self._lock:
            for track in self._tree.moving():
                keep_only_around(track.history, stamps)

    def frames(self, among: Iterable[str] | None = None) -> tuple[FrameInfo, ...]:
        """All frames, in the order of their first mention; or those of the full names ``among``."""
        with self._lock:
            known = self._tree.frames
            names = known if among is None else [name for name in among if name in known]
            return tuple(map(self._tree.frame_info, names))

    def path_frames(self, target: str, source: str) -> list[tuple[str, FrameInfo | None]]:
        """The frames on the path from ``target`` to ``source``, each with the edge that leads to it.

        An edge is described by the frame that it places; ``target`` has None. Raises as ``plan``.
        """
        with self._lock:
            up, down, *_ = self._tree.path(target, source)
            info = self._tree.frame_info
            return [
                (self._tree.resolve(target, target, source), None),
                *((edge.parent, info(edge.child)) for edge in reversed(up)),
                *((edge.child, info(edge.child)) for edge in down),
            ]

    def _path(self, target: str, source: str, *, compiled: bool = True) -> TransformPath:
        """The cached path between two frames; a new one without the extension if not ``compiled``."""
        check_names(target, source)
        if compiled:
            return self._cached_path(target, source)[2]
        with self._lock:
            edges = self._tree.path(target, source)
            return self._compiled_path(target, source, edges, compiled=False)

    def _paths_of(self, *pairs: tuple[str, str]) -> list[TransformPath]:
        """The paths between pairs of frames, all of them of one state of the tree."""
        version = self._tree.version
        paths = [self._path(*pair) for pair in pairs]
        if self._tree.version == version:
            return paths
        with self._lock:
            return [self._path(*pair) for pair in pairs]

    def _cached_path(self, target: str, source: str) -> CachedPath:
        version, cached = self._tree.version, self._paths.get((target, source))
        if cached is not None and cached[0] == version:
            return cached
        if cached is not None and self._tree.is_current(cached[3]):
            cached = version, *cached[1:]
        else:
            with self._lock:
                edges = self._tree.path(target, source)
                path = self._compiled_path(target, source, edges)
                cached = self._tree.version, path.at, path, edges.dependencies
        if len(self._paths) >= _MAX_CACHED_PATHS:
            self._paths = {}
        self._paths[target, source] = cached
        return cached

    def _compiled_path(
        self, target: str, source: str, edges: TreePath, *, compiled: bool = True
    ) -> TransformPath:
        """The path over ``edges``; its transforms have covariances if all its edges can have them."""
        path = compile_path(target, source, edges, self._read_views, compiled=compiled)
        uncertain = [use.track for use in path.uses if isinstance(use.track, PoseTrack)]
        if uncertain and all(track.has_covariances for track in uncertain):
            # Loaded since the first covariance was inserted.
            from zstate.buffer.covariance_path import CovariancePath  # noqa: PLC0415

            return CovariancePath(path)
        return path

    def _read_views(self, tracks: Sequence[Track]) -> list[HistoryView]:
        """The views of several tracks at one moment between writes."""
        before = self._writes
        views = [track.history.view for track in tracks]
        if len(tracks) < 2 or (before == self._writes and not before & 1):
            return views
        with self._lock:
            return [track.history.view for track in tracks]
