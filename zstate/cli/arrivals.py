"""Arrivals: when the last samples came, and what their spacing says."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from statistics import pstdev

from zstate._util.bounded_dict import BoundedDict
from zstate.cli.stream_reader import TimedSample


@dataclass(frozen=True, slots=True)
class Intervals:
    """What the arrivals in a window say; ``window`` counts samples, times are in seconds.

    ``missed`` counts gaps in the writer's sequence numbers since the start.
    """

    rate_hz: float
    min_s: float
    max_s: float
    std_dev_s: float
    window: int
    missed: int


class Arrivals:
    """The last ``window`` arrivals.

    One writer is measured: another one is the same that has started anew, and begins a new window. Or,
    if ``of_all``, all who write, together.
    """

    def __init__(self, window: int, *, of_all: bool = False) -> None:
        self._came: deque[int] = deque(maxlen=window)
        self._missed = 0
        self._of_all = of_all
        self._last: BoundedDict[int, int] = BoundedDict()

    def note(self, tapped: TimedSample) -> None:
        """Another arrival. Several samples of one message are one."""
        session, seq = tapped.sample.session, tapped.sample.seq
        before = self._last.get(session)
        if before == seq:
            return
        if before is not None:
            self._missed += max(0, seq - before - 1)
        elif not self._of_all:
            self._came.clear()
            self._last.clear()
        self._last[session] = seq
        self._came.append(tapped.came)

    def intervals(self) -> Intervals | None:
        """None before there are two samples."""
        if len(self._came) < 2:
            return None
        steps = [(later - earlier) * 1e-9 for earlier, later in pairwise(self._came)]
        rate_hz = len(steps) / sum(steps) if sum(steps) else float("inf")
        return Intervals(rate_hz, min(steps), max(steps), pstdev(steps), len(self._came), self._missed)
