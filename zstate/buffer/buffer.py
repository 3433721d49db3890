"""TransformBuffer: where was it, at that instant? The exact answer, or the reason why there is none."""

from __future__ import annotations

import threading
import time
from collections.abc import AsyncIterable, Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.buffer.join import Join, frame_of, stamp_of
from zstate.buffer.plan import Plan, joints_path
from zstate.buffer.questions import Question, Questions, seconds
from zstate.buffer.tracks import JointTrack
from zstate.buffer.watch import Watch
from zstate.checks import check_names
from zstate.clock import Clock, check_stamp, check_stamps, wait_in_slices
from zstate.errors import Closed, InvalidInput, LookupFailed, NotFinite, timed_out
from zstate.transform import Transform
from zstate.twist import Twist

S = TypeVar("S")


class TransformBuffer(Questions):
    """The recent past of every frame it is told of, and exact answers about it.

    ``lookup("a", "b")`` is ``a_from_b``: the pose of b in a, which maps coordinates in b into a.
    ``history_s`` [s] is kept for each track, counted back from its own newest sample; ``clock`` is
    asked for the present only by ``max_age_s`` (default: the system's). Any method may be called
    from any thread.
    """

    def __repr__(self) -> str:
        robots = [repr(track.name) for track in list(self._tree.robots.values()) if track is not None]
        more = f" and {len(robots) - 3} more" if len(robots) > 3 else ""
        named = f" of {', '.join(robots[:3])}{more}" if robots else ""
        kept = "of a recording" if self.home.is_recording else f"{self.history_s:g} s of history"
        return f"<TransformBuffer: {len(self._tree.frames)} frames{named}, {kept}>"

    @classmethod
    def from_recording(
        cls, path: str | Path, robot: str | None = None, *, clock: Clock | None = None
    ) -> TransformBuffer:
        """A buffer that holds a whole recording, an MCAP file or a bag, of ``robot`` or of all robots.

        It answers as a listener's buffer did while that was recorded; ``zstate.recording.load``
        tells what becomes of restarts. Messages that cannot be used are left out, and logged once for
        each reason. Raises RecordingError, and InvalidInput when there is nothing of ``robot`` in it.
        """
        from zstate.recording.load import HISTORY_S, load_into  # noqa: PLC0415 - looked for here, made there
        from zstate.recording.reader import RecordingReader  # noqa: PLC0415 - as above

        buffer = cls(HISTORY_S, clock)
        with RecordingReader(path) as reader:
            load_into(buffer, reader, robot)
        return buffer

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

        ``at=None`` is the newest instant that every moving edge between the frames knows; on a path
        of static edges only, the answer then has no stamp. ``timeout_s`` waits for what is not there
        yet. ``max_age_s`` refuses an older answer. ``predict_s`` allows instants up to so far beyond
        the newest sample, from published velocities; such an answer is of kind "predicted".

        Raises UnknownFrame, AmbiguousFrame, Disconnected, ClockMismatch, NoData, InPast, InFuture, Stale or
        NotFinite, all of them LookupFailed; after a wait also a TimeoutError. Raises InvalidInput for names
        that are no frame names.
        """
        if max_age_s is None and timeout_s == 0.0 and predict_s == 0.0:
            try:
                known = self._paths.get((target, source))
            except TypeError:  # of a list, which has no hash and is no name
                known = None
            if known is not None and known[0] == self._tree.version:
                transform = known[1].at(at)
                if transform is not None:
                    return transform
                if not self._ended:
                    known[1].refuse(at)
        question = self._question(target, source, at, predict_s=predict_s, max_age_s=max_age_s)
        if seconds("timeout_s", timeout_s) > 0.0 and not self._ended:
            return self._wait(question, timeout_s)
        return self._answer(question)

    def lookup_between(
        self, target: str, target_at: int | None, source: str, source_at: int | None, fixed: str
    ) -> Transform:
        """Where ``source`` was at one instant, seen from where ``target`` was at another.

        Both are joined through ``fixed``, which is taken not to have moved meanwhile (tf2's advanced
        form). None for an instant is the newest of that side. The answer has the target side's stamp.
        """
        check_names(target, source, fixed)
        for name in (target, source, fixed):
            self._tree.resolve(name, target, source)
        # A missing connection, or two clocks, are blamed before a bad time, on either side.
        self._path(fixed, source)
        self._path(target, source)
        target_from_fixed = self.lookup(target, fixed, target_at)
        fixed_from_source = self.lookup(fixed, source, source_at)
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

        Rows that have no answer are NaN. Stamps are integers [ns] or datetime64[ns]. Raises UnknownFrame,
        AmbiguousFrame, Disconnected and ClockMismatch.
        """
        return self._path(target, source).poses(check_stamps(stamps))

    def plan(self, target: str, source: str) -> Plan:
        """The same question for many instants, compiled. Raises as ``lookup`` for unknown frames."""
        return Plan(target, source, self._tree, lambda: self._path(target, source))

    def twist(self, frame: str, reference: str, at: int | None = None) -> Twist:
        """How fast ``frame`` moves in ``reference``: d/dt of ``reference_from_frame``.

        Linear at the frame's origin, both vectors in the axes of ``reference``. Exact from published
        velocities where there are any, else the slope between the samples around the instant. Raises
        as ``lookup``, and NoData where one sample without velocities tells no rate.
        """
        question = self._question(reference, frame, at)
        motion, stamp = self._path(reference, frame).motion(question.at)
        return Twist(frame, reference, motion.linear, motion.angular, stamp)

    def latest(self, target: str, source: str) -> int:
        """The newest stamp [ns] that every moving edge between the frames knows.

        Raises NoData when every edge is static, for then there is no such instant, and Stale when the
        history of one edge begins after the last sample of another, which is silent.
        """
        return self._path(target, source).latest()

    def can_lookup(self, target: str, source: str, at: int | None = None) -> bool:
        """Whether ``lookup`` would answer now. Raises InvalidInput for what can be no name or stamp."""
        reason = self.explain(target, source, at)
        if isinstance(reason, InvalidInput):
            raise reason
        return reason is None

    def explain(self, target: str, source: str, at: int | None = None) -> LookupFailed | InvalidInput | None:
        """The error ``lookup`` would raise now, or None when it would answer. Never raises one.

        InvalidInput is returned for what can be no name or stamp.
        """
        try:
            self._answer(self._question(target, source, at))
        except (LookupFailed, InvalidInput) as reason:
            return reason
        return None

    def wait(self, target: str, source: str, at: int | None = None, timeout_s: float = 1.0) -> Transform:
        """``lookup`` as soon as it has an answer; unknown and unconnected frames are waited for, too.

        Raises at once what waiting cannot mend: InPast for an ``at`` more than ``history_s`` before the
        newest sample of an edge, and anything in a process forked from that of the listener which fills
        this buffer. Anything later may still come: late samples are sorted in, and a listener that has
        just opened requests the past from the writers. After ``timeout_s`` raises the reason of the last
        try, as an error that is also a TimeoutError.
        """
        question, timeout_s = self._question(target, source, at), seconds("timeout_s", timeout_s)
        return self._answer(question) if self._ended else self._wait(question, timeout_s)

    async def wait_async(
        self, target: str, source: str, at: int | None = None, timeout_s: float = 1.0
    ) -> Transform:
        """``wait`` for asyncio: nothing blocks, and cancelling the task ends it."""
        import asyncio  # noqa: PLC0415  # who calls this has it already, and others do not need it

        question = self._question(target, source, at)
        if self._ended:
            return self._answer(question)
        loop, event = asyncio.get_running_loop(), asyncio.Event()
        deadline = loop.time() + seconds("timeout_s", timeout_s)

        def wake() -> None:
            # The loop may be closed by the time an insert wakes those who waited in it.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(event.set)

        with self._room.seat(wake) as waiter:
            while True:
                event.clear()
                outcome = self._try(question, waiter)
                if isinstance(outcome, Transform):
                    return outcome
                try:
                    await asyncio.wait_for(event.wait(), deadline - loop.time())
                except (TimeoutError, asyncio.TimeoutError):
                    raise timed_out(outcome, timeout_s) from None

    def _wait(self, question: Question, timeout_s: float) -> Transform:
        event = threading.Event()
        deadline = time.monotonic() + timeout_s
        with self._room.seat(event.set) as waiter:
            while True:
                event.clear()
                outcome = self._try(question, waiter)
                if isinstance(outcome, Transform):
                    return outcome
                if not wait_in_slices(event, deadline - time.monotonic()):
                    raise timed_out(outcome, timeout_s)

    def watch(
        self,
        target: str,
        source: str,
        callback: Callable[[Transform], object],
        *,
        translation_m: float | None = None,
        rotation_rad: float | None = None,
    ) -> Watch:
        """Call ``callback(transform)`` with each newest ``target_from_source``, until the watch is closed.

        With thresholds, only once the source has moved or turned so far since the last call. Frames may
        still be unknown. The callback runs on the thread that inserts: keep it short.
        """

        if self._ended:
            raise Closed(self._ended)
        look = partial(self._newest, self._question(target, source, None))
        limits = {"translation_m": translation_m, "rotation_rad": rotation_rad}
        return Watch(self._room, (target, source), look, callback, **limits)

    def join(
        self,
        samples: AsyncIterable[S],
        target: str,
        *,
        frame: Callable[[S], str] = frame_of,
        stamp: Callable[[S], int] = stamp_of,
        timeout_s: float = 1.0,
    ) -> Join[S]:
        """``async for sample, transform in buffer.join(samples, target)``: each with its own transform.

        ``transform`` is ``target_from_frame`` at the sample's stamp; ``frame`` and ``stamp`` say where to
        find both (default: the attributes of those names). A sample that gets no transform within
        ``timeout_s`` is left out, counted by its reason in ``dropped``; one whose frame or stamp cannot be
        any raises InvalidInput.
        """
        check_names(target)
        seconds("timeout_s", timeout_s)
        return Join(self.wait_async, samples, target, frame=frame, stamp=stamp, timeout_s=timeout_s)

    def joint_positions(self, track: JointTrack, at: int | None = None) -> tuple[NDArray[np.float64], int]:
        """All joints of one robot at a stamp, and that stamp: (nq,) as ``track.model.joint_names``.

        ``at=None`` is the robot's newest sample. Between samples joints are interpolated as in lookups.
        Raises NoData, InPast, InFuture or NotFinite, and InsertRefused as ``insert_joints``.
        """
        self._check_ours(track)
        path = joints_path(track, self._take_views)
        reading = path.read(None if at is None else check_stamp(at))
        positions = np.hstack([np.empty(0), *reading.values[0]])
        if not np.isfinite(positions).all():
            raise path.not_finite(reading.values, reading.stamp)
        return positions, reading.stamp

    def link_poses(self, track: JointTrack, at: int | None = None) -> tuple[NDArray[np.float64], int]:
        """Every link of one robot at a stamp, and that stamp: (L, 7), rows as ``track.model.links``.

        Row i is ``root_from_link``: x y z [m], qx qy qz qw. Raises as ``joint_positions``.
        """
        positions, stamp = self.joint_positions(track, at)
        poses = track.kinematics.link_poses(positions)
        unknown = ~np.isfinite(poses).all(axis=1)
        if unknown.any():
            link = track.model.links[int(unknown.argmax())]
            raise NotFinite(track.frame(track.model.root), track.frame(link), requested=stamp)
        return poses, stamp
