"""What the publishers of samples have in common: counts, samples at a fixed rate, ownership and the end."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TypeVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.clock import SYSTEM, Clock, SystemClock
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.net.clock_service import ClockService
from zstate.net.ownership import WriterClaim
from zstate.net.presence import local_writer
from zstate.net.sample_history import SampleCache
from zstate.net.session import Session
from zstate.net.status import StatusPublisher
from zstate.net.writer import SampleWriter, WireWriter, write_all
from zstate.nodes.publisher_status import LimitWatch, PublisherStats, StatusReporter, StreamStats
from zstate.plugins import is_named
from zstate.rate import Rate, RateReport
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import check_robot, check_writer
from zstate.wire.messages import StampedMessage, renumbered
from zstate.wire.registry import as_wire_names, get_wire

T = TypeVar("T")

_NEWEST_ONLY_S = 1e-9
"""Span of a cache that has no room for a second sample."""


class SamplePublisher(Closeable):
    """Base of the publishers of one robot's samples, numbered from 0 on in the session ``session_id``."""

    def __init__(self, robot: str, wires: str | Sequence[str], clock: Clock | None, session_id: int) -> None:
        self.robot = check_robot(robot)
        self.warning = ""
        """A fault that the counts do not show, such as a sensor's: part of the status until it is empty."""
        self._wires = as_wire_names(wires)
        self._clock: Clock = clock or SystemClock()
        self._session_id = session_id
        self._writers: dict[tuple[str, StreamName], SampleWriter] = {}
        self._limits: LimitWatch | None = None
        self._seq: int = 0
        self._refused = 0
        self._last_refusal = ""
        self._rate: Rate | None = None
        self._claims: tuple[Callable[[], object], ...] = ()
        """Each raises SecondWriter if another writer owns what this one publishes."""
        self._second_writer: SecondWriter | None = None
        self._opened = ExitStack()
        self._lock = fork_safe_lock()
        self._stop = fork_safe(threading.Event())

    def _serve_clock(self, session: Session, writer: WriterId, opening: ExitStack) -> None:
        """Reply to readers that measure this clock, unless it is simulated.

        Called before ``writer`` is announced: readers that see its token measure its clock at once.
        """
        if self._clock.domain == SYSTEM:
            opening.enter_context(ClockService(session, self.robot, writer, self._clock))

    def _new_cache(self, cache_s: float, numbers: int) -> SampleCache:
        """For the samples of the last ``cache_s`` seconds; 0: for the newest one."""
        return SampleCache(cache_s or _NEWEST_ONLY_S, numbers, self._session_id)

    @property
    def stats(self) -> PublisherStats:
        """Counts of published, suppressed and refused samples."""
        streams = {
            place: StreamStats(*(sent := writer.sent), self._sent - sent[0])
            for place, writer in self._writers.items()
        }
        rate = None if self._rate is None else self._rate.report()
        outside, excess = (0, "") if self._limits is None else self._limits.counted()
        return PublisherStats(
            self._sent,
            self._refused,
            self._last_refusal,
            streams,
            rate,
            outside,
            excess,
            warning=self.warning,
        )

    @property
    def _sent(self) -> int:
        """How many samples were published."""
        return self._seq

    def _count_refusal(self, error: Exception) -> None:
        self._last_refusal = str(error)
        self._refused += 1

    @contextmanager
    def _refusals_counted(self) -> Generator[None]:
        """Counts an InvalidInput that is raised inside."""
        try:
            yield
        except InvalidInput as error:
            self._count_refusal(error)
            raise

    def _check_ownership(self) -> None:
        """Raise SecondWriter if an older writer owns what this one publishes (sticky), and close."""
        if self._second_writer is None:
            try:
                for check in self._claims:
                    check()
            except SecondWriter as error:
                self._second_writer = error
                self._opened.close()
        if self._second_writer is not None:
            raise self._second_writer.with_traceback(None)

    def _publish_at(
        self,
        rate_hz: float,
        seconds: float | None,
        read: Callable[[int], T | None],
        publish: Callable[[T, int], None],
    ) -> RateReport:
        """Publish what ``read`` returns at ``rate_hz``, for ``seconds`` or until ``close()``.

        Both get the present instant [ns]. Raises Closed if the session is closed, or not of this process.
        """
        self._rate = rate = Rate(rate_hz, self._clock, self._stop, seconds)
        for now in rate:
            sample = read(now)
            if sample is not None:
                try:
                    publish(sample, now)
                except Closed:
                    if not self._stop.is_set():
                        raise
                    break
        return rate.report()

    def close(self) -> None:
        """Stop publishing; ``run`` returns. A second call does nothing."""
        self._stop.set()
        with self._lock:
            self._opened.close()


class MeasurementPublisher(SamplePublisher):
    """Base of the publishers of one ``sensor`` on ``stream``, which is the writer's name there.

    On a stream without names ``sensor`` is empty.

    Under congestion messages are dropped, and joining listeners receive none from the past. On the native
    wire each sensor has one writer.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: StreamName,
        sensor: str,
        *,
        wires: str | Sequence[str],
        clock: Clock | None,
        program: str,
    ) -> None:
        identity = local_writer(secrets.randbits(32), program)
        super().__init__(robot, wires, clock, identity.session)
        if not is_named(stream) and sensor:
            raise InvalidInput(f"the writers of {stream} have no names; got {sensor!r}")
        self.sensor = check_writer(sensor) if is_named(stream) else ""
        self._stream: StreamName = stream
        with ExitStack() as opening:
            if "native" in self._wires:
                announced = Announcement(self.robot, stream, identity, self.sensor)
                claim = opening.enter_context(WriterClaim(session, [announced]))
                self._claims = (claim.check,)
                self._serve_clock(session, identity, opening)
            for name in self._wires:
                wire_writer = opening.enter_context(WireWriter(session, get_wire(name), self.robot, identity))
                self._writers[name, stream] = wire_writer.open_stream(stream, self.sensor)
            if self._claims:
                status = StatusReporter(identity, lambda: self.stats).status
                opening.enter_context(StatusPublisher(session, self.robot, identity.identity, status))
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        closed = ", closed" if self._stop.is_set() else ""
        return f"<{type(self).__name__} {self.sensor!r} of {self.robot!r}: {self._seq} messages{closed}>"

    def _publish_message(self, message: StampedMessage) -> None:
        """Publish ``message`` as the next one of this session. Raises SecondWriter and Closed."""
        with self._lock:
            if self._stop.is_set():
                raise Closed(f"the {self._stream} publisher {self.sensor!r} is closed")
            self._check_ownership()
            write_all(self._writers.values(), renumbered(message, self._seq, self._session_id))
            self._seq += 1
