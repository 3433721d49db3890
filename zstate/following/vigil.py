"""Vigil: which announced writers have fallen silent."""

from __future__ import annotations

import math
from dataclasses import dataclass

from zstate.locks import new_lock

Source = tuple[str, int]
"""A robot, and the session of one of its writers."""

AT_LEAST_S = 0.5
PERIODS = 10
_SMOOTHING = 0.1


@dataclass(slots=True)
class _Pulse:
    streams: int = 0
    last_s: float = 0.0
    period_s: float = 0.0
    samples: int = 0
    is_stale: bool = False

    @property
    def due_s(self) -> float:
        """When it is stale, unless a sample comes; one sample does not tell how often they come."""
        if self.samples < 2 or self.is_stale:
            return math.inf
        return self.last_s + max(AT_LEAST_S, PERIODS * self.period_s)


class Vigil:
    """When samples of each writer came, by a monotonic clock [s]. Any thread may ask.

    A writer is stale that has said nothing for ten of its periods, and half a second at least. One of
    which no two samples have come yet never is: it may be that nothing has moved.
    """

    def __init__(self) -> None:
        self._pulses: dict[Source, _Pulse] = {}
        self._lock = new_lock()

    def begin(self, writer: Source) -> None:
        """It is announced, with one more stream."""
        with self._lock:
            self._pulses.setdefault(writer, _Pulse()).streams += 1

    def end(self, writer: Source) -> bool:
        """One of its streams is not announced any more; whether it was stale by then."""
        with self._lock:
            pulse = self._pulses.get(writer)
            if pulse is None:
                return False
            pulse.streams -= 1
            if not pulse.streams:
                del self._pulses[writer]
            return pulse.is_stale

    def hear(self, writer: Source, now_s: float) -> float | None:
        """A sample has come; how long [s] none did, if that was called stale."""
        pulse = self._pulses.get(writer)
        if pulse is None:
            return None
        with self._lock:
            interval_s, pulse.last_s = now_s - pulse.last_s, now_s
            if pulse.is_stale:
                pulse.is_stale = False
                return interval_s
            if pulse.samples == 1:
                pulse.period_s = interval_s
            elif pulse.samples:
                pulse.period_s += _SMOOTHING * (interval_s - pulse.period_s)
            pulse.samples += 1
        return None

    def look(self, now_s: float) -> tuple[dict[Source, float], float]:
        """Who has become stale, with how long [s] each was silent; and when to look again."""
        with self._lock:
            stale = {writer: pulse for writer, pulse in self._pulses.items() if pulse.due_s <= now_s}
            for pulse in stale.values():
                pulse.is_stale = True
            next_s = min((pulse.due_s for pulse in self._pulses.values()), default=math.inf)
        return {writer: now_s - pulse.last_s for writer, pulse in stale.items()}, next_s
