"""Transform buffers that count lookups and measure the rate and latency of samples."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal

from numpy.typing import ArrayLike

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.buffer import DEFAULT_HISTORY_S, TransformBuffer
from zstate.buffer.tracks import JointTrack
from zstate.clock import Clock
from zstate.errors import LookupFailed, WaitTimeout
from zstate.net.topic_statistics import Arrival, IntervalStatistics
from zstate.transform import Transform

LATENCY_BOUNDS_S = (
    *(0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05),
    *(0.1, 0.25, 0.5, 1.0, 2.5, 5.0),
)


SampleKind = Literal["joint_states", "transforms"]
"""What a sample of a robot consists of; "transforms" in the streams tf and transforms."""


class Histogram:
    """Counts of values up to each of ``bounds`` (ascending), and above. Safe from any thread."""

    def __init__(self, bounds: Sequence[float]) -> None:
        self._bounds = tuple(bounds)
        self._counts = [0] * (len(self._bounds) + 1)
        self._total = 0.0
        self._lock = fork_safe_lock()

    def add(self, value: float) -> None:
        """Count a value."""
        with self._lock:
            self._counts[bisect_left(self._bounds, value)] += 1
            self._total += value

    def read(self) -> tuple[list[tuple[str, float]], float]:
        """(bound, number of values up to it), the last bound being "+Inf"; and the sum of all values."""
        with self._lock:
            counts, total = self._counts.copy(), self._total
        bounds = (*(f"{bound:g}" for bound in self._bounds), "+Inf")
        return list(zip(bounds, map(float, accumulate(counts)), strict=True)), total


class InstrumentedBuffer(TransformBuffer):
    """Counts ``lookup`` calls and their failures by kind, and measures the latency of each sample.

    ``latency`` [s] is the time from a sample's stamp until it can be looked up, by the clocks of both
    machines. Counting makes each ``lookup`` two to three times as slow, so this buffer is optional. Lookups
    by a plan or by ``lookup_many`` are not counted.
    """

    def __init__(self, history_s: float = DEFAULT_HISTORY_S, clock: Clock | None = None) -> None:
        super().__init__(history_s, clock)
        self.latency = Histogram(LATENCY_BOUNDS_S)
        self._counting = fork_safe_lock()
        self.lookups = 0
        """Number of calls of ``lookup``."""
        self._failures: Counter[str] = Counter()

    def latency_of(self, robot: str) -> Histogram:
        """The latency of one robot; here that of all robots."""
        return self.latency

    @property
    def failures(self) -> dict[str, int]:
        """Number of failed lookups by error class: "InFuture", ..., also after a wait."""
        with self._counting:
            return dict(self._failures)

    def lookup(self, target: str, source: str, at: int | None = None, **options: Any) -> Transform:
        with self._counting:
            self.lookups += 1
        try:
            return super().lookup(target, source, at, **options)
        except LookupFailed as error:
            kind = error.reason if isinstance(error, WaitTimeout) else type(error)
            with self._counting:
                self._failures[kind.__name__] += 1
            raise

    def insert_joints(
        self, track: JointTrack, stamp: int, positions: ArrayLike, velocities: ArrayLike | None = None
    ) -> bool:
        inserted = super().insert_joints(track, stamp, positions, velocities)
        self._on_sample(track.prefix, "joint_states", stamp)
        return inserted

    def insert_many(
        self,
        edges: Sequence[tuple[str, str]],
        stamp: int,
        poses: ArrayLike,
        *,
        covariances: ArrayLike | None = None,
        writer: str | None = None,
    ) -> bool:
        inserted = super().insert_many(edges, stamp, poses, covariances=covariances, writer=writer)
        self._on_sample(self._feed.domain.robot_placing(edges[0][1]), "transforms", stamp)
        return inserted

    def _on_sample(self, robot: str, kind: SampleKind, stamp: int) -> None:
        """Called when a sample of ``robot`` with this stamp [ns] can be looked up."""
        if self._is_comparable(robot):
            self.latency.add((self.clock.now() - stamp) * 1e-9)

    def _is_comparable(self, robot: str) -> bool:
        """Whether the samples of ``robot`` are stamped in the clock domain of this buffer's clock."""
        return (self._feed.domain.domain_of(robot) or self.clock.domain) == self.clock.domain


_WINDOW_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class RobotMeasure:
    """How the samples of one robot arrived in the last five seconds.

    They are its joint states, or its transforms if it has no joint states. ``rate_hz`` is 0 if they have
    missed their deadline, or are fewer than two. ``latency_s`` is the median time from a sample's stamp until
    it could be looked up, by the clocks of both machines; ``age_s`` is that of the newest sample. Both are
    None without samples, and with stamps of another clock domain. ``transforms_hz`` is the rate of transforms
    besides joint states, of all writers together; None if there are none.
    """

    rate_hz: float
    latency_s: float | None
    age_s: float | None
    transforms_hz: float | None = None


class MeteredBuffer(InstrumentedBuffer):
    """An InstrumentedBuffer that also measures each robot."""

    def __init__(self, clock: Clock | None = None) -> None:
        super().__init__(clock=clock)
        self._statistics: BoundedDict[tuple[str, SampleKind], IntervalStatistics] = BoundedDict()
        self._latencies: BoundedDict[str, Histogram] = BoundedDict()

    def statistics_of(self, robot: str, kind: SampleKind | None = None) -> IntervalStatistics:
        """The statistics of the samples of one robot; delays are until they could be looked up.

        By default those of its joint states, or of its transforms if it has no joint states.
        """
        if kind is None:
            kind = "joint_states" if (robot, "joint_states") in self._statistics else "transforms"
        known = self._statistics.get((robot, kind))
        return known or self._statistics.setdefault((robot, kind), IntervalStatistics())

    def latency_of(self, robot: str) -> Histogram:
        return self._latencies.get(robot) or self._latencies.setdefault(robot, Histogram(LATENCY_BOUNDS_S))

    def _on_sample(self, robot: str, kind: SampleKind, stamp: int) -> None:
        super()._on_sample(robot, kind, stamp)
        delay = self.clock.now() - stamp
        if self._is_comparable(robot):
            self.latency_of(robot).add(delay * 1e-9)
        statistics = self.statistics_of(robot, kind)
        with self._counting:  # each stream has a thread
            statistics.add(Arrival(time.monotonic_ns(), stamp, statistics.count, delay))

    def measure(self, robot: str, within_ns: int = _WINDOW_NS) -> RobotMeasure:
        """How the samples of ``robot`` arrived."""
        statistics, now = self.statistics_of(robot), time.monotonic_ns()
        window, newest = statistics.recent(within_ns, now), statistics.newest
        is_comparable = self._is_comparable(robot)
        transforms = self._statistics.get((robot, "transforms"))
        return RobotMeasure(
            _rate_hz(statistics, within_ns, now),
            window.delay_s if window is not None and is_comparable else None,
            (self.clock.now() - newest.stamp) * 1e-9 if newest is not None and is_comparable else None,
            _rate_hz(transforms, within_ns, now)
            if transforms is not None and transforms is not statistics
            else None,
        )


def _rate_hz(statistics: IntervalStatistics, within_ns: int, now: int) -> float:
    """The rate of samples; 0 if they have missed their deadline, or are fewer than two."""
    window = statistics.recent(within_ns, now)
    return 0.0 if window is None or statistics.is_stale(now) else window.rate_hz or 0.0
