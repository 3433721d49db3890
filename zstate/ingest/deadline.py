"""Deadline of a periodic writer (DDS: deadline missed): the only rule for when a writer is stale.

A writer is stale after ten of its periods without a sample, and never before half a second. Commands, the
page and the events of a listener all apply this rule. The floor is 0.5 s because a
fast writer on a busy host or a wireless link pauses for tenths of a second without being in trouble, and
because ``WriterEvent`` documents it. A writer with an unknown period, of fewer than two samples, is
never stale: its robot may just not have moved.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from zstate._util.fork_safe import fork_safe_lock

FLOOR_S = 0.5
PERIODS = 10
_SMOOTHING = 0.1

Writer = tuple[str, int]
"""A robot, and the session of one of its writers."""


def deadline_s(period_s: float) -> float:
    """How long [s] a writer of this period may be silent."""
    return max(FLOOR_S, PERIODS * period_s)


def is_stale(silent_s: float, rate_hz: float | None) -> bool:
    """Whether a writer of this rate, silent for ``silent_s``, has missed its deadline."""
    return bool(rate_hz) and silent_s > deadline_s(1.0 / rate_hz)


@dataclass(slots=True)
class Deadline:
    """Deadline of one writer, from the arrival times of its samples by a monotonic clock [s].

    ``period_s`` is smoothed exponentially, and a silence is no period. If two deadlines in a row are
    missed the writer has become slower, and the last interval is its period. ``unknown_s`` is how long
    the writer may be silent after its first sample.
    """

    unknown_s: float = math.inf
    last_s: float = 0.0
    period_s: float = 0.0
    samples: int = 0
    misses: int = 0

    def on_sample(self, now_s: float) -> None:
        """Count a sample."""
        interval_s, self.last_s = now_s - self.last_s, now_s
        samples, self.samples = self.samples, self.samples + 1
        if samples < 2:
            self.period_s = interval_s if samples else 0.0
        elif interval_s <= FLOOR_S or interval_s <= PERIODS * self.period_s:  # ``deadline_s``, faster
            self.misses = 0
            self.period_s += _SMOOTHING * (interval_s - self.period_s)
        else:
            self.misses += 1
            if self.misses > 1:
                self.period_s = interval_s

    @property
    def due_s(self) -> float:
        """When the writer becomes stale, unless a sample arrives."""
        if not self.samples:
            return math.inf
        return self.last_s + (deadline_s(self.period_s) if self.samples > 1 else self.unknown_s)

    def is_missed(self, now_s: float) -> bool:
        """Whether the writer is stale."""
        return now_s > self.due_s


@dataclass(slots=True)
class _Registered:
    streams: int = 0
    is_stale: bool = False
    deadline: Deadline = field(default_factory=Deadline)


class DeadlineMonitor:
    """Deadlines of registered writers, by a monotonic clock [s]. Thread-safe."""

    def __init__(self) -> None:
        self._writers: dict[Writer, _Registered] = {}
        self._lock = fork_safe_lock()

    def register(self, writer: Writer) -> None:
        """Monitor a writer from now on. Counts its streams: one call for each."""
        with self._lock:
            self._writers.setdefault(writer, _Registered()).streams += 1

    def unregister(self, writer: Writer) -> bool:
        """Remove one stream of a writer, and the writer with its last one. Returns whether it was stale."""
        with self._lock:
            registered = self._writers.get(writer)
            if registered is None:
                return False
            registered.streams -= 1
            if not registered.streams:
                del self._writers[writer]
            return registered.is_stale

    def on_sample(self, writer: Writer, now_s: float) -> float | None:
        """Count a sample. Returns how long [s] the writer was silent if it was stale, else None."""
        registered = self._writers.get(writer)
        if registered is None:
            return None
        with self._lock:
            silent_s = now_s - registered.deadline.last_s if registered.is_stale else None
            registered.is_stale = False
            registered.deadline.on_sample(now_s)
        return silent_s

    def expired(self, now_s: float) -> tuple[dict[Writer, float], float]:
        """Writers that became stale since the last call, with their silence [s]; and the next due time."""
        with self._lock:
            fresh = {writer: one for writer, one in self._writers.items() if not one.is_stale}
            stale = {
                writer: now_s - one.deadline.last_s
                for writer, one in fresh.items()
                if one.deadline.due_s <= now_s
            }
            for writer in stale:
                fresh.pop(writer).is_stale = True
            next_s = min((one.deadline.due_s for one in fresh.values()), default=math.inf)
        return stale, next_s
