"""Questions: what a buffer is asked, answered over compiled paths."""

from __future__ import annotations

import math
from numbers import Real
from typing import NamedTuple

from zstate.buffer.footing import Footing
from zstate.buffer.path import Path
from zstate.buffer.plan import compile_path, transform_of
from zstate.buffer.store import Store
from zstate.buffer.tracks import Track
from zstate.buffer.waiting import Expected, Marks, Waiter
from zstate.checks import check_names
from zstate.clock import Clock, check_stamp
from zstate.errors import (
    AmbiguousFrame,
    ClockMismatch,
    Disconnected,
    InFuture,
    InPast,
    InvalidInput,
    LookupFailed,
    NotFinite,
    Stale,
    UnknownFrame,
)
from zstate.transform import Transform

# So many pairs of frames are remembered compiled; more than any program asks for on purpose.
_MOST_PATHS = 4096

# No stamp of 64 bits is further away.
_LONGEST_PREDICTION_S = 2e10

# What only a change of the tree can mend.
_NO_PATH = (UnknownFrame, AmbiguousFrame, Disconnected, ClockMismatch)


class Question(NamedTuple):
    """What is asked, checked."""

    target: str
    source: str
    at: int | None
    predict_ns: int = 0
    max_age_s: float | None = None


class KnownPath(NamedTuple):
    """A compiled path, good at the ``version`` of the tree and while its ``footing`` holds."""

    version: int
    path: Path
    footing: Footing


class Questions(Store):
    """The half of ``TransformBuffer`` that finds one answer, or the reason why there is none."""

    def __init__(self, history_s: float = 10.0, clock: Clock | None = None) -> None:
        super().__init__(history_s, clock)
        self._paths: dict[tuple[str, str], KnownPath] = {}
        self._ended = ""

    def end(self, why: str) -> None:
        """No data comes any more, which errors then say: waits become lookups. What is kept still answers."""
        self._ended = self._ended or why

    def _try(self, question: Question, waiter: Waiter) -> Transform | LookupFailed:
        """An answer; or the reason against it, with ``waiter`` told what would change that."""
        version = self._tree.version
        try:
            return self._answer(question)
        except LookupFailed as reason:
            return self._expect_mending(question, reason, waiter, version)

    def _newest(self, question: Question, waiter: Waiter) -> Transform | LookupFailed:
        """The newest answer, with ``waiter`` told to expect a newer one; else as ``_try``."""
        version = self._tree.version
        try:
            _, path, footing = self._known_path(question.target, question.source)
            transform = transform_of(path, None)
        except LookupFailed as reason:
            return self._expect_mending(question, reason, waiter, version)
        newer = None if transform.stamp is None else transform.stamp + 1
        waiter.expect(Expected(footing, dict.fromkeys(path.tracks, newer)), version)
        return transform

    def _expect_mending(
        self, question: Question, reason: LookupFailed, waiter: Waiter, version: int
    ) -> LookupFailed:
        """Tell ``waiter`` what may turn the reason into an answer. Raises a reason that nothing mends."""
        expected = self._mending(question, reason)
        waiter.expect(expected, version)
        if _is_final(question, reason, expected):
            raise reason
        return reason

    def _mending(self, question: Question, reason: LookupFailed) -> Expected:
        if isinstance(reason, _NO_PATH):
            with self._lock:
                return Expected(self._tree.footing(question.target, question.source))
        try:
            known = self._known_path(question.target, question.source)
        except LookupFailed:
            return Expected()  # the tree has changed meanwhile, which is told by its version
        return Expected(known.footing, _marks(question, reason, known.path), question.at)

    def _question(
        self,
        target: str,
        source: str,
        at: int | None,
        *,
        predict_s: float = 0.0,
        max_age_s: float | None = None,
    ) -> Question:
        check_names(target, source)
        if max_age_s is not None:
            seconds("max_age_s", max_age_s)
        predict_ns = round(seconds("predict_s", predict_s, _LONGEST_PREDICTION_S) * 1e9)
        return Question(target, source, None if at is None else check_stamp(at), predict_ns, max_age_s)

    def _answer(self, question: Question) -> Transform:
        try:
            path = self._path(question.target, question.source)
            transform = transform_of(path, question.at, question.predict_ns)
        except LookupFailed as reason:
            if reason.requested is None:
                reason.requested = question.at
            if self._ended:
                reason.ended = self._ended
            raise
        if question.max_age_s is not None:
            self._refuse_stale(path, transform, question.max_age_s)
        return transform

    def _refuse_stale(self, path: Path, transform: Transform, max_age_s: float) -> None:
        if path.domain not in ("", self.clock.domain):
            use = path.uses[0]
            raise ClockMismatch(
                path.target,
                path.source,
                edges=(use.edge,),
                robots=(use.track.name,),
                domains=(path.domain, self.clock.domain),
            )
        age_s = transform.age(self.clock)
        if path.uses and age_s > max_age_s:
            raise path.stale(transform.stamp, age_s, max_age_s)

    def use_clock(self, clock: Clock) -> None:
        """Measure ages with ``clock``. Raises InvalidInput if a clock of another domain was given before."""
        given = self.domain.given
        if given not in (None, clock.domain):
            raise InvalidInput(
                f"the buffer was given a clock of {given!r} time, and now one of {clock.domain!r} time; "
                "give both the same, or a buffer without a clock"
            )
        self.clock = clock
        self.domain.given = clock.domain

    def domain_between(self, target: str, source: str) -> str | None:
        """The clock domain that stamps answers between two frames, None if not known. Raises as ``plan``."""
        return self._path(target, source).domain or None

    def _path(self, target: str, source: str) -> Path:
        return self._known_path(target, source).path

    def _known_path(self, target: str, source: str) -> KnownPath:
        version = self._tree.version
        try:
            known = self._paths.get((target, source))
        except TypeError:  # of a list, which has no hash and is no name
            known = None
        if known is not None and known.version == version:
            return known
        if known is not None and self._tree.holds(known.footing):
            known = known._replace(version=version)
        else:
            known = self._compiled(target, source)
        if len(self._paths) >= _MOST_PATHS:
            self._paths = {}
        self._paths[target, source] = known
        return known

    def _compiled(self, target: str, source: str) -> KnownPath:
        check_names(target, source)
        with self._lock:
            path = compile_path(self._tree, target, source, self._take_views)
            return KnownPath(self._tree.version, path, self._tree.footing(target, source))


def _marks(question: Question, reason: LookupFailed, path: Path) -> Marks:
    """How new each track of the path must be before asking again may help."""
    at = None if question.at is None else question.at - question.predict_ns
    if isinstance(reason, Stale | NotFinite):
        # Where an edge has been silent for too long, the question had no instant: a newer sample helps.
        at = _after(reason.newest if reason.requested is None else reason.requested)
    marks: dict[Track, int | None] = {use.track: at for use in path.uses}
    if isinstance(reason, InFuture) and at is not None and reason.newest is not None:
        # Where prediction is not possible from the samples there are, only a newer one helps.
        limiting = [use.track for use in path.uses if use.edge == reason.edge]
        marks.update((track, max(at, reason.newest + 1)) for track in limiting)
    return marks


def _is_final(question: Question, reason: LookupFailed, expected: Expected) -> bool:
    """Whether no amount of waiting would turn the reason into an answer."""
    if isinstance(reason, InPast):
        # Before that, late samples are sorted in, and the history of a listener that joins is filled.
        return expected.is_hopeless()
    if isinstance(reason, Stale | NotFinite):
        return question.at is not None
    if isinstance(reason, ClockMismatch):
        # Of two robots each may start again with the other's clock; the clock that was given stays.
        return len(reason.edges) < 2
    return isinstance(reason, AmbiguousFrame)


def _after(stamp: int | None) -> int | None:
    """The first stamp that would be news to what reached ``stamp``."""
    return None if stamp is None else stamp + 1


def seconds(name: str, value: float, most: float = 1e300) -> float:
    """``value`` if it is a length of time of at most ``most``; InvalidInput otherwise."""
    if not isinstance(value, Real) or not 0.0 <= value < math.inf:
        raise InvalidInput(f"{name} is a number of seconds, zero or more; got {value!r}")
    if value > most:
        raise InvalidInput(f"{name} is at most {most:g} seconds; got {value!r}")
    return value
