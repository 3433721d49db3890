"""A buffer that measures how samples come in."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

from zstate._util.bounded_dict import BoundedDict
from zstate.clock import Clock
from zstate.metrics.buffer import LATENCY_BOUNDS_S, Histogram, InstrumentedBuffer
from zstate.net.topic_statistics import IntervalStatistics, Received

_WINDOW_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class RobotMeasure:
    """How the samples of one robot arrived in the last five seconds.

    ``rate_hz`` is 0 if they have missed their deadline, or are fewer than two. ``latency_s`` is the median
    time from a sample's stamp until it could be looked up, by the clocks of both machines; ``age_s`` is that
    of the newest sample. None without samples, and where the clock here does not tell their time.
    """

    rate_hz: float
    latency_s: float | None
    age_s: float | None


class MeteredBuffer(InstrumentedBuffer):
    """A InstrumentedBuffer that also measures, robot by robot, when each sample can be looked up.

    ``has_samples`` is set at the first one.
    """

    def __init__(self, clock: Clock | None = None) -> None:
        super().__init__(clock=clock)
        self.has_samples = threading.Event()
        self._statistics: BoundedDict[str, IntervalStatistics] = BoundedDict()
        self._latencies: BoundedDict[str, Histogram] = BoundedDict()

    def statistics_of(self, robot: str) -> IntervalStatistics:
        """The statistics of the samples of one robot; delays are until they could be looked up."""
        statistics = self._statistics.get(robot)
        if statistics is None:
            statistics = self._statistics[robot] = IntervalStatistics()
        return statistics

    def latency_of(self, robot: str) -> Histogram:
        latency = self._latencies.get(robot)
        if latency is None:
            latency = self._latencies[robot] = Histogram(LATENCY_BOUNDS_S)
        return latency

    def _on_sample(self, robot: str, stamp: int) -> None:
        super()._on_sample(robot, stamp)
        delay = self.clock.now() - stamp
        if self._is_comparable(robot):
            self.latency_of(robot).add(delay * 1e-9)
        statistics = self.statistics_of(robot)
        statistics.add(Received(time.monotonic_ns(), stamp, statistics.count, delay))
        if statistics.count == 1:
            self.has_samples.set()

    def _is_comparable(self, robot: str) -> bool:
        """Whether the clock here tells the time that stamps the samples of ``robot``."""
        return (self.domain.domain_of(robot) or self.clock.domain) == self.clock.domain

    def measure(self, robot: str, within_ns: int = _WINDOW_NS) -> RobotMeasure:
        """How the samples of ``robot`` arrived."""
        statistics, now = self.statistics_of(robot), time.monotonic_ns()
        window, newest = statistics.recent(within_ns, now), statistics.newest
        rate_hz = None if window is None or statistics.is_stale(now) else window.rate_hz
        is_comparable = self._is_comparable(robot)
        return RobotMeasure(
            rate_hz or 0.0,
            window.delay_s if window is not None and is_comparable else None,
            (self.clock.now() - newest.stamp) * 1e-9 if newest is not None and is_comparable else None,
        )
