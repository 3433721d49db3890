"""Time-indexed transform buffer: exact lookups, or an error that says why not."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import AsyncIterable, Callable, Collection
from contextlib import suppress
from functools import partial
from numbers import Real
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple, NoReturn, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.tf2_methods import with_tf2_methods
from zstate.buffer.core import BufferCore
from zstate.buffer.feed import BufferFeed
from zstate.buffer.history_view import HistoryView
from zstate.buffer.path import TransformPath, transforms_at_one_moment
from zstate.buffer.robot_joints import RobotJoints
from zstate.buffer.tracks import JointTrack, TimeSpan, Track
from zstate.buffer.waiting import RequiredStamps, Waiter, WakeCondition
from zstate.checks import Points, check_names, check_points
from zstate.clock import Clock, check_stamp, check_stamps, check_stamps_of_points, wait_interruptible
from zstate.errors import (
    AmbiguousFrame,
    ClockMismatch,
    Closed,
    Disconnected,
    InFuture,
    InPast,
    InvalidInput,
    LookupFailed,
    NotFinite,
    Stale,
    UnknownFrame,
    as_timeout,
)
from zstate.transform import Transform, Twist

if TYPE_CHECKING:
    from zstate.buffer.interpolation_bound import InterpolationBound
    from zstate.buffer.message_filter import MessageFilter
    from zstate.buffer.plan import Plan
    from zstate.buffer.projection import ProjectingCamera
    from zstate.buffer.snapshot import FramePoses, FrameTable, SnapshotReader
    from zstate.buffer.watch import TransformWatch
    from zstate.model.joint_history import JointHistory

S = TypeVar("S")

DEFAULT_HISTORY_S = 10.0
"""What buffers and listeners keep by default; as in tf2."""

RECORDING_HISTORY_S = 9e8
"""What buffers of a whole recording keep: 28 years, on any clock."""

# The number of choices of robots whose snapshot readers are cached.
_MAX_CACHED_READERS = 16


# No stamp of 64 bits is further away.
_MAX_PREDICTION_S = 2e10

# Errors that only a change of the tree can end.
_NO_PATH = (UnknownFrame, AmbiguousFrame, Disconnected, ClockMismatch)


class Query(NamedTuple):
    """The checked arguments of a lookup."""

    target: str
    source: str
    at: int | None
    predict_ns: int = 0
    max_age_s: float | None = None


@with_tf2_methods
class TransformBuffer(BufferCore):
    """The recent history of frames, and exact lookups in it.

    ``lookup("a", "b")`` is ``a_from_b``: the pose of b in a, which maps coordinates in b into a.
    ``history_s`` [s] is kept for each track, counted back from its own newest sample. Only ``max_age_s``
    reads the ``clock`` (default: the system's). Any method may be called from any thread.
    """

    def __init__(self, history_s: float = DEFAULT_HISTORY_S, clock: Clock | None = None) -> None:
        super().__init__(history_s, clock)
        self._snapshot_readers: dict[frozenset[str], SnapshotReader] = {}
        # Those of one version of the tree, by the robot's track and whether its parts are read.
        self._joint_readers: tuple[int, dict[tuple[JointTrack, bool], RobotJoints]] = (0, {})

    def __repr__(self) -> str:
        robots = [repr(track.name) for track in list(self._tree.robots.values()) if track is not None]
        more = f" and {len(robots) - 3} more" if len(robots) > 3 else ""
        named = f" of {', '.join(robots[:3])}{more}" if robots else ""
        kept = "of a recording" if self._owner.is_recording else f"{self.history_s:g} s of history"
        return f"<TransformBuffer: {len(self._tree.frames)} frames{named}, {kept}>"

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            "a TransformBuffer is not copied or pickled: it is filled by threads of its process. Open a "
            "TransformListener or a Recording in each process, or pass the arrays of lookup_many"
        )

    def lookup(
        self,
        target: str,
        source: str,
        at: int | None = None,
        *,
        timeout_s: float = 0.0,
        max_age_s: float | None = None,
        predict_s: float = 0.0,
    ) -> Transform:
        """The pose of ``source`` in ``target`` at the stamp ``at`` [ns].

        - ``at``: the stamp [ns]; None: the newest instant that every moving edge between the frames has
          reached. On a path of static edges only, the transform then has no stamp.
        - ``timeout_s``: how long to wait for frames and samples that are missing.
        - ``max_age_s``: an older transform is an error, Stale.
        - ``predict_s``: how long after the newest sample an instant may be, from published velocities; such
          transforms are of kind "predicted".

        The transform has a ``covariance`` if its path has edges whose samples have covariances, and all other
        edges are exact: static, or joints of a model. A moving edge without a covariance leaves it None:
        unknown is not zero. So does a prediction.

        Raises UnknownFrame, AmbiguousFrame, Disconnected, ClockMismatch, NoData, InPast, InFuture, Stale or
        NotFinite, all of them LookupFailed; after a wait also a TimeoutError. Raises InvalidInput for names
        that cannot be frame names.
        """
        if max_age_s is None and timeout_s == 0.0 and predict_s == 0.0:
            try:
                version, find, path, _ = self._paths[target, source]
            except (KeyError, TypeError):  # TypeError of a list, which has no hash and is no name
                pass
            else:
                if version == self._tree.version:
                    transform = find(at)
                    if transform is not None:
                        return transform
                    if not self._stop_reason:
                        path.raise_if_outside(at)
        query = self._query(target, source, at, predict_s=predict_s, max_age_s=max_age_s)
        if check_duration("timeout_s", timeout_s) > 0.0 and not self._stop_reason:
            return self._wait(query, timeout_s)
        return self._lookup(query)

    def lookup_between(
        self, target: str, target_at: int | None, source: str, source_at: int | None, fixed: str
    ) -> Transform:
        """The pose of ``source`` at ``source_at`` in ``target`` at ``target_at`` (tf2's advanced form).

        ``fixed`` is assumed not to move between the two. None for an instant is the newest of that side. The
        transform has the target side's stamp, and no covariance: the errors of one edge at two instants are
        not independent, and how much of them is common is not known.
        """
        check_names(target, source, fixed)
        for name in (target, source, fixed):
            self._tree.resolve(name, target, source)
        # A missing connection, or two clocks, are reported before a bad time, on either side.
        of_source, _, of_target = self._paths_of((fixed, source), (target, source), (target, fixed))
        target_at = None if target_at is None else check_stamp(target_at)
        source_at = None if source_at is None else check_stamp(source_at)
        try:
            target_from_fixed, fixed_from_source = transforms_at_one_moment(
                of_target, target_at, of_source, source_at
            )
        except LookupFailed as reason:
            self._complete(reason, None)
            raise
        try:
            both = target_from_fixed @ fixed_from_source
        except InvalidInput:  # a product of large numbers
            raise NotFinite(target, source, requested=target_at) from None
        pose = tuple(both.pose7.tolist())
        return Transform.trusted(target, source, pose, target_from_fixed.stamp, both.kind)

    def lookup_many(
        self, target: str, source: str, stamps: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """pose7 of ``source`` in ``target`` at each stamp: (T, 7), and which are valid: (T,).

        Rows without a transform are NaN. Stamps are integers [ns] or datetime64[ns]. Raises UnknownFrame,
        AmbiguousFrame, Disconnected and ClockMismatch.
        """
        return self._path(target, source).poses(check_stamps(stamps))

    def place(
        self, points: ArrayLike, stamps: ArrayLike, source: str, target: str
    ) -> tuple[Points, NDArray[np.bool_]]:
        """``points`` of ``source``, each in ``target`` at its own stamp: (N, 3), and which are valid: (N,).

        ``points`` are (N, 3) x y z [m], float32 or float64, as is the result. ``stamps`` [ns] are (N,) in any
        order, or one for all. A scan of a moving lidar is placed without distortion::

            points_in_odom, valid = buffer.place(points, stamps, source="laser", target="odom")

        Rows with NaN or infinity are no points, such as rays without a measurement (``Scan.points``). They,
        and rows without a transform, are NaN and not valid; ``explain(target, source, int(stamp))`` is the
        reason of the latter, for the stamp of a row. Raises UnknownFrame, AmbiguousFrame, Disconnected and
        ClockMismatch, and InvalidInput for other shapes and types.
        """
        path = self._path(target, source)
        array = check_points(points)
        return path.place(array, check_stamps_of_points(stamps, len(array)))

    def project(
        self, points: ArrayLike, frame: str, camera: ProjectingCamera, stamp: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """``points`` of ``frame`` in a picture of ``camera``: pixels (N, 2), and which are valid: (N,).

        ``points`` are (N, 3) x y z [m], pixels u v as ``camera.project`` defines them. ``stamp`` [ns] is that
        of the picture, the instant of its first row. If the camera has a ``line_time_ns``, each point is
        taken at the instant of the row in which it appears, also if ``frame`` moves::

            pixels, valid = buffer.project([[0.0, 0.0, 0.0]], "hand", picture.camera, picture.stamp)

        Points that the camera does not see, without a transform at their instant, or that are not finite,
        are NaN and not valid. Raises as ``place`` does.
        """
        from zstate.buffer.projection import project_rows  # noqa: PLC0415 - cameras load it

        path = self._path(camera.frame, frame)
        array = check_points(points).astype(np.float64, copy=False)  # as float32 it would be 1e-4 px

        def place(stamps: NDArray[np.int64]) -> tuple[Points, NDArray[np.bool_]]:
            return path.place(array, stamps)

        return project_rows(place, camera, check_stamp(stamp), len(array))

    def plan(self, target: str, source: str) -> Plan:
        """Compiled lookup of one pair of frames. Raises as ``lookup`` for unknown frames."""
        from zstate.buffer.plan import Plan  # noqa: PLC0415 - of the loops that have one

        return Plan(target, source, self._tree, lambda: self._path(target, source))

    def twist(self, frame: str, reference: str, at: int | None = None) -> Twist:
        """The velocity of ``frame`` in ``reference``: d/dt of ``reference_from_frame``.

        Linear at the frame's origin, both vectors in the axes of ``reference``. Exact from published
        velocities where there are any, else the slope between the samples around the instant. Raises
        as ``lookup``, and NoData if there is one sample only, without velocities.
        """
        query = self._query(reference, frame, at)
        motion, stamp = self._path(reference, frame).motion(query.at)
        return Twist(frame, reference, motion.linear, motion.angular, stamp)

    def interpolation_bound(self, target: str, source: str, at: int | None = None) -> InterpolationBound:
        """How far the pose that ``lookup`` returns can be from the true one, by joint velocity limits.

        Samples that arrive thinned are interpolated over long intervals. Raises as ``lookup``.
        """
        from zstate.buffer.interpolation_bound import interpolation_bound  # noqa: PLC0415 - for few programs

        stamp = self.lookup(target, source, at).stamp
        with self._lock:
            to_target, to_source, *_ = self._tree.path(target, source)
        return interpolation_bound((*to_target, *to_source), 0 if stamp is None else stamp)

    def latest(self, target: str, source: str) -> int:
        """The newest stamp [ns] that every moving edge between the frames has reached.

        Raises NoData if every edge is static, and Stale if the history of one edge begins after the last
        sample of another, which is silent.
        """
        return self._path(target, source).latest_common_stamp()

    def can_lookup(self, target: str, source: str, at: int | None = None) -> bool:
        """Whether ``lookup`` would succeed now. Raises InvalidInput for invalid names and stamps."""
        reason = self.explain(target, source, at)
        if isinstance(reason, InvalidInput):
            raise reason
        return reason is None

    def explain(self, target: str, source: str, at: int | None = None) -> LookupFailed | InvalidInput | None:
        """The error ``lookup`` would raise now, or None if it would succeed. Never raises one.

        InvalidInput is returned for invalid names and stamps.
        """
        try:
            self._lookup(self._query(target, source, at))
        except (LookupFailed, InvalidInput) as reason:
            return reason
        return None

    def wait(self, target: str, source: str, at: int | None = None, timeout_s: float = 1.0) -> Transform:
        """``lookup(target, source, at)`` once it succeeds; waits for unknown and unconnected frames, too.

        Raises at once if waiting cannot help: InPast for an ``at`` more than ``history_s`` before the
        newest sample of an edge, and every error in a process forked from that of the listener which fills
        this buffer. Later samples may still come: late ones are sorted in, and a listener that has
        just opened requests history from the writers. After ``timeout_s`` raises the reason of the last
        try, as an error that is also a TimeoutError.
        """
        query, timeout_s = self._query(target, source, at), check_duration("timeout_s", timeout_s)
        return self._lookup(query) if self._stop_reason else self._wait(query, timeout_s)

    async def wait_async(
        self, target: str, source: str, at: int | None = None, timeout_s: float = 1.0
    ) -> Transform:
        """``wait(target, source, at, timeout_s)`` for asyncio: it does not block the loop.

        Cancelling the task ends it.
        """
        import asyncio  # noqa: PLC0415  # a caller has it already, and others do not need it

        query = self._query(target, source, at)
        if self._stop_reason:
            return self._lookup(query)
        loop, event = asyncio.get_running_loop(), asyncio.Event()
        deadline = loop.time() + check_duration("timeout_s", timeout_s)

        def wake() -> None:
            # The loop may be closed by the time an insert wakes its tasks.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(event.set)

        with self._waiters.register(wake) as waiter:
            while True:
                event.clear()
                outcome = self._lookup_or_expect(query, waiter)
                if isinstance(outcome, Transform):
                    return outcome
                try:
                    await asyncio.wait_for(event.wait(), deadline - loop.time())
                except TimeoutError:
                    raise as_timeout(outcome, timeout_s) from None

    def _wait(self, query: Query, timeout_s: float) -> Transform:
        event = threading.Event()
        deadline = time.monotonic() + timeout_s
        with self._waiters.register(event.set) as waiter:
            while True:
                event.clear()
                outcome = self._lookup_or_expect(query, waiter)
                if isinstance(outcome, Transform):
                    return outcome
                if not wait_interruptible(event, deadline - time.monotonic()):
                    raise as_timeout(outcome, timeout_s)

    def _query(
        self,
        target: str,
        source: str,
        at: int | None,
        *,
        predict_s: float = 0.0,
        max_age_s: float | None = None,
    ) -> Query:
        check_names(target, source)
        if max_age_s is not None:
            check_duration("max_age_s", max_age_s)
        predict_ns = round(check_duration("predict_s", predict_s, _MAX_PREDICTION_S) * 1e9)
        return Query(target, source, None if at is None else check_stamp(at), predict_ns, max_age_s)

    def _lookup(self, query: Query) -> Transform:
        try:
            path = self._cached_path(query.target, query.source)[2]
            transform = path.transform(query.at, query.predict_ns)
        except LookupFailed as reason:
            self._complete(reason, query.at)
            raise
        if query.max_age_s is None:
            return transform
        ahead_s = 0.0
        if path.domain in ("", self.clock.domain):
            pass
        elif (ahead_ns := self._tree.domain.ahead_ns(path.domain)) is not None:
            ahead_s = ahead_ns * 1e-9
        else:
            edge, names, domains = (
                path.uses[0].edge,
                (path.target, path.source),
                (path.domain, self.clock.domain),
            )
            robot = self._tree.domain.robot_placing(edge[1])
            raise ClockMismatch(*names, edges=(edge,), robots=(robot,), domains=domains)
        if path.uses and transform.age(self.clock) + ahead_s > query.max_age_s:
            # Once more, of samples that the error describes.
            views = path.views()
            transform = path.transform_in(views, query.at, query.predict_ns)
            age_s = transform.age(self.clock) + ahead_s
            if age_s > query.max_age_s:
                raise path.stale(views, transform.stamp, age_s, query.max_age_s)
        return transform

    def _complete(self, reason: LookupFailed, at: int | None) -> None:
        """Add to a lookup's error what the path does not know: the instant, and why no samples will come."""
        if reason.requested is None:
            reason.requested = at
        if self._stop_reason:
            reason.ended = self._stop_reason

    def _lookup_or_expect(self, query: Query, waiter: Waiter) -> Transform | LookupFailed:
        """The transform, or the reason that ``waiter`` expects to end. Raises one that no insert can end."""
        version = self._tree.version
        try:
            return self._lookup(query)
        except LookupFailed as reason:
            return self._expect_change(query, reason, waiter, version)

    def _lookup_newest(self, query: Query, waiter: Waiter) -> Transform | LookupFailed:
        """The newest transform, with ``waiter`` expecting a newer one; else as ``_lookup_or_expect``."""
        version = self._tree.version
        try:
            *_, path, dependencies = self._cached_path(query.target, query.source)
            transform = path.at(None) or path.transform(None)
        except LookupFailed as reason:
            return self._expect_change(query, reason, waiter, version)
        stamp = transform.stamp
        after = None if stamp is None else stamp + 1
        condition = WakeCondition(dependencies, {use.track: after for use in path.uses})
        waiter.expect(condition, version, None if stamp is None else path.newer_than(stamp, version))
        return transform

    def _expect_change(
        self, query: Query, reason: LookupFailed, waiter: Waiter, version: int
    ) -> LookupFailed:
        condition = WakeCondition()
        if isinstance(reason, _NO_PATH):
            with self._lock:
                condition = WakeCondition(self._tree.dependencies(query.target, query.source))
        else:
            with suppress(LookupFailed):  # the tree has changed since, which its version shows
                *_, path, dependencies = self._cached_path(query.target, query.source)
                condition = WakeCondition(dependencies, _required_stamps(query, reason, path), query.at)
        waiter.expect(condition, version)
        if _is_final(query, reason, condition):
            raise reason
        return reason

    def watch(
        self,
        target: str,
        source: str,
        callback: Callable[[Transform], object],
        *,
        translation_m: float | None = None,
        rotation_rad: float | None = None,
    ) -> TransformWatch:
        """Call ``callback(transform)`` with each newest pose of ``source`` in ``target``.

        That ends when the watch is closed. With ``translation_m`` or ``rotation_rad``, only once the source
        has moved or rotated so far since the last call. The frames need not exist yet. The callback runs on
        the thread that inserts: keep it short.
        """
        from zstate.buffer.watch import TransformWatch  # noqa: PLC0415 - lookups do without

        if self._stop_reason:
            raise Closed(self._stop_reason)
        lookup_newest = partial(self._lookup_newest, self._query(target, source, None))
        limits = {"translation_m": translation_m, "rotation_rad": rotation_rad}
        return TransformWatch(self._waiters, (target, source), lookup_newest, callback, **limits)

    def join(
        self,
        samples: AsyncIterable[S],
        target: str,
        *,
        frame: Callable[[S], str] = attrgetter("frame"),
        stamp: Callable[[S], int] = attrgetter("stamp"),
        timeout_s: float = 1.0,
    ) -> MessageFilter[S]:
        """``async for sample, transform in buffer.join(samples, target)``: each with its own transform.

        ``transform`` is ``target_from_frame`` at the sample's stamp; ``frame`` and ``stamp`` return both
        of a sample (default: its attributes of those names). A sample that gets no transform within
        ``timeout_s`` is left out and counted by its error in ``dropped``; one whose frame or stamp cannot be
        any raises InvalidInput.
        """
        from zstate.buffer.message_filter import MessageFilter  # noqa: PLC0415 - lookups do without

        check_names(target)
        check_duration("timeout_s", timeout_s)
        return MessageFilter(self.wait_async, samples, target, frame=frame, stamp=stamp, timeout_s=timeout_s)

    def joint_positions(self, robot: str, at: int | None = None) -> tuple[NDArray[np.float64], int]:
        """All joints of a robot at a stamp, and that stamp: (nq,) in the order of its model's joint_names.

        ``robot`` is the prefix of its frames, or the name of its model if it has no prefix. ``at=None`` is
        its newest sample; of a robot with several drivers, the newest instant that all of them have reached.
        Between samples joints are interpolated as in lookups, each between those of its own driver. Raises
        NoData, InPast, InFuture, Stale or NotFinite, which name the limiting driver, and InvalidInput for an
        unknown robot, with near misses.
        """
        stamp = None if at is None else check_stamp(at)
        return self._robot_joints(self._robot_track(robot)).positions(stamp)

    def joint_positions_many(
        self, robot: str, stamps: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """``joint_positions`` at each stamp: (T, nq), and which are valid: (T,).

        Rows without positions are NaN. Raises InvalidInput as ``joint_positions``.
        """
        instants = check_stamps(stamps)
        return self._robot_joints(self._robot_track(robot)).positions_many(instants)

    def joint_states(self, robot: str, start: int | None = None, end: int | None = None) -> JointHistory:
        """The samples of a robot that are kept, with stamps in [start, end): copies; efforts are not kept.

        A robot with several drivers has a row for the stamp of each driver's sample, if all drivers have
        samples around it. The joints of the other drivers are interpolated as in lookups; their velocities
        are NaN. Raises InvalidInput as ``joint_positions``.
        """
        from zstate.buffer.joint_samples import robot_samples  # noqa: PLC0415 - lookups read no samples

        start, end = (None if stamp is None else check_stamp(stamp) for stamp in (start, end))
        return robot_samples(self._robot_joints(self._robot_track(robot)), start, end)

    def link_poses(self, robot: str, at: int | None = None) -> tuple[NDArray[np.float64], int]:
        """Every link of a robot at a stamp, and that stamp: (L, 7), rows as the ``links`` of its model.

        Row i is ``root_from_link``: x y z [m], qx qy qz qw. Raises as ``joint_positions``.
        """
        track = self._robot_track(robot)
        positions, stamp = self._robot_joints(track).positions(None if at is None else check_stamp(at))
        poses = track.kinematics.link_poses(positions)
        unknown = ~np.isfinite(poses).all(axis=1)
        if unknown.any():
            link = track.model.links[int(unknown.argmax())]
            raise NotFinite(track.frame(track.model.root), track.frame(link), requested=stamp)
        return poses, stamp

    def _robot_joints(self, robot: JointTrack, *, with_parts: bool = True) -> RobotJoints:
        # The version is read first: a reader newer than its version is made again, never kept.
        version = self._tree.version
        if self._joint_readers[0] != version:
            self._joint_readers = version, {}
        readers = self._joint_readers[1]
        reader = readers.get((robot, with_parts))
        if reader is None:
            reader = readers[robot, with_parts] = RobotJoints(robot, self._read_views, with_parts=with_parts)
        return reader

    def _positions_in(self, view: HistoryView, track: JointTrack, at: int) -> NDArray[np.float64]:
        return self._robot_joints(track, with_parts=False).positions(at, (view,))[0]

    def snapshot(
        self, at: int | None = None, *, robots: Collection[str] = (), hold_s: float = 0.0
    ) -> FramePoses:
        """The pose of every frame in its parent at ``at`` [ns]; by default, at each track's newest sample.

        ``robots`` restricts it to the frames of these, and those above them. A track is still read at its
        newest sample for ``hold_s`` after that. Beyond its samples poses are not known, with a reason.
        """
        reader = self._snapshot_reader(robots)
        return reader.read(self._read_views, self._positions_in, at, round(hold_s * 1e9))

    def frame_table(self, robots: Collection[str] = ()) -> FrameTable:
        """The frames that ``snapshot`` reads; the same object while neither the tree nor a writer changes."""
        return self._snapshot_reader(robots).table

    def _snapshot_reader(self, robots: Collection[str]) -> SnapshotReader:
        key = frozenset(robots)
        reader = self._snapshot_readers.get(key)
        if reader is None or not reader.is_current(self._tree.version):
            from zstate.buffer.snapshot import SnapshotReader  # noqa: PLC0415 - views use it, lookups do not

            if len(self._snapshot_readers) >= _MAX_CACHED_READERS:
                self._snapshot_readers = {}
            reader = self._snapshot_readers[key] = SnapshotReader(self._feed.tree_snapshot(), key)
        return reader

    def span(self) -> TimeSpan | None:
        """The stamps of all samples, at most the last ``history_s`` of them; None without samples.

        Of robots with two clocks, those with the clock that the buffer's domain names.
        """
        with self._lock:
            moving = self._tree.moving()
        default = self._tree.domain.name
        views = [
            view
            for track, edge in moving.items()
            if (view := track.history.view).size and (self._tree.domain_of(edge) or default) == default
        ]
        if not views:
            return None
        newest = max(view.newest for view in views)
        oldest = min(view.oldest for view in views)
        return TimeSpan(max(oldest, newest - round(self.history_s * 1e9)), newest)


def feed_of(buffer: TransformBuffer) -> BufferFeed:
    """The feed of a buffer. It is no member of the buffer, as programs that look up do not need it."""
    return buffer._feed  # pyright: ignore[reportPrivateUsage]  # see above


def _required_stamps(query: Query, reason: LookupFailed, path: TransformPath) -> RequiredStamps:
    """The stamp that each track of the path must reach before another lookup may succeed."""
    at = None if query.at is None else query.at - query.predict_ns
    if isinstance(reason, Stale | NotFinite):
        # After a silent edge, where the query had no instant, any newer sample may help.
        last = reason.newest if reason.requested is None else reason.requested
        at = None if last is None else last + 1
    required: dict[Track, int | None] = {use.track: at for use in path.uses}
    if isinstance(reason, InFuture) and at is not None and reason.newest is not None:
        # If prediction is not possible from the samples there are, only a newer one helps.
        limiting = [use.track for use in path.uses if use.edge == reason.edge]
        required.update((track, max(at, reason.newest + 1)) for track in limiting)
    return required


def _is_final(query: Query, reason: LookupFailed, condition: WakeCondition) -> bool:
    """Whether no later insert can turn the reason into a transform."""
    if isinstance(reason, InPast):
        # Before that, late samples are sorted in, and the history of a new listener is back-filled.
        return condition.is_hopeless()
    if isinstance(reason, Stale | NotFinite):
        return query.at is not None
    if isinstance(reason, ClockMismatch):
        # Each of two robots may restart with the clock of the other; the clock given by the user stays.
        return len(reason.edges) < 2
    return isinstance(reason, AmbiguousFrame)


def check_duration(name: str, value: float, most: float = 1e300) -> float:
    """``value`` if it is a number of seconds of at most ``most``; else raises InvalidInput."""
    if not isinstance(value, Real) or not 0.0 <= value < math.inf:
        raise InvalidInput(f"{name} is a number of seconds, zero or more; got {value!r}")
    if value > most:
        raise InvalidInput(f"{name} is at most {most:g} seconds; got {value!r}")
    return value
