"""Clock offsets: how far the clock of a writer is ahead of the local clock, measured over the network.

A writer replies to queries on ``zstate/<robot>/@clock/<identity>`` with the time of its stamps. It replied
at some time during the round trip; with the middle of it the error is at most half the round trip, and the
shortest of several is used (as in NTP). Writers on simulated time do not reply: they share one clock.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import zenoh

from zstate.clock import Clock, ClockOffset, SystemClock
from zstate.errors import InvalidInput, MessageError
from zstate.net.queryable import check_timeout, query
from zstate.net.requests import ReplyHandler, Request, Requests
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.wire.identity import WriterId
from zstate.wire.keys import WRITER_CLOCK
from zstate.wire.messages import ClockMessage
from zstate.wire.native import decode

REFRESH_S = 30.0
"""A measurement older than this is repeated when it is read; sooner while there was no reply."""

_UNANSWERED_REFRESH_S = 5.0

_TIMEOUTS_S = (0.1, 0.2, 0.5)
"""Timeouts of three attempts, the later two after those of other robots; then none until the next read.

Longer if the writer did not reply before.
"""

_ROUNDS = 8
_FIRST_ROUNDS = 2
"""Fewer when a writer is first watched: a listener of a thousand robots measures all of them at once."""

_MAX_IN_FLIGHT = 1
"""Queries in flight together would delay each other."""

_DISCOVERY_S = 0.05

OnMeasured: TypeAlias = Callable[[str, WriterId, ClockOffset], object]

_MOST_OF_A_TIMEOUT = 0.9
"""A query that took this part of its timeout has timed out."""


@dataclass(frozen=True, order=True, slots=True)
class MeasuredOffset:
    """The clock of ``writer`` is ``offset_ns`` ahead of the local one, plus or minus ``uncertainty_ns``.

    ``round_trip_ns`` is the shortest one, from query to reply.
    """

    robot: str
    writer: WriterId
    offset_ns: int
    uncertainty_ns: int
    round_trip_ns: int


def measure_offsets(
    session: Session,
    robot: str,
    *,
    clock: Clock | None = None,
    timeout_s: float = 0.5,
) -> tuple[MeasuredOffset, ...]:
    """How far the clock of each writer of ``robot`` ("*": of all robots) is ahead of ``clock``, sorted.

    ``clock`` is this machine's by default. The shortest of eight round trips counts. Empty without a
    reply within ``timeout_s``. Raises InvalidInput and Closed.
    """
    check_timeout(timeout_s)
    return tuple(
        sorted(_measure(session, WRITER_CLOCK.expression(robot), _ROUNDS, clock or SystemClock(), timeout_s))
    )


def unanswered(
    session: Session, writers: Collection[tuple[str, WriterId]], timeout_s: float
) -> dict[tuple[str, WriterId], bool]:
    """The ``writers``, each with its robot, that do not reply with their clocks within ``timeout_s`` [s].

    The value is False for a query that ended earlier without a reply: nothing at its key received it. All are
    queried together. Raises InvalidInput and Closed.
    """
    check_timeout(timeout_s)
    began = time.monotonic()
    ended = threading.Condition()
    replied: set[tuple[str, WriterId]] = set()
    durations_s: dict[tuple[str, WriterId], float] = {}

    def on_reply(of: tuple[str, WriterId], reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            replied.add(of)

    def on_end(of: tuple[str, WriterId]) -> None:
        with ended:
            durations_s[of] = time.monotonic() - began
            ended.notify()

    for robot, writer in writers:
        # Called on threads of Zenoh, which must not wait.
        handler = zenoh.handlers.Callback(
            partial(on_reply, (robot, writer)), partial(on_end, (robot, writer)), indirect=False
        )
        session.zenoh.get(WRITER_CLOCK.key(robot, writer.identity), handler, timeout=timeout_s)
    with ended:
        ended.wait_for(lambda: len(durations_s) == len(writers), timeout_s + _DISCOVERY_S)
    return {
        one: durations_s.get(one, timeout_s) > _MOST_OF_A_TIMEOUT * timeout_s
        for one in writers
        if one not in replied
    }


def _measure(
    session: Session, expression: str, rounds: int, clock: Clock, timeout_s: float
) -> Collection[MeasuredOffset]:
    best: dict[tuple[str, WriterId], MeasuredOffset] = {}
    deadline = time.monotonic() + timeout_s
    while rounds:
        has_reply = False
        sent_ns, now = time.monotonic_ns(), clock.now()
        replies = query(
            session.zenoh,
            expression,
            timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in replies:
            measured = _offset_in(reply, now, time.monotonic_ns() - sent_ns)
            if measured is not None:
                has_reply = True
                key = measured.robot, measured.writer
                best[key] = min(best.get(key, measured), measured, key=lambda one: one.round_trip_ns)
        if has_reply:
            rounds -= 1
        elif best or time.monotonic() > deadline:
            break
        else:
            time.sleep(_DISCOVERY_S)  # a session that has just connected has not discovered all others yet
    return best.values()


def _offset_in(reply: zenoh.Reply, sent: int, round_trip_ns: int) -> MeasuredOffset | None:
    """The offset by the ``reply`` to a query sent at ``sent`` [ns] by the local clock; None for others."""
    if reply.ok is None:
        return None
    try:
        robot, identity = WRITER_CLOCK.parse(str(reply.ok.key_expr))
        writer = WriterId.parse(identity)
        message = decode(reply.ok.payload.to_bytes(), str(reply.ok.encoding), ClockMessage)
    except (InvalidInput, MessageError):
        return None
    if message.session != writer.session:
        return None
    half = round_trip_ns // 2
    return MeasuredOffset(robot, writer, message.stamp - (sent + half), half, round_trip_ns)


class ClockOffsetMonitor:
    """Measures the clock offsets of writers when they are read, by requests of ``thread``.

    ``offsets`` has a function for the printed name of each watched writer, which returns its offset. Robots
    take turns: silent writers of one robot do not delay those of another for long. ``on_measured(robot,
    writer, offset)`` is called in ``thread`` after each measurement.
    """

    def __init__(
        self,
        session: Session,
        thread: ServiceThread,
        clock: Clock,
        offsets: dict[str, Callable[[], ClockOffset | None]] | None = None,
        on_measured: OnMeasured | None = None,
    ) -> None:
        self._requests = Requests(session, thread, _MAX_IN_FLIGHT)
        self._on_measured = on_measured
        self._clock = clock
        self._offsets = {} if offsets is None else offsets
        self._watched: dict[WriterId, _WriterOffset] = {}

    def watch(self, robot: str, writer: WriterId) -> Callable[[], ClockOffset | None]:
        """A function that returns the clock offset of ``writer``; measured now, and again after 30 s."""
        offset = self._watched.get(writer)
        if offset is None:
            offset = self._watched[writer] = _WriterOffset(
                self._requests, self._clock, robot, writer, self._on_measured
            )
            offset()
            self._offsets[str(writer)] = offset
        return offset

    def unwatch(self, writer: WriterId) -> None:
        """Stop measuring the clock of ``writer``; another one of the same name keeps its offset."""
        offset = self._watched.pop(writer, None)
        if offset is not None and self._offsets.get(str(writer)) is offset:
            del self._offsets[str(writer)]


class _WriterOffset(Request):
    """The offset of the clock of ``writer`` from ``clock``, if it is known; reading it requests it again."""

    def __init__(
        self,
        requests: Requests,
        clock: Clock,
        robot: str,
        writer: WriterId,
        on_measured: OnMeasured | None,
    ) -> None:
        self.source = robot
        self._writer, self._on_measured = writer, on_measured
        self._requests = requests
        self._clock = clock
        self._key = WRITER_CLOCK.key(robot, writer.identity)
        self._known: ClockOffset | None = None
        self._unanswered = 0
        self._requested_s = -math.inf
        self._is_measuring = False
        # A measurement: when it began [s], when its last query was sent by both clocks, and what came.
        self._began_s = 0.0
        self._sent_ns = self._sent = 0
        self._reply: tuple[zenoh.Reply, int] | None = None
        self._measured: list[MeasuredOffset] = []

    def __call__(self) -> ClockOffset | None:
        now_s = time.monotonic()
        period_s = _UNANSWERED_REFRESH_S if self._known is None else REFRESH_S
        if now_s - self._requested_s >= period_s and not self._is_measuring:
            self._requested_s, self._is_measuring = now_s, True
            self._requests.add(self)
        return self._known

    @property
    def _timeout_s(self) -> float:
        return _TIMEOUTS_S[min(self._unanswered, len(_TIMEOUTS_S) - 1)]

    def send(self, session: zenoh.Session, handler: ReplyHandler) -> None:
        self._began_s = self._began_s or time.monotonic()
        self._sent_ns, self._sent = time.monotonic_ns(), self._clock.now()
        session.get(self._key, handler, timeout=self._timeout_s, consolidation=zenoh.ConsolidationMode.NONE)

    def on_reply(self, reply: zenoh.Reply) -> None:
        if self._reply is None and reply.ok is not None:
            self._reply = reply, time.monotonic_ns() - self._sent_ns

    def on_end(self) -> float | None:
        # Not kept: a reply holds the memory it was received in, 10 to 20 kB.
        reply, self._reply = self._reply, None
        measured = None if reply is None else _offset_in(reply[0], self._sent, reply[1])
        if measured is not None:
            self._measured.append(measured)
            if len(self._measured) < (_FIRST_ROUNDS if self._known is None else _ROUNDS):
                return 0.0
        elif not self._measured and time.monotonic() < self._began_s + self._timeout_s:
            return _DISCOVERY_S  # a session that has just connected has not discovered all others yet
        if self._measured:
            best = min(self._measured, key=lambda one: one.round_trip_ns)
            self._known = ClockOffset(best.offset_ns, best.uncertainty_ns)
            if self._on_measured is not None:
                self._on_measured(self.source, self._writer, self._known)
        self._unanswered = 0 if self._measured else self._unanswered + 1
        self._began_s, self._measured = 0.0, []
        if 0 < self._unanswered < len(_TIMEOUTS_S):
            return 0.0
        self._is_measuring = False
        return None
