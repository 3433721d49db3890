"""Deadline of a periodic writer (DDS: deadline missed): the only rule for when a writer is stale.

A writer is stale after ten of its periods without a sample, and never before half a second. Commands, the
page and the events of a listener all apply this rule. The floor is 0.5 s because a
fast writer on a busy host or a wireless link pauses for tenths of a second without being in trouble, and
because ``WriterEvent`` documents it. A writer with an unknown period, of fewer than two samples, is
never stale: its robot may just not have moved.

Samples that a site's router thins (zstate.net.sites) come at a fixed period, whatever the writer does: three
of these and a margin for the link are enough.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from zstate._util.fork_safe import fork_safe_lock

FLOOR_S = 0.5
PERIODS = 10
_SMOOTHING = 0.1
_THINNED_PERIODS = 3
_THINNED_MARGIN_S = 0.2
_THINNED_LEAST = 0.8
"""Of the thinned period: samples that come faster were not thinned, as within the site."""

Writer = tuple[str, int]
"""A robot, and the session of one of its writers."""


def deadline_s(period_s: float, thinned_s: float = math.inf) -> float:
    """How long [s] a writer of this period may be silent; ``thinned_s`` is that at which a site lets pass."""
    if period_s > _THINNED_LEAST * thinned_s:
        return max(FLOOR_S, _THINNED_PERIODS * period_s + _THINNED_MARGIN_S)
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
        return self.due_if_thinned_s(math.inf)

    def due_if_thinned_s(self, thinned_s: float) -> float:
        """``due_s`` if a site lets samples pass at this period."""
        if not self.samples:
            return math.inf
        return self.last_s + (deadline_s(self.period_s, thinned_s) if self.samples > 1 else self.unknown_s)

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
        self.thinned_s: Mapping[str, float] = {}
        """The periods at which sites let samples pass, by robot. May be replaced at any time."""
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
            thinned_s = self.thinned_s
            due_s = {
                writer: one.deadline.due_if_thinned_s(thinned_s.get(writer[0], math.inf))
                for writer, one in self._writers.items()
                if not one.is_stale
            }
            stale = {
                writer: now_s - self._writers[writer].deadline.last_s
                for writer, due in due_s.items()
                if due <= now_s
            }
            for writer in stale:
                self._writers[writer].is_stale = True
            next_s = min((due for due in due_s.values() if due > now_s), default=math.inf)
        return stale, next_s
