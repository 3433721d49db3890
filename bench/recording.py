"""Stamps and times recorded by a process, and the figures of one reader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.int64]

GRID = (*range(100), 99.1, 99.2, 99.3, 99.4, 99.5, 99.6, 99.7, 99.8, 99.9, 99.95, 99.99, 100)
"""The percentiles stored of each distribution, for later plots."""

# Larger than the number of robots of any scenario.
_ROBOTS = 1024


def _none() -> Numbers:
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Window:
    """The measured half-open interval [begin, end) [ns]."""

    begin: int
    end: int

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return (self.end - self.begin) * 1e-9

    def holds(self, stamps: Numbers) -> NDArray[np.bool_]:
        """Mask of the stamps inside."""
        return (stamps >= self.begin) & (stamps < self.end)


@dataclass(frozen=True)
class Recording:
    """Samples in the order of sending or answering: stamp [ns] and robot index.

    ``times`` [ns] are the times of the answers; ``ticks`` count the earlier samples of the same robot.
    """

    stamps: Numbers
    robots: Numbers
    times: Numbers = field(default_factory=_none)
    ticks: Numbers = field(default_factory=_none)

    @classmethod
    def read_reader(cls, folder: str, label: str) -> Recording:
        """The files of a reader."""
        return cls(*(_numbers(folder, label, name) for name in ("stamps", "robots", "times")))

    @classmethod
    def read_writers(cls, folder: str, shares: dict[str, Sequence[int]]) -> Recording:
        """The files of writers; ``shares`` maps each label to its robot indices, in sending order."""
        parts: list[tuple[Numbers, ...]] = []
        for label, mine in shares.items():
            stamps = _numbers(folder, label, "stamps")
            robots = np.resize(np.array(mine, dtype=np.int64), len(stamps))
            parts.append((stamps, robots, np.arange(len(stamps)) // len(mine)))
        stamps, robots, ticks = (np.concatenate(part) for part in zip(*parts, strict=True))
        return cls(stamps, robots, ticks=ticks)

    def of_robots(self, count: int) -> Recording:
        """The samples of the first ``count`` robots, as sent."""
        of = self.robots < count
        return Recording(self.stamps[of], self.robots[of], ticks=self.ticks[of])

    def keys(self, begin: int) -> Numbers:
        """A key per sample, unique per stamp and robot within minutes of ``begin``."""
        return (self.stamps - begin) * _ROBOTS + self.robots


def _numbers(folder: str, label: str, name: str) -> Numbers:
    return np.fromfile(Path(folder) / f"{label}.{name}", dtype=np.int64)


def reader_figures(sent: Recording, answered: Recording, window: Window, rate_hz: float) -> dict[str, Any]:
    """Figures of one reader.

    ``rate_hz`` counts answers made within the window. The other figures count samples stamped in the window:
    ``lost`` were never answered, ``late`` were answered more than a period after their stamp.
    """
    asked = sent.keys(window.begin)[window.holds(sent.stamps)]
    latencies = (answered.times - answered.stamps)[window.holds(answered.stamps)] * 1e-3
    return {
        "rate_hz": round(rate_in(answered.times, window), 3),
        "answered": len(latencies),
        "lost": int((~np.isin(asked, answered.keys(window.begin))).sum()),
        "late": int((latencies > 1e6 / rate_hz).sum()),
        "latency_us": latency_grid(latencies),
    }


def rate_in(times: Numbers, window: Window) -> float:
    """Rate [Hz] from the first event in the window to the first event after it, both exact to the ns.

    The count divided by the window's length would be wrong by up to one event, which matters for few events;
    it is used only if no event follows the window.
    """
    ordered = np.sort(times)
    first, after = np.searchsorted(ordered, (window.begin, window.end))
    if first == after or after == len(ordered):
        return float(after - first) / window.seconds
    return float((after - first) / ((ordered[after] - ordered[first]) * 1e-9))


def latency_grid(latencies_us: NDArray[np.float64]) -> list[float]:
    """The percentiles of ``GRID``, each an observed latency: that percentage is not larger."""
    if not latencies_us.size:
        return []
    # 99.9 % of 1000 is 999; floating point yields slightly more.
    ranks = np.ceil(np.round(np.array(GRID) * latencies_us.size / 100.0, 9)).astype(int)
    grid = np.sort(latencies_us)[np.maximum(ranks, 1) - 1]
    return [round(float(value), 1) for value in grid]


def percentile(grid: Sequence[float], percent: float) -> float:
    """One percentile of ``GRID``."""
    return grid[GRID.index(percent)]


Answer = tuple[int, int, "list[float] | str | None"]
"""Stamp, robot index, and the pose7 of the tip or an error text; None if the system computes no poses."""


def pose_errors(
    sent: Recording, expected: NDArray[np.float64], answers: Sequence[Answer], begin: int
) -> dict[str, Any]:
    """Differences between answers and ``expected`` (N, 7), the poses of the repeated rows."""
    keys, distances, angles, errors = sent.keys(begin), [0.0], [0.0], []
    for stamp, robot, pose in answers:
        asked = Recording(np.array([stamp]), np.array([robot])).keys(begin)
        places = np.flatnonzero(keys == asked)
        if not places.size:
            errors.append(f"an answer at {stamp}, where no sample was sent")
        elif isinstance(pose, str):
            errors.append(pose)
        elif pose is not None:
            row = expected[sent.ticks[places[0]] % len(expected)].tolist()
            distances.append(distance(pose, row))
            angles.append(rotation_angle(pose, row))
    return {
        "compared": len(distances) - 1,
        "most_m": max(distances),
        "most_rad": max(angles),
        "errors": len(errors),
        "first_error": next(iter(errors), None),
    }


def distance(pose: Sequence[float], other: Sequence[float]) -> float:
    """The distance between two pose7 [m]."""
    return float(np.linalg.norm(np.array(pose[:3]) - np.array(other[:3])))


def rotation_angle(pose: Sequence[float], other: Sequence[float]) -> float:
    """The angle between two pose7 [rad]."""
    p, q = np.array(pose[3:]), np.array(other[3:])
    # From the chord between the quaternions: the cosine cannot distinguish angles below 1e-8 from zero.
    chord = min(float(np.linalg.norm(p - q)), float(np.linalg.norm(p + q)))
    return 4.0 * float(np.arcsin(min(1.0, 0.5 * chord)))
