"""Histogram: how often each size was seen, in buckets."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from itertools import accumulate

from zstate.locks import new_lock


class Histogram:
    """Counts values up to each of ``bounds`` (ascending), and above. Any thread may note."""

    def __init__(self, bounds: Sequence[float]) -> None:
        self._bounds = tuple(bounds)
        self._counts = [0] * (len(self._bounds) + 1)
        self._total = 0.0
        self._lock = new_lock()

    def note(self, value: float) -> None:
        """Another value."""
        with self._lock:
            self._counts[bisect_left(self._bounds, value)] += 1
            self._total += value

    def read(self) -> tuple[list[tuple[str, float]], float]:
        """(bound, how many values were not above it), the last bound being "+Inf"; and their total."""
        with self._lock:
            counts, total = self._counts.copy(), self._total
        bounds = (*(f"{bound:g}" for bound in self._bounds), "+Inf")
        return list(zip(bounds, map(float, accumulate(counts)), strict=True)), total
