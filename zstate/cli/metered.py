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


class Meter:
    """Measures what comes in. One thread notes, another one measures."""

    def __init__(self) -> None:
        self._delays: deque[int] = deque(maxlen=_KEPT)
        self._count = self._measured = 0
        self._newest: int | None = None
        self._measured_at = time.monotonic()

    def note(self, stamp: int) -> None:
        """A sample of this stamp [ns] can be looked up now."""
        self._delays.append(time.time_ns() - stamp)
        self._newest = stamp
        self._count += 1

    def measure(self) -> Measure:
        """What came since the last call."""
        delays, self._delays = self._delays, deque(maxlen=_KEPT)
        count, now = self._count, time.monotonic()
        fresh, passed_s = count - self._measured, now - self._measured_at
        self._measured, self._measured_at = count, now
        newest = self._newest
        return Measure(
            fresh / passed_s,
            median(delays) * 1e-9 if delays else None,
            None if newest is None else (time.time_ns() - newest) * 1e-9,
        )


class MeteredBuffer(TransformBuffer):
    """A TransformBuffer whose ``meter`` notes when each sample of a robot can be looked up."""

    def __init__(self) -> None:
        super().__init__()
        self.meter = Meter()

    def insert_joints(
        self, track: JointTrack, stamp: int, positions: ArrayLike, velocities: ArrayLike | None = None
    ) -> bool:
        taken = super().insert_joints(track, stamp, positions, velocities)
        self.meter.note(stamp)
        return taken

    def insert_many(
        self, edges: Sequence[tuple[str, str]], stamp: int, poses: ArrayLike, *, writer: str | None = None
    ) -> bool:
        taken = super().insert_many(edges, stamp, poses, writer=writer)
        self.meter.note(stamp)
        return taken
