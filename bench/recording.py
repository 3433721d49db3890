"""Recording: what a process has written down, and the figures of one reader made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.int64]

GRID = (*range(100), 99.1, 99.2, 99.3, 99.4, 99.5, 99.6, 99.7, 99.8, 99.9, 99.95, 99.99, 100)
"""The percentiles that are kept of each distribution, so that it can be drawn later."""

# More robots than any scenario has.
_ROBOTS = 1024


def _none() -> Numbers:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Window:
    """What counts: from ``begin`` on, until just before ``end`` [ns]."""

    begin: int
    end: int

    @property
    def seconds(self) -> float:
        """Its length [s]."""
        return (self.end - self.begin) * 1e-9

    def holds(self, stamps: Numbers) -> NDArray[np.bool_]:
        """Which of them are in it."""
        return (stamps >= self.begin) & (stamps < self.end)


@dataclass(frozen=True)
class Recording:
    """Samples in the order they were sent or answered: stamp [ns] and number of the robot.

    ``times`` [ns] are when they were answered. ``ticks`` is how many of the same robot were sent before.
    """

    stamps: Numbers
    robots: Numbers
    times: Numbers = field(default_factory=_none)
    ticks: Numbers = field(default_factory=_none)

    @classmethod
    def of_reader(cls, folder: str, label: str) -> Recording:
        """What a reader has left."""
        return cls(*(_numbers(folder, label, name) for name in ("stamps", "robots", "times")))

    @classmethod
    def of_writers(cls, folder: str, shares: dict[str, Sequence[int]]) -> Recording:
        """What writers have left, by label, each with the numbers of the robots it wrote in turn."""
        parts: list[tuple[Numbers, ...]] = []
        for label, mine in shares.items():
            stamps = _numbers(folder, label, "stamps")
            robots = np.resize(np.array(mine, dtype=np.int64), len(stamps))
            parts.append((stamps, robots, np.arange(len(stamps)) // len(mine)))
        stamps, robots, ticks = (np.concatenate(part) for part in zip(*parts, strict=True))
        return cls(stamps, robots, ticks=ticks)

    def keys(self, begin: int) -> Numbers:
        """A number for each sample, unlike that of any other stamp or robot within minutes of ``begin``."""
        return (self.stamps - begin) * _ROBOTS + self.robots


def _numbers(folder: str, label: str, name: str) -> Numbers:
    return np.fromfile(Path(folder) / f"{label}.{name}", dtype=np.int64)


def reader_figures(
    sent: Recording, heard: Recording, window: Window, rate_hz: float
) -> dict[str, float | int | list[float] | None]:
    """How one reader did.

    ``rate_hz`` is that of the answers made within the window; the others are about the samples that were
    stamped in it: ``lost`` were never answered, ``late`` later than a period after their stamp.
    """
    asked = sent.keys(window.begin)[window.holds(sent.stamps)]
    latencies = (heard.times - heard.stamps)[window.holds(heard.stamps)] * 1e-3
    period_us = 1e6 / rate_hz if rate_hz else None
    return {
        "rate_hz": round(rate_in(heard.times, window), 3),
        "answered": len(latencies),
        "lost": int((~np.isin(asked, heard.keys(window.begin))).sum()),
        "late": None if period_us is None else int((latencies > period_us).sum()),
        "latency_us": latency_grid(latencies),
    }


def rate_in(times: Numbers, window: Window) -> float:
    """How many a second [Hz]: from the first in the window to the first behind it, both known to the ns.

    Their number over the window's length would be wrong by up to one, which is much where there are few.
    Where nothing comes after the window, it is that.
    """
    ordered = np.sort(times)
    first, after = np.searchsorted(ordered, (window.begin, window.end))
    if first == after or after == len(ordered):
        return float(after - first) / window.seconds
    return float((after - first) / ((ordered[after] - ordered[first]) * 1e-9))


def latency_grid(latencies_us: NDArray[np.float64]) -> list[float]:
    """The percentiles of ``GRID``, each of them a latency that was seen: so many percent are no longer."""
    if not latencies_us.size:
        return []
    # 99.9 % of 1000 are 999, which floating point takes for a little more.
    ranks = np.ceil(np.round(np.array(GRID) * latencies_us.size / 100.0, 9)).astype(int)
    grid = np.sort(latencies_us)[np.maximum(ranks, 1) - 1]
    return [round(float(value), 1) for value in grid]


def percentile(grid: Sequence[float], percent: float) -> float:
    """One of the percentiles that are kept."""
    return grid[GRID.index(percent)]
