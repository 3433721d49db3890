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

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.clock import Clock, ClockOffset, SystemClock
from zstate.errors import Closed, InvalidInput, MessageError
from zstate.net.at_exit import join_at_exit
from zstate.net.queryable import check_timeout, query
from zstate.net.sample_history import RoundRobinQueue
from zstate.net.session import Session
from zstate.wire.identity import WriterId
from zstate.wire.keys import WRITER_CLOCK
from zstate.wire.messages import ClockMessage
from zstate.wire.native import decode

REFRESH_S = 30.0
"""A measurement older than this is repeated when it is read; sooner while there was no reply."""

_UNANSWERED_REFRESH_S = 5.0

_TIMEOUTS_S = (0.1, 0.2, 0.5)
"""Of three attempts, the later two after those of other robots; then none until the offset is read again.

Longer if the writer did not reply before.
"""

_ROUNDS = 8
_FIRST_ROUNDS = 2
"""Fewer when a writer is first watched: a listener of a thousand robots measures all of them at once."""

_DISCOVERY_S = 0.05

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


class ClockOffsetMonitor(Closeable):
    """Measures the clock offsets of writers when they are read, in its own thread.

    ``offsets`` has a function for the printed name of each watched writer, which returns its offset. The
    thread lives only while there is something to measure. Robots take turns: silent writers of one robot do
    not delay those of another for long.
    """

    def __init__(
        self,
        session: Session,
        clock: Clock,
        offsets: dict[str, Callable[[], ClockOffset | None]] | None = None,
    ) -> None:
        self._session = session
        self._clock = clock
        self._offsets = {} if offsets is None else offsets
        self._watched: dict[WriterId, _WriterOffset] = {}
        self._requests: RoundRobinQueue[_WriterOffset] = RoundRobinQueue()
        self._lock = fork_safe_lock()
        self._is_running = False
        self._is_open = True

    def watch(self, robot: str, writer: WriterId) -> Callable[[], ClockOffset | None]:
        """A function that returns the clock offset of ``writer``; measured now, and again after 30 s."""
        offset = self._watched.get(writer)
        if offset is None:
            offset = self._watched[writer] = _WriterOffset(
                self, robot, WRITER_CLOCK.key(robot, writer.identity)
            )
            offset()
            self._offsets[str(writer)] = offset
        return offset

    def unwatch(self, writer: WriterId) -> None:
        """Stop measuring the clock of ``writer``; another one of the same name keeps its offset."""
        offset = self._watched.pop(writer, None)
        if offset is not None and self._offsets.get(str(writer)) is offset:
            del self._offsets[str(writer)]

    def request(self, offset: _WriterOffset) -> None:
        """Measure ``offset`` after the ones that were requested before."""
        with self._lock:
            if not self._is_open:
                return
            self._requests.add(offset.robot, offset)
            if not self._is_running:
                self._is_running = True
                thread = threading.Thread(target=self._run, name="zstate clock offsets", daemon=True)
                try:
                    join_at_exit(thread).start()
                except RuntimeError:  # the interpreter is ending and starts no more threads
                    self._is_open = False

    def close(self) -> None:
        """Stop measuring; the last offsets stay. A second call does nothing."""
        with self._lock:
            self._is_open = False
            self._requests.clear()

    def _run(self) -> None:
        while True:
            with self._lock:
                offset = self._requests.pop(0.0)
                if offset is None:
                    self._is_running = False
                    return
            timeout_s = _TIMEOUTS_S[min(offset.unanswered, len(_TIMEOUTS_S) - 1)]
            try:
                rounds = _FIRST_ROUNDS if offset.known is None else _ROUNDS
                measured = _measure(self._session, offset.key, rounds, self._clock, timeout_s)
            except (Closed, zenoh.ZError):
                self.close()  # with the session
                continue
            for one in measured:
                offset.known = ClockOffset(one.offset_ns, one.uncertainty_ns)
            offset.unanswered = 0 if measured else offset.unanswered + 1
            if 0 < offset.unanswered < len(_TIMEOUTS_S):
                self.request(offset)


@dataclass(eq=False)
class _WriterOffset:
    """The offset of one writer's clock, if it is ``known``."""

    monitor: ClockOffsetMonitor
    robot: str
    key: str
    known: ClockOffset | None = None
    unanswered: int = 0
    requested_s: float = -math.inf

    def __call__(self) -> ClockOffset | None:
        now_s = time.monotonic()
        if now_s - self.requested_s >= (_UNANSWERED_REFRESH_S if self.known is None else REFRESH_S):
            self.requested_s = now_s
            self.monitor.request(self)
        return self.known
