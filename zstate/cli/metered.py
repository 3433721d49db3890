"""A buffer that measures how samples come in."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from numpy.typing import ArrayLike

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import JointTrack

# A second of the fastest robot; older ones say nothing about now.
_KEPT = 1000


@dataclass(frozen=True, slots=True)
class Measure:
    """How samples came in since the last measure.

    ``rate_hz`` counts arrivals here; ``latency_s`` is the median time from a sample's stamp until it
    could be looked up, by the clocks of both machines; ``age_s`` is that of the newest sample now. None
    without samples.
    """

    rate_hz: float
    latency_s: float | None
    age_s: float | None


class MeteredBuffer(TransformBuffer):
    """A TransformBuffer that notes when each sample of a robot could be looked up."""

    def __init__(self) -> None:
        super().__init__()
        self._delays: deque[int] = deque(maxlen=_KEPT)
        self._count = 0
        self._newest: int | None = None
        self._measured_at = time.monotonic()

    def insert_joints(
        self, track: JointTrack, stamp: int, positions: ArrayLike, velocities: ArrayLike | None = None
    ) -> bool:
        taken = super().insert_joints(track, stamp, positions, velocities)
        self._note(stamp)
        return taken

    def insert_many(
        self, edges: Sequence[tuple[str, str]], stamp: int, poses: ArrayLike, *, writer: str | None = None
    ) -> bool:
        taken = super().insert_many(edges, stamp, poses, writer=writer)
        self._note(stamp)
        return taken

    def _note(self, stamp: int) -> None:
        self._delays.append(time.time_ns() - stamp)
        self._newest = stamp
        self._count += 1

    def measure(self) -> Measure:
        """What came since the last call."""
        delays, self._delays = self._delays, deque(maxlen=_KEPT)
        count, self._count = self._count, 0
        now = time.monotonic()
        passed_s, self._measured_at = now - self._measured_at, now
        return Measure(
            count / passed_s,
            median(delays) * 1e-9 if delays else None,
            None if self._newest is None else (time.time_ns() - self._newest) * 1e-9,
        )
