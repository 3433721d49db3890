"""Ages and latched values of all robots of a reader, in constant memory."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.soak.task import EPOCH_S, Task, epoch
from zstate import TransformBuffer, ZStateError, load_model

STALE_MS = 1000.0

FrameNames = list[tuple[str, str, str]]
"""Per robot: the root of its model, its last link and its mark, as frame names in a buffer."""


def frame_names(task: Task) -> FrameNames:
    """The frame names of all robots."""
    model = load_model(task.model)
    return [(f"{name}/{model.root}", f"{name}/{model.links[-1]}", f"{name}/mark") for name in task.names]


class FleetMonitor:
    """Samples the age and the mark of every robot when ``sample`` is called."""

    def __init__(self, buffer: TransformBuffer, ends: FrameNames) -> None:
        self._buffer = buffer
        self._ends = ends
        self._ages = _Ages()
        self._epoch = 0
        self._latched_after_s: list[float] = []
        self._lost_latched = 0
        self._is_complete = True

    def sample(self) -> None:
        """Samples all robots once."""
        now = time.time_ns()
        for root, tip, _ in self._ends:
            try:
                age = now - self._buffer.latest(root, tip)
            except ZStateError:
                continue
            self._ages.add(age * 1e-6)
        self._sample_latched()

    def _sample_latched(self) -> None:
        behind = count_missing_marks(self._buffer, self._ends)
        if epoch() != self._epoch:
            # The half minute of the start is not counted: not all publishers have started.
            # Nor is the end, after the publishers have left and withdrawn their edges.
            if not self._is_complete and self._latched_after_s and behind < len(self._ends):
                self._lost_latched += behind
            self._epoch, self._is_complete = epoch(), False
            behind = count_missing_marks(self._buffer, self._ends)
        if not behind and not self._is_complete:
            self._is_complete = True
            self._latched_after_s.append(time.time() - self._epoch * EPOCH_S)

    def report(self) -> dict[str, Any]:
        """All figures."""
        late = np.array(self._latched_after_s[1:] or [np.nan])  # the first is the time of joining
        return {
            **self._ages.report(),
            "latched_rounds": len(self._latched_after_s),
            "latched_lost": self._lost_latched,
            "latched_within_s_median_max": [round(float(np.median(late)), 2), round(float(late.max()), 2)],
        }


class _Ages:
    """Ages [ms], counted by tenths of a millisecond up to ten seconds."""

    def __init__(self) -> None:
        self._counts: NDArray[np.int64] = np.zeros(100_001, dtype=np.int64)
        self._largest = 0.0
        self._stale = 0

    def add(self, age_ms: float) -> None:
        self._counts[min(max(0, int(age_ms * 10.0)), len(self._counts) - 1)] += 1
        self._largest = max(self._largest, age_ms)
        self._stale += age_ms > STALE_MS

    def report(self) -> dict[str, Any]:
        seen: NDArray[np.int64] = np.cumsum(self._counts)
        middle, high = (seen.searchsorted([0.5 * seen[-1], 0.99 * seen[-1]]) / 10.0).tolist()
        return {
            "looks": int(seen[-1]),
            "age_ms_p50_p99_max": [middle, high, round(self._largest, 2)],
            "stale_looks": self._stale,
        }


def count_missing_marks(buffer: TransformBuffer, ends: FrameNames) -> int:
    """Number of robots without the static edge of this half minute."""
    current = float(epoch())
    return sum(_mark_value(buffer, root, mark) != current for root, _, mark in ends)


def all_available(buffer: TransformBuffer, ends: FrameNames) -> bool:
    """Whether every robot has a pose."""
    return all(buffer.can_lookup(root, tip) for root, tip, _ in ends)


def _mark_value(buffer: TransformBuffer, root: str, mark: str) -> float | None:
    try:
        return float(buffer.lookup(root, mark).translation[0])
    except ZStateError:  # not received yet, or withdrawn at the end
        return None
