"""A buffer that measures how samples come in."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from itertools import islice
from statistics import median

from zstate.clock import Clock, SystemClock
from zstate.following.bounded import remember
from zstate.metrics.buffer import LATENCY_BOUNDS_S, Histogram, InstrumentedBuffer

# Enough for a median, bounded for a demo that runs for days.
_KEPT = 100_000


@dataclass(frozen=True, slots=True)
class Mark:
    """A moment to measure from: how many samples had come at a time of the monotonic clock [s]."""

    time_s: float
    count: int


@dataclass(frozen=True, slots=True)
class Measure:
    """How samples came in between two marks.

    ``rate_hz`` counts arrivals here; ``latency_s`` is the median time from a sample's stamp until it
    could be looked up, by the clocks of both machines; ``age_s`` is that of the newest sample now. None
    without samples, and where the clock here does not tell their time.
    """

    rate_hz: float
    latency_s: float | None
    age_s: float | None


class Meter:
    """Measures what comes in. One thread notes, another one measures. ``has_begun`` is set at the first."""

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock: Clock = clock or SystemClock()
        self.has_begun = threading.Event()
        self._lock = threading.Lock()
        self._delays: deque[int] = deque(maxlen=_KEPT)
        self._count = 0
        self._newest: int | None = None

    def note(self, stamp: int) -> None:
        """A sample of this stamp [ns] can be looked up now."""
        with self._lock:
            self._delays.append(self._clock.now() - stamp)
            self._newest = stamp
            self._count += 1
        self.has_begun.set()

    def mark(self) -> Mark:
        """This moment."""
        return Mark(time.monotonic(), self._count)

    def measure(self, since: Mark, until: Mark) -> Measure:
        """What came between two marks, as far as the last 100 000 samples tell."""
        with self._lock:
            newest, after = self._newest, self._count - until.count
            delays = list(islice(reversed(self._delays), after, self._count - since.count))
        passed_s = until.time_s - since.time_s
        return Measure(
            (until.count - since.count) / passed_s if passed_s > 0.0 else 0.0,
            median(delays) * 1e-9 if delays else None,
            None if newest is None else (self._clock.now() - newest) * 1e-9,
        )


class MeteredBuffer(InstrumentedBuffer):
    """A InstrumentedBuffer that also notes, robot by robot, when each sample can be looked up."""

    def __init__(self, clock: Clock | None = None) -> None:
        super().__init__(clock=clock)
        self._meters: dict[str, Meter] = {}
        self._latencies: dict[str, Histogram] = {}

    def meter_of(self, robot: str) -> Meter:
        """What measures the samples of one robot."""
        meter = self._meters.get(robot)
        if meter is None:
            meter = Meter(self.clock)
            remember(self._meters, robot, meter)
        return meter

    def latency_of(self, robot: str) -> Histogram:
        latency = self._latencies.get(robot)
        if latency is None:
            latency = Histogram(LATENCY_BOUNDS_S)
            remember(self._latencies, robot, latency)
        return latency

    def _on_sample(self, robot: str, stamp: int) -> None:
        super()._on_sample(robot, stamp)
        if self._is_told(robot):
            self.latency_of(robot).add((self.clock.now() - stamp) * 1e-9)
        self.meter_of(robot).note(stamp)

    def _is_told(self, robot: str) -> bool:
        """Whether the clock here tells the time that stamps the samples of ``robot``."""
        return (self.domain.of(robot) or self.clock.domain) == self.clock.domain

    def measure(self, robot: str, since: Mark, until: Mark) -> Measure:
        """How samples of ``robot`` came in between two marks of its meter."""
        measure = self.meter_of(robot).measure(since, until)
        return measure if self._is_told(robot) else replace(measure, latency_s=None, age_s=None)
