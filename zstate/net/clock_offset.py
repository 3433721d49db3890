"""Clock offsets: how far the clock of a writer is ahead of the one here, measured over the network.

A writer answers whoever asks on ``zstate/<robot>/@clock/<identity>`` with the time by which it stamps.
The answer was given somewhere between the question and its arrival here; taken for the middle, it is wrong
by at most half of that round trip, and the shortest of several is the one to believe (as NTP does). Writers
on simulated time do not answer: that is everybody's.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.clock import Clock, ClockOffset, SystemClock
from zstate.errors import Closed, InvalidInput, MessageError
from zstate.net.at_exit import join_at_exit
from zstate.net.queryable import Queryable, Reply, query
from zstate.net.sample_history import RoundRobinQueue
from zstate.net.session import Session
from zstate.wire.identity import WriterId
from zstate.wire.keys import clock_expression, clock_key, parse_clock_key
from zstate.wire.messages import ClockMessage as Time
from zstate.wire.native import ENCODINGS, decode, encode

REFRESH_S = 30.0
"""So old a measurement is repeated when it is asked for; sooner while there was no answer."""

_UNANSWERED_AGAIN_S = 5.0

_TIMEOUTS_S = (0.1, 0.2, 0.5)
"""Of three attempts, the later two in their turn; then not before it is asked for again."""

_MEETING_S = 0.05


@dataclass(frozen=True, order=True, slots=True)
class MeasuredOffset:
    """The clock of ``writer`` is ``offset_ns`` ahead of the one here, plus or minus ``uncertainty_ns``.

    ``round_trip_ns`` is the shortest there was, from the question to the answer.
    """

    robot: str
    writer: WriterId
    offset_ns: int
    uncertainty_ns: int
    round_trip_ns: int


class ClockService(Queryable):
    """Tells whoever asks what time it is by the ``clock`` of one writer of ``robot``."""

    def __init__(self, session: Session, robot: str, writer: WriterId, clock: Clock) -> None:
        def answer(_: object) -> Reply:
            return Reply(encode(Time(clock.now(), self.answered, writer.session)), ENCODINGS[Time])

        super().__init__(session, clock_key(robot, writer.identity), answer)


def measure_offsets(
    session: Session,
    robot: str,
    rounds: int = 8,
    *,
    clock: Clock | None = None,
    timeout_s: float = 0.5,
) -> tuple[MeasuredOffset, ...]:
    """How far the clock of each writer of ``robot`` ("*": of all robots) is ahead of ``clock``, sorted.

    ``clock`` is this machine's unless given. The best of so many ``rounds`` counts. None is there when
    nobody answers within ``timeout_s``. Raises InvalidInput and Closed.
    """
    if rounds < 1 or not timeout_s > 0.0:
        raise InvalidInput(f"rounds is 1 or more and timeout_s is positive; got {rounds} and {timeout_s}")
    expression = clock_expression(robot)
    return tuple(sorted(_best(session, expression, rounds, clock or SystemClock(), timeout_s)))


def _best(
    session: Session, expression: str, rounds: int, clock: Clock, timeout_s: float
) -> Iterator[MeasuredOffset]:
    best: dict[str, MeasuredOffset] = {}
    deadline = time.monotonic() + timeout_s
    while rounds:
        heard = list(_round(session, expression, clock, timeout_s))
        if heard:
            rounds -= 1
        elif best or time.monotonic() > deadline:
            break
        else:
            time.sleep(_MEETING_S)  # a session that has just connected has not met everybody yet
        for one in heard:
            key = clock_key(one.robot, one.writer.identity)
            if key not in best or one.round_trip_ns < best[key].round_trip_ns:
                best[key] = one
    yield from best.values()


def _round(session: Session, expression: str, clock: Clock, timeout_s: float) -> Iterator[MeasuredOffset]:
    asked_ns, now = time.monotonic_ns(), clock.now()
    replies = query(
        session.zenoh,
        expression,
        timeout_s,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    for reply in replies:
        round_trip_ns = time.monotonic_ns() - asked_ns
        if reply.ok is not None:
            told = _parse_reply(reply.ok)
            if told is not None:
                robot, writer, stamp = told
                half = round_trip_ns // 2
                yield MeasuredOffset(robot, writer, stamp - (now + half), half, round_trip_ns)


def _parse_reply(sample: zenoh.Sample) -> tuple[str, WriterId, int] | None:
    """Who says what time it is; None for what is no answer of ours."""
    try:
        robot, identity = parse_clock_key(str(sample.key_expr))
        writer = WriterId.parse(identity)
        time_there = decode(sample.payload.to_bytes(), str(sample.encoding), Time)
    except (InvalidInput, MessageError):
        return None
    return (robot, writer, time_there.stamp) if time_there.session == writer.session else None


class ClockOffsetMonitor(Closeable):
    """Measures the clocks of writers as often as somebody wants to know, in a thread of its own.

    The thread lives no longer than there is something to measure. Each robot has its turn: silent writers
    of one robot do not delay those of another for long.
    """

    def __init__(self, session: Session, clock: Clock) -> None:
        self._session = session
        self._clock = clock
        self._wanted: RoundRobinQueue[_Measured] = RoundRobinQueue()
        self._lock = fork_safe_lock()
        self._is_running = False
        self._is_open = True

    def follow(self, robot: str, writer: WriterId) -> Callable[[], ClockOffset | None]:
        """What tells how far the clock of ``writer`` is ahead: measured now, and when asked after 30 s."""
        measured = _Measured(self, robot, clock_key(robot, writer.identity))
        measured()
        return measured

    def want(self, measured: _Measured) -> None:
        """Measure, as soon as what was wanted before is done."""
        with self._lock:
            if not self._is_open:
                return
            self._wanted.add(measured.robot, measured)
            if not self._is_running:
                self._is_running = True
                thread = threading.Thread(target=self._run, name="zstate clock offsets", daemon=True)
                try:
                    join_at_exit(thread).start()
                except RuntimeError:  # the interpreter is ending and starts no more threads
                    self._is_open = False

    def close(self) -> None:
        """Measure no more. A second call does nothing."""
        with self._lock:
            self._is_open = False
            self._wanted.clear()

    def _run(self) -> None:
        while True:
            with self._lock:
                measured = self._wanted.pop(0.0)
                if measured is None:
                    self._is_running = False
                    return
            try:
                found = list(_best(self._session, measured.key, 8, self._clock, measured.timeout_s))
                if measured.add_reply(found):
                    self.want(measured)
            except (Closed, zenoh.ZError):
                self.close()  # the session is gone


class _Measured:
    """The offset of one writer's clock, as far as it is known."""

    def __init__(self, meter: ClockOffsetMonitor, robot: str, key: str) -> None:
        self.robot = robot
        self.key = key
        self.offset: ClockOffset | None = None
        self._unanswered = 0
        self._meter = meter
        self._wanted_s = -REFRESH_S

    @property
    def timeout_s(self) -> float:
        """How long it may take the writer to answer: longer, when it has not answered before."""
        return _TIMEOUTS_S[min(self._unanswered, len(_TIMEOUTS_S) - 1)]

    def add_reply(self, found: Sequence[MeasuredOffset]) -> bool:
        """Keep what was measured; whether to try again, where the writer did not answer."""
        self._unanswered = 0 if found else self._unanswered + 1
        for one in found:
            self.offset = ClockOffset(one.offset_ns, one.uncertainty_ns)
        return 0 < self._unanswered < len(_TIMEOUTS_S)

    def __call__(self) -> ClockOffset | None:
        now_s = time.monotonic()
        if now_s - self._wanted_s >= (_UNANSWERED_AGAIN_S if self.offset is None else REFRESH_S):
            self._wanted_s = now_s
            self._meter.want(self)
        return self.offset
