"""MeasuredBuffer: a TransformBuffer that counts what it is asked and how late its samples are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from numpy.typing import ArrayLike

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import JointTrack
from zstate.clock import Clock
from zstate.errors import LookupFailed, WaitTimeout
from zstate.locks import new_lock
from zstate.metrics.histogram import Histogram
from zstate.transform import Transform

LATENCY_BOUNDS_S = (
    *(0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05),
    *(0.1, 0.25, 0.5, 1.0, 2.5, 5.0),
)


class MeasuredBuffer(TransformBuffer):
    """Counts ``lookup`` calls and their failures by kind, and measures the way of each sample.

    ``latency`` [s] is from a sample's stamp until it can be looked up, by the clocks of both machines.
    The kernel's own lookups cannot be counted for nothing, so this is a buffer to be chosen: each
    ``lookup`` takes two to three times as long. What a plan or ``lookup_many`` answers is not counted.
    """

    def __init__(self, history_s: float = 10.0, clock: Clock | None = None) -> None:
        super().__init__(history_s, clock)
        self.latency = Histogram(LATENCY_BOUNDS_S)
        self._counting = new_lock()
        self._lookups = 0
        self._failures: Counter[str] = Counter()

    def latency_of(self, robot: str) -> Histogram:
        """The latency of the samples of one robot, as far as robots are told apart: here they are not."""
        return self.latency

    @property
    def lookups(self) -> int:
        """How often ``lookup`` was called."""
        return self._lookups

    @property
    def failures(self) -> dict[str, int]:
        """How often it had no answer, by the kind of the error: "InFuture", ..., also after a wait."""
        with self._counting:
            return dict(self._failures)

    def lookup(
        self,
        target: str,
        source: str,
        at: int | None = None,
        *,
        timeout_s: float = 0.0,
        max_age_s: float | None = None,
        predict_s: float = 0.0,
    ) -> Transform:
        with self._counting:
            self._lookups += 1
        try:
            return super().lookup(
                target, source, at, timeout_s=timeout_s, max_age_s=max_age_s, predict_s=predict_s
            )
        except LookupFailed as error:
            kind = error.reason if isinstance(error, WaitTimeout) else type(error)
            with self._counting:
                self._failures[kind.__name__] += 1
            raise

    def insert_joints(
        self, track: JointTrack, stamp: int, positions: ArrayLike, velocities: ArrayLike | None = None
    ) -> bool:
        taken = super().insert_joints(track, stamp, positions, velocities)
        self._note_sample(track.prefix, stamp)
        return taken

    def insert_many(
        self, edges: Sequence[tuple[str, str]], stamp: int, poses: ArrayLike, *, writer: str | None = None
    ) -> bool:
        taken = super().insert_many(edges, stamp, poses, writer=writer)
        self._note_sample(self.domain.robot_placing(edges[0][1]), stamp)
        return taken

    def _note_sample(self, robot: str, stamp: int) -> None:
        """A sample of ``robot`` with this stamp [ns] can be looked up now."""
        if (self.domain.domain_of(robot) or self.clock.domain) == self.clock.domain:
            self.latency.note((self.clock.now() - stamp) * 1e-9)
