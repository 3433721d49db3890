"""Exact rates: absolute deadlines, so that no tick's lateness is handed on to the next."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass

from zstate.clock import SYSTEM, Clock
from zstate.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class RateReport:
    """What became of a commanded rate.

    ``rate_hz`` is what was achieved: the ticks after the first, over the time between the first and
    the last. ``skipped`` counts ticks that were given up after a long delay, ``late`` those that began
    more than a period after they were due.
    """

    commanded_hz: float
    rate_hz: float
    ticks: int
    skipped: int
    late: int


# A busy machine holds a process up for some milliseconds now and then; that is made up for. After a
# longer pause (a debugger, a suspended laptop) a burst of old ticks would help nobody.
_LONGEST_DELAY_NS = 100_000_000

# A simulated time comes in steps, which are long when it runs fast.
_LONGEST_STEP_NS = 1_000_000_000


class Rate:
    """Iterate to get the stamp [ns] of each tick; the k-th deadline is ``start + k / rate_hz``.

    Of simulated time, which comes in steps, a tick's stamp is its deadline, and 1 s is a long delay.

    Late ticks follow at once, so the rate stays exact; after a delay of more than 0.1 s the deadlines
    that passed meanwhile are skipped and counted. A clock that is set back is followed. Ends when
    ``stop`` is set, or after ``seconds``.
    """

    def __init__(
        self, rate_hz: float, clock: Clock, stop: threading.Event, seconds: float | None = None
    ) -> None:
        self.rate_hz = check_rate(rate_hz)
        self._period_ns = 1e9 / rate_hz
        if seconds is not None and not (math.isfinite(seconds) and seconds > 0.0):
            raise InvalidInput(f"seconds is a positive number, or None for ever; got {seconds!r}")
        self._ticks_wanted = math.inf if seconds is None else max(1, round(seconds * rate_hz))
        self._clock = clock
        self._is_stepping = clock.domain != SYSTEM
        self._longest_delay_ns = _LONGEST_STEP_NS if self._is_stepping else _LONGEST_DELAY_NS
        self._stop = stop
        self._ticks = 0
        self._skipped = 0
        self._late = 0
        self._first: int | None = None
        self._last = 0

    def __iter__(self) -> Iterator[int]:
        start = self._clock.now()
        tick = 0
        while tick < self._ticks_wanted:
            # No deadline is further away than one period, unless the clock was set back.
            set_back = start + round((tick - 1) * 1e9 / self.rate_hz) - self._clock.now()
            if set_back > _LONGEST_DELAY_NS:
                start -= set_back
            deadline = start + round(tick * 1e9 / self.rate_hz)
            if not self._clock.wait_until(deadline, self._stop):
                return
            now = self._clock.now()
            self._late += now - deadline > self._period_ns
            if now - deadline > self._longest_delay_ns:
                due = int(min((now - start) * self.rate_hz / 1e9, self._ticks_wanted - 1))
                self._skipped += due - tick
                tick = due
                deadline = start + round(tick * 1e9 / self.rate_hz)
            if self._is_stepping:
                now = min(now, deadline)
            self._first = now if self._first is None else self._first
            self._last = now
            self._ticks += 1
            yield now
            tick += 1

    def report(self) -> RateReport:
        """How it went so far."""
        span_ns = 0 if self._first is None else self._last - self._first
        achieved = (self._ticks - 1) * 1e9 / span_ns if span_ns > 0 else 0.0
        return RateReport(self.rate_hz, achieved, self._ticks, self._skipped, self._late)


def check_rate(rate_hz: float) -> float:
    """A rate that can be kept: above 0, at most 10 kHz. Raises InvalidInput."""
    if not (math.isfinite(rate_hz) and 0.0 < rate_hz <= 10_000.0):
        raise InvalidInput(f"a rate is above 0 and at most 10000 Hz; got {rate_hz!r}")
    return rate_hz
