"""Paces: rates of what is only counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable

# Two scrapers that ask at once are given the same rate.
_WINDOW_S = 1.0


class Paces:
    """Rates [Hz] of counts that are read now and then: each over a second or more before the reading."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._marks: dict[Hashable, tuple[float, float, float]] = {}

    def rate_hz(self, key: Hashable, count: float) -> float:
        """The rate of what ``key`` counts, which has come to ``count``; 0 before there are two readings."""
        now = self._clock()
        time_s, before, rate_hz = self._marks.setdefault(key, (now, count, 0.0))
        if now - time_s >= _WINDOW_S:
            rate_hz = max(0.0, count - before) / (now - time_s)
            self._marks[key] = now, count, rate_hz
        return rate_hz
