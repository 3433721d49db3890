"""What the publishers of samples have in common: counts, samples at a fixed rate and the end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe
from zstate.clock import Clock, StopEvent, SystemClock
from zstate.errors import Closed
from zstate.net.session import Session
from zstate.nodes.publisher_status import LimitWatch, PublisherStats, RefusalCount, StreamStats
from zstate.nodes.robot_writer import RobotWriter
from zstate.rate import Rate, RateReport

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
        self._stop = fork_safe(StopEvent())

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
