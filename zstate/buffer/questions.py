"""Questions: what a buffer is asked, answered over compiled paths."""

from __future__ import annotations

import math
from typing import NamedTuple

from zstate.buffer.path import Path
from zstate.buffer.plan import compile_path, transform_of
from zstate.buffer.store import Store
from zstate.buffer.tracks import Track
from zstate.buffer.waiting import Waiter
from zstate.clock import Clock, check_stamp
from zstate.errors import (
    AmbiguousFrame,
    ClockMismatch,
    InFuture,
    InPast,
    InvalidInput,
    LookupFailed,
    Stale,
    UnknownFrame,
)
from zstate.transform import Transform

# So many pairs of frames are remembered compiled; more than any program asks for on purpose.
_MOST_PATHS = 4096


class Question(NamedTuple):
    """What is asked, checked."""

    target: str
    source: str
    at: int | None
    predict_ns: int = 0
    max_age_s: float | None = None


class Questions(Store):
    """The half of ``TransformBuffer`` that finds one answer, or the reason why there is none."""

    def __init__(self, history_s: float = 10.0, clock: Clock | None = None) -> None:
        super().__init__(history_s, clock)
        self._paths: dict[tuple[str, str], tuple[int, Path]] = {}

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

    def _expect_newer(self, question: Question, transform: Transform, waiter: Waiter) -> None:
        """Tell ``waiter`` what would make an answer newer than ``transform``."""
        version = self._tree.version
        uses = self._path(question.target, question.source).uses
        newer = None if transform.stamp is None else transform.stamp + 1
        waiter.expect(version, [(use.track, newer) for use in uses])
        if waiter.is_met(self._tree.version):
            waiter.wake()

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
            seconds("max_age_s", max_age_s)
        predict_ns = round(seconds("predict_s", predict_s) * 1e9)
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
        kept = self.domain.name
        if path.uses and kept is not None and kept != self.clock.domain:
            raise _mismatch(kept, self.clock, "max_age_s was given")
        age_s = transform.age(self.clock)
        if path.uses and age_s > max_age_s:
            raise path.stale(transform.stamp, age_s, max_age_s)

    def use_clock(self, clock: Clock) -> None:
        """Tell ages by ``clock``, and take stamps of its time only. Raises ClockMismatch for another time."""
        kept = self.domain.name
        if kept not in (None, clock.domain):
            raise _mismatch(kept, clock, "another clock was given")
        self.clock = clock
        self.domain.decide(clock.domain)

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


def _mismatch(kept: str, clock: Clock, occasion: str) -> ClockMismatch:
    return ClockMismatch(
        f"{occasion}, but the stamps in this buffer are {kept!r} time and the clock tells {clock.domain!r} "
        f"time; give the buffer, or the listener, a clock of {kept!r} time",
        domains=(kept, clock.domain),
    )


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


def seconds(name: str, value: float) -> float:
    """``value`` if it is a length of time; InvalidInput otherwise."""
    if not (math.isfinite(value) and value >= 0.0):
        raise InvalidInput(f"{name} is a number of seconds, zero or more; got {value!r}")
    return value
