"""What the publishers of samples have in common: counts, samples at a fixed rate and the end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TypeVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe
from zstate.clock import Clock, SystemClock
from zstate.errors import Closed, InvalidInput
from zstate.net.session import Session
from zstate.nodes.publisher_status import LimitWatch, PublisherStats, RefusalCount, StreamStats
from zstate.nodes.robot_writer import RobotWriter
from zstate.plugins import is_named
from zstate.rate import Rate, RateReport
from zstate.streams import StampedMessage, StreamName
from zstate.wire.keys import check_writer
from zstate.wire.messages import renumbered

T = TypeVar("T")


class SamplePublisher(Closeable):
    """Base of the publishers of one robot's samples, which ``_out`` sends."""

    def __init__(
        self, session: Session, robot: str, wires: str | Sequence[str], clock: Clock | None, program: str
    ) -> None:
        self._clock: Clock = clock or SystemClock()
        self._out = RobotWriter(session, robot, wires, program, self._clock)
        self.robot = robot
        self.warning = ""
        """A fault that the counts do not show, such as a sensor's: part of the status until it is empty."""
        self._limits: LimitWatch | None = None
        self._refusals = RefusalCount()
        self._rate: Rate | None = None
        self._stop = fork_safe(threading.Event())

    @property
    def stats(self) -> PublisherStats:
        """Counts of published, suppressed and refused samples."""
        streams = {
            key: StreamStats(*(sent := writer.sent), self._sent - sent[0])
            for key, writer in self._out.streams.items()
        }
        rate = None if self._rate is None else self._rate.report()
        outside, excess = (0, "") if self._limits is None else self._limits.counted()
        counts = self._sent, self._refusals.count, self._refusals.newest
        return PublisherStats(*counts, streams, rate, outside, excess, warning=self.warning)

    @property
    def _sent(self) -> int:
        """How many samples were published."""
        return self._out.seq

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
        self._out.close()


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
        super().__init__(session, robot, wires, clock, program)
        if not is_named(stream) and sensor:
            raise InvalidInput(f"the writers of {stream} have no names; got {sensor!r}")
        self.sensor = check_writer(sensor) if is_named(stream) else ""
        out = self._out
        out.title = f"the {stream} publisher {self.sensor!r}"
        with out.opening():
            out.own([out.announcement(stream, self.sensor)])
            for wire in out.open_wires():
                out.open_stream(wire, stream, self.sensor)
            out.report_status(lambda: self.stats)

    def _send(self, message: StampedMessage) -> None:
        """Publish ``message`` as the next one of this session. Raises SecondWriter and Closed."""
        out = self._out
        with out.lock:
            out.check()
            out.send(renumbered(message, out.seq, out.session_id))

    def __repr__(self) -> str:
        closed = ", closed" if self._out.is_closed else ""
        return f"<{type(self).__name__} {self.sensor!r} of {self.robot!r}: {self._sent} messages{closed}>"
