"""TransformBuffer: where was it, at that instant? The exact answer, or the reason why there is none."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.buffer.path import Path
from zstate.buffer.plan import Plan, check_stamps, compile_path, transform_of
from zstate.buffer.store import Store
from zstate.buffer.tracks import Track
from zstate.buffer.waiting import Waiter
from zstate.clock import Clock, check_stamp
from zstate.errors import (
    AmbiguousFrame,
    InFuture,
    InPast,
    InvalidInput,
    LookupFailed,
    Stale,
    UnknownFrame,
    timed_out,
)
from zstate.transform import Transform
from zstate.twist import Twist

# So many pairs of frames are remembered compiled; more than any program asks for on purpose.
_MOST_PATHS = 4096


class Question(NamedTuple):
    """What is asked, checked."""

    target: str
    source: str
    at: int | None
    predict_ns: int = 0
    max_age_s: float | None = None


class TransformBuffer(Store):
    """The recent past of every frame it is told of, and exact answers about it.

    ``lookup("a", "b")`` is ``a_from_b``: the pose of b in a, which maps coordinates in b into a.
    ``history_s`` [s] is kept for each track, counted back from its own newest sample; ``clock`` is
    asked for the present only by ``max_age_s`` (default: the system's). Any method may be called
    from any thread.
    """

    def __init__(self, history_s: float = 10.0, clock: Clock | None = None) -> None:
        super().__init__(history_s, clock)
        self._paths: dict[tuple[str, str], tuple[int, Path]] = {}

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

        Raises UnknownFrame, AmbiguousFrame, Disconnected, NoData, InPast, InFuture or Stale, all of
        them LookupFailed; after a wait also a TimeoutError.
        """
        question = self._question(target, source, at, predict_s=predict_s, max_age_s=max_age_s)
        if _seconds("timeout_s", timeout_s) > 0.0:
            return self._wait(question, timeout_s)
        return self._answer(question)

    def lookup_between(
        self, target: str, target_at: int | None, source: str, source_at: int | None, fixed: str
    ) -> Transform:
        """Where ``source`` was at one instant, seen from where ``target`` was at another.

        Both are joined through ``fixed``, which is taken not to have moved meanwhile (tf2's advanced
        form). None for an instant is the newest of that side. The answer has the target side's stamp.
        """
        # A missing connection is blamed before a bad time, on either side.
        self._path(fixed, source)
        target_from_fixed = self.lookup(target, fixed, target_at)
        both = target_from_fixed @ self.lookup(fixed, source, source_at)
        pose = tuple(both.pose7.tolist())
        return Transform.trusted(target, source, pose, target_from_fixed.stamp, both.kind)

    def lookup_many(
        self, target: str, source: str, stamps: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """pose7 of ``source`` in ``target`` at each stamp: (T, 7), and which are valid: (T,).

        Rows that have no answer are NaN. Raises UnknownFrame, AmbiguousFrame and Disconnected.
        """
        return self._path(target, source).poses(check_stamps(stamps))

    def plan(self, target: str, source: str) -> Plan:
        """The same question for many instants, compiled. Raises as ``lookup`` for unknown frames."""
        self._path(target, source)
        return Plan(target, source, lambda: self._path(target, source))

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

        Raises NoData when every edge is static, for then there is no such instant.
        """
        return self._path(target, source).latest()

    def can_lookup(self, target: str, source: str, at: int | None = None) -> bool:
        """Whether ``lookup`` would answer now."""
        return self.explain(target, source, at) is None

    def explain(self, target: str, source: str, at: int | None = None) -> LookupFailed | None:
        """The error ``lookup`` would raise now, or None when it would answer. Never raises one."""
        try:
            self._answer(self._question(target, source, at))
        except LookupFailed as reason:
            return reason
        return None

    def wait(self, target: str, source: str, at: int | None = None, timeout_s: float = 1.0) -> Transform:
        """``lookup`` as soon as it has an answer; unknown and unconnected frames are waited for, too.

        Raises at once what waiting cannot mend: InPast for an ``at`` before all samples kept. After
        ``timeout_s`` raises the reason of the last try, as an error that is also a TimeoutError.
        """
        return self._wait(self._question(target, source, at), _seconds("timeout_s", timeout_s))

    async def wait_async(
        self, target: str, source: str, at: int | None = None, timeout_s: float = 1.0
    ) -> Transform:
        """``wait`` for asyncio: nothing blocks, and cancelling the task ends it."""
        question = self._question(target, source, at)
        loop, event = asyncio.get_running_loop(), asyncio.Event()
        deadline = loop.time() + _seconds("timeout_s", timeout_s)

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
                left_s = min(deadline - time.monotonic(), threading.TIMEOUT_MAX)
                if left_s <= 0.0 or not event.wait(left_s):
                    raise timed_out(outcome, timeout_s)

    def _try(self, question: Question, waiter: Waiter) -> Transform | LookupFailed:
        """An answer; or the reason against it, with ``waiter`` told what would change that."""
        version = self._tree.version
        waiter.expect(version, ())
        try:
            return self._answer(question)
        except LookupFailed as reason:
            if _is_final(question, reason):
                raise
            waiter.expect(version, self._marks(question, reason), question.at)
            # What arrived between the question and the expectation woke nobody.
            if waiter.is_met(self._tree.version):
                waiter.wake()
            return reason

    def _marks(self, question: Question, reason: LookupFailed) -> list[tuple[Track, int | None]]:
        """How new each track of the path must be before asking again may help."""
        try:
            uses = self._path(question.target, question.source).uses
        except LookupFailed:
            return []
        at = None if question.at is None else question.at - question.predict_ns
        if isinstance(reason, InPast):
            at = reason.oldest
        if isinstance(reason, Stale):
            at = _after(reason.requested)
        marks: list[tuple[Track, int | None]] = [(use.track, at) for use in uses]
        if isinstance(reason, InFuture) and at is not None:
            # Where prediction is not possible from the samples there are, only a newer one helps.
            marks += [(use.track, _after(reason.newest)) for use in uses if use.edge == reason.edge]
        return marks

    def _question(
        self,
        target: str,
        source: str,
        at: int | None,
        *,
        predict_s: float = 0.0,
        max_age_s: float | None = None,
    ) -> Question:
        if max_age_s is not None:
            _seconds("max_age_s", max_age_s)
        predict_ns = round(_seconds("predict_s", predict_s) * 1e9)
        return Question(target, source, None if at is None else check_stamp(at), predict_ns, max_age_s)

    def _answer(self, question: Question) -> Transform:
        try:
            path = self._path(question.target, question.source)
            transform = transform_of(path, question.at, question.predict_ns)
        except LookupFailed as reason:
            if reason.requested is None:
                reason.requested = question.at
            raise
        if question.max_age_s is not None:
            self._refuse_stale(path, transform, question.max_age_s)
        return transform

    def _refuse_stale(self, path: Path, transform: Transform, max_age_s: float) -> None:
        age_s = transform.age(self.clock)
        if path.uses and age_s > max_age_s:
            raise path.stale(transform.stamp, age_s, max_age_s)

    def _path(self, target: str, source: str) -> Path:
        cached = self._paths.get((target, source))
        if cached is not None and cached[0] == self._tree.version:
            return cached[1]
        with self._lock:
            path = compile_path(self._tree, target, source, self._take_views)
            if len(self._paths) >= _MOST_PATHS:
                self._paths = {}
            self._paths[target, source] = (self._tree.version, path)
        return path


def _is_final(question: Question, reason: LookupFailed) -> bool:
    """Whether no amount of waiting would turn the reason into an answer."""
    if isinstance(reason, UnknownFrame):
        return not reason.name or reason.name.startswith("/")
    if isinstance(reason, InPast | Stale):
        return question.at is not None
    return isinstance(reason, AmbiguousFrame)


def _after(stamp: int | None) -> int | None:
    """The first stamp that would be news to what reached ``stamp``."""
    return None if stamp is None else stamp + 1


def _seconds(name: str, value: float) -> float:
    if not (math.isfinite(value) and value >= 0.0):
        raise InvalidInput(f"{name} is a number of seconds, zero or more; got {value!r}")
    return value
