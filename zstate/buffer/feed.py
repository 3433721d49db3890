"""The feed of a buffer: what its listener or recording does with it, besides inserts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.fork_safe import fork_safe
from zstate.buffer.clock_domain import ClockDomain
from zstate.buffer.frame_tree import Edge, FrameTree, TreeSnapshot
from zstate.buffer.history import FastPath, merged
from zstate.buffer.pose_tracks import EdgeNames, Poses, PoseTrackTable, TooOld, checked_rows
from zstate.buffer.tracks import ClockOffsets, JointTrack, PoseTrack, TrackOwner
from zstate.buffer.waiting import Waiter, WaiterRegistry
from zstate.clock import Clock, SystemClock
from zstate.errors import InsertRefused, InvalidInput


class _PastPoses(NamedTuple):
    """Instants of the edges of one track, newest first."""

    stamps: list[int]
    poses: list[Poses]
    covariances: list[NDArray[np.float64] | None]


class BufferFeed:
    """Parts of robots, names of frames, clock domains, samples of the past, and fast paths of one buffer.

    For the code that fills a buffer from a network or a file, which gets it from ``feed_of``. Samples are
    inserted by the methods of the buffer itself. Any method may be called from any thread.

    ``tree``, ``pose_tracks``, ``waiters`` and ``owner`` are the state of the buffer, which changes while
    ``lock`` is held. ``has_own_inserts`` is whether its class overrides the methods that insert samples, for
    instance to measure them: then no sample gets in by another way.
    """

    def __init__(self, span_ns: int, clock: Clock | None, *, has_own_inserts: bool) -> None:
        self.span_ns = span_ns
        self.clock = clock or SystemClock()
        """The clock of the buffer, by which it measures ages."""
        self.domain = ClockDomain(None if clock is None else clock.domain)
        """The clock domain of each robot."""
        self.tree = FrameTree(self.domain)
        self.owner = TrackOwner()
        self.pose_tracks = PoseTrackTable(self.tree, span_ns, self.owner)
        self.waiters = WaiterRegistry(self.tree)
        self.lock = fork_safe(threading.RLock())
        self._has_own_inserts = has_own_inserts

    @property
    def clock_offsets(self) -> ClockOffsets:
        """By writer: a function that returns how far its clock is ahead of this host's, None if not known."""
        return self.owner.clock_offsets

    def set_recording(self) -> None:
        """The samples come from a file: no sample is added later."""
        self.owner.is_recording = True

    def explain_unknown(self, hint: Callable[[int], str] | None) -> None:
        """Let errors about unknown frames end with ``hint(count)``, of the number of frames; "" is none."""
        self.tree.hint = hint

    def add_part(self, robot: JointTrack, joints: Sequence[str], writer: str | None = None) -> JointTrack:
        """A track for some ``joints`` of a robot, which one of its drivers publishes.

        Its positions are in the order of ``joints``. It moves no edge before ``assign_joints``. Raises
        InvalidInput as ``RobotModel.part``, InsertRefused for a track that is not of this buffer.
        """
        track = JointTrack(robot.model.part(joints), robot.prefix, self.span_ns)
        with self.lock:
            self.owner.check(robot)
            track.owner, track.writer, track.model_writer = self.owner, writer, robot.model_writer
        return track

    def assign_joints(self, robot: JointTrack, parts: Mapping[str, JointTrack]) -> None:
        """Set which of a robot's parts moves which of its driven joints; the track ``robot`` moves the rest.

        Lookups read each joint, and the joints that mimic it, from the samples of its own part. Raises
        InsertRefused for a track that is not of this buffer.
        """
        with self.lock:
            self.owner.check(robot)
            robot.parts = dict(parts)
            for form, joint in zip(robot.forms, robot.model.joints, strict=True):
                parent, child = robot.edge(form)
                edge = self.tree.frames[child]
                track = parts.get(robot.model.mimic_of(joint).joint, robot)
                if form.kind != "fixed" and (edge is None or edge.track is not track):
                    index = [part.name for part in track.model.joints].index(joint.name)
                    self.tree.attach(Edge(parent, child, "joint", track=track, index=index, robot=robot))
        self.waiters.notify()

    def name_robot(self, prefix: str) -> None:
        """Let inserts use bare names for frames ``prefix/...``, as they may for a robot's."""
        with self.lock:
            self.tree.robots.setdefault(prefix, None)

    def add_frames(self, names: Iterable[str]) -> None:
        """Add frames by their full names, so that these names mean no robot's frames."""
        with self.lock:
            for name in names:
                self.tree.add_frame(name)

    def edge_named(self, names: EdgeNames) -> EdgeNames:
        """The full names of an edge, as an insert resolves them; a name that is not unique is unchanged."""
        with self.lock, suppress(InsertRefused):
            return self.tree.resolve_for_insert(names[0]), self.tree.resolve_for_insert(names[1])
        return names

    def set_domain(self, robot: str, domain: str) -> bool:
        """Set the clock ``domain`` that stamps the samples of ``robot``. Returns whether that is a change."""
        return self._note_domain(lambda: self.domain.set(robot, domain))

    def set_measured_domain(self, robot: str, domain: str, ahead_ns: int = 0) -> bool:
        """``ClockDomain.set_measured``."""
        return self._note_domain(lambda: self.domain.set_measured(robot, domain, ahead_ns))

    def _note_domain(self, change: Callable[[], bool]) -> bool:
        with self.lock:
            changed = change()
            if changed:
                self.tree.version += 1
        if changed:
            self.waiters.notify()
        return changed

    def insert_past_joints(
        self, track: JointTrack, samples: Iterable[tuple[int, ArrayLike, ArrayLike | None]]
    ) -> int:
        """Insert instants of a robot, newest first, all of them with one copy of its history.

        An instant is a stamp [ns], positions and velocities, as ``insert_joints`` takes them.

        Returns how many were inserted: those before the first one that ``insert_joints`` has to handle, as
        it is not older than the one before it, or not usable, or because the row has no column for it. None
        is inserted if all that the track has is newer: then each insert costs the same. Raises InsertRefused
        as ``insert_joints``.
        """
        stamps: list[int] = []
        rows: list[NDArray[np.float64]] = []
        with self.lock:
            self.owner.check(track)
            oldest, newest = track.history.oldest, track.history.newest
            if oldest is None or newest is None or self._has_own_inserts:
                return 0
            for stamp, positions, velocities in samples:
                newest = max(newest, stamp)
                is_next = not stamps or stamp < stamps[-1]
                if not is_next or stamp < newest - track.history.span_ns:
                    break
                if velocities is not None and not track.has_velocities:
                    break
                try:
                    rates = None if velocities is None else track.model.check_velocities(velocities)
                    rows.append(track.row(track.check_positions(positions), rates))
                except InvalidInput:
                    break
                stamps.append(stamp)
            if not stamps or stamps[0] < oldest:
                return 0
            times = np.array(stamps[::-1], dtype=np.int64)
            track.history = merged(track.history, times, np.array(rows[::-1]))
            self.tree.invalidate(track)
        self.waiters.notify(track)
        return len(stamps)

    def insert_past_poses(
        self,
        samples: Iterable[tuple[tuple[EdgeNames, ...], int, Poses, NDArray[np.float64] | None]],
        writer: str | None = None,
    ) -> int:
        """Insert instants of moving edges, newest first, all of them with one copy of each history.

        An instant is edges, a stamp [ns], poses (N, 7) and covariances (N, 21), as for ``insert_many``.

        Returns how many were inserted: those before the first one that ``insert_many`` has to handle, as it
        is not older than the one before it of its edges, or because the row has no columns for it, or its
        edges are in several tracks. None is inserted if all that the tracks have is newer. Raises
        InvalidInput if one is not usable; then none is inserted.
        """
        past: dict[PoseTrack, _PastPoses] = {}
        count = 0
        with self.lock:
            version = self.tree.version
            for edges, stamp, poses, covariances in () if self._has_own_inserts else samples:
                try:
                    (track, rows), *others = self.pose_tracks.track_rows(edges, stamp, writer)
                except TooOld:
                    break
                if others or (covariances is not None and not track.has_covariances):
                    break
                of_track = past.get(track) or _PastPoses([], [], [])
                stamps = of_track.stamps
                if stamps and not stamps[0] - track.history.span_ns <= stamp < stamps[-1]:
                    break
                past[track] = of_track
                stamps.append(stamp)
                of_track.poses.append(poses[rows])
                of_track.covariances.append(None if covariances is None else covariances[rows])
                count += 1
            oldest = {track: track.history.oldest for track in past}
            is_between = any(at is not None and past[track].stamps[0] >= at for track, at in oldest.items())
            if not is_between or self.tree.version != version:
                return 0
            blocks = {track: checked_rows(track, one.poses, one.covariances) for track, one in past.items()}
            for track, one in past.items():
                times = np.array(one.stamps[::-1], dtype=np.int64)
                track.history = merged(track.history, times, blocks[track][::-1])
                self.tree.invalidate(track)
        self.waiters.notify(*past)
        return count

    def fast_path(self, counts: dict[str, int], *sources: object) -> FastPath[Waiter]:
        """A fast path into this buffer for the messages of one writer, see ``FastPath``."""
        return self.waiters.fast_path(counts, *sources)

    def expect_next(
        self,
        fast_path: FastPath[Waiter],
        place: JointTrack | tuple[EdgeNames, ...],
        message: bytes,
        *versions: int,
    ) -> None:
        """Let ``fast_path`` insert the message after ``message``, whose sample was inserted just now.

        ``place`` is the track of its joints, or its edges. None is expected if the samples need further
        checks: those of floating joints, of edges in several tracks, or any unless the clock is the system's.
        """
        if type(self.clock) is not SystemClock or self._has_own_inserts:
            return
        if not isinstance(place, JointTrack):
            track = self.pose_tracks.whole_track(place)
        else:
            track = place if place.has_plain_joints else None
        if track is not None:
            self.waiters.expect_next(fast_path, track, message, versions)

    def restart(self, track: JointTrack | PoseTrack) -> None:
        """Begin a new epoch: remove the samples of one track, because its writer or its clock restarted.

        Raises InsertRefused for a track that is not of this buffer.
        """
        with self.lock:
            self.owner.check(track)
            track.history.clear()
        self.waiters.notify_restart(track)

    def edge_of(self, frame: str) -> Edge | None:
        """The edge that places a frame, by its full name."""
        with self.lock:
            return self.tree.frames.get(frame)

    def is_model_root(self, frame: str) -> bool:
        """Whether a frame, by its full name, is the root of a robot's model."""
        with self.lock:
            ends = (at for at, letter in enumerate(frame) if letter == "/")
            tracks = (self.tree.robots.get(frame[:end]) for end in (0, *ends))
            return any(track is not None and track.frame(track.model.root) == frame for track in tracks)

    def edges_between(self, target: str, source: str) -> list[Edge]:
        """The edges on the path between two frames. Raises as ``TransformBuffer.plan``.

        An edge that changes is replaced by another object.
        """
        with self.lock:
            to_target, to_source, *_ = self.tree.path(target, source)
            return [*to_target, *to_source]

    def tree_snapshot(self) -> TreeSnapshot:
        """All frames with their edges and all robots with their tracks."""
        with self.lock:
            return self.tree.snapshot()

    def use_clock(self, clock: Clock) -> None:
        """Measure ages with ``clock``. Raises InvalidInput if a clock of another domain was given before."""
        given = self.domain.given
        if given not in (None, clock.domain):
            raise InvalidInput(
                f"the buffer was given a clock of {given!r} time, and now one of {clock.domain!r} time; "
                "give both the same, or a buffer without a clock"
            )
        self.clock, self.domain.given = clock, clock.domain
        self.tree.version += 1  # ends the fast paths, which compare stamps with the system's clock
