"""The pace of loops: absolute deadlines, where a late tick does not delay the following ones."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass

from zstate.clock import MONOTONIC, SYSTEM, Clock
from zstate.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class RateReport:
    """Statistics of a Rate, or of the pace of a device.

    ``rate_hz`` is the achieved rate: the ticks after the first, over the time between the first and
    the last. ``skipped`` counts ticks that were dropped after a long delay, ``late`` the ticks that started
    more than a period after their deadline. If a device sets the pace, there are none, and ``commanded_hz``
    is 0.
    """

    commanded_hz: float
    rate_hz: float
    ticks: int
    skipped: int
    late: int


# Delays of some milliseconds on a busy machine are made up for. After a longer pause (a debugger, a
# suspended laptop) a burst of old ticks would be useless.
_LONGEST_DELAY_NS = 100_000_000

# Simulated time advances in steps, which are long if it runs fast.
_LONGEST_STEP_NS = 1_000_000_000


class Rate:
    """Iterate to get the stamp [ns] of each tick; the k-th deadline is ``start + k / rate_hz``.

    Late ticks follow at once, so the rate stays exact; after a delay of more than 0.1 s the deadlines
    in the past are skipped and counted. Simulated time advances in steps: there a tick's stamp is its
    deadline, and only more than 1 s counts as a long delay. If the clock is set back, the deadlines move
    with it. Ends when ``stop`` is set, or after ``seconds``.

    With ``catch_up=False`` deadlines are skipped once the next one has passed, and so is one less than half a
    period after a late tick: two ticks never follow each other at once, as is needed for what moves hardware.
    """

    def __init__(
        self,
        rate_hz: float,
        clock: Clock,
        stop: threading.Event,
        seconds: float | None = None,
        *,
        catch_up: bool = True,
    ) -> None:
        self.rate_hz = check_rate(rate_hz)
        self._period_ns = 1e9 / rate_hz
        ticks = check_seconds(seconds) * rate_hz
        self._max_ticks = max(1, round(ticks)) if ticks < math.inf else math.inf
        self._clock = clock
        self._is_stepping = clock.domain not in (SYSTEM, MONOTONIC)
        self._longest_delay_ns = _LONGEST_STEP_NS if self._is_stepping else _LONGEST_DELAY_NS
        self._shortest_gap_ns = -math.inf
        if not catch_up:
            self._longest_delay_ns = int(self._period_ns)
            self._shortest_gap_ns = self._period_ns / 2
        self._stop = stop
        self._ticks = 0
        self._skipped = 0
        self._late = 0
        self._first: int | None = None
        self._last = 0
        self.lateness_ns = 0
        """How long after its deadline, or the first one that was skipped, the current tick began [ns]."""

    def __iter__(self) -> Iterator[int]:
        start = self._clock.now()
        tick = 0
        while tick < self._max_ticks:
            # No deadline is further away than one period, unless the clock was set back.
            set_back = start + round((tick - 1) * 1e9 / self.rate_hz) - self._clock.now()
            if set_back > _LONGEST_DELAY_NS:
                start -= set_back
            deadline = start + round(tick * 1e9 / self.rate_hz)
            if not self._clock.wait_until(deadline, self._stop):
                return
            now = self._clock.now()
            self._late += now - deadline > self._period_ns
            self.lateness_ns = 0 if self._is_stepping else now - deadline
            if now - deadline > self._longest_delay_ns:
                due = int(min((now - start) * self.rate_hz / 1e9, self._max_ticks - 1))
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
            following = start + round(tick * 1e9 / self.rate_hz)
            if following - now < self._shortest_gap_ns and tick < self._max_ticks:
                tick += 1
                self._skipped += 1

    def step_s(self, since: int, now: int) -> float:
        """For how long a robot moves at ``now`` that moved last at ``since`` [ns]: until ``now``, in s.

        One period at most, so that it never hurries after a late tick; less where a tick that is on time
        follows a late one: two whole steps in that time would be up to twice as fast.
        """
        return min(max(now - since, 1), self._period_ns) * 1e-9

    def report(self) -> RateReport:
        """Statistics so far."""
        achieved = achieved_hz(self._ticks, self._first, self._last)
        return RateReport(self.rate_hz, achieved, self._ticks, self._skipped, self._late)


def achieved_hz(ticks: int, first: int | None, last: int) -> float:
    """The rate of the ticks after the first; 0 of fewer than two."""
    span_ns = 0 if first is None else last - first
    return (ticks - 1) * 1e9 / span_ns if span_ns > 0 else 0.0


def check_seconds(seconds: float | None) -> float:
    """``seconds``, or infinity for None. Raises InvalidInput unless it is positive and finite."""
    if seconds is None:
        return math.inf
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise InvalidInput(f"seconds is a positive number, or None for ever; got {seconds!r}")
    return seconds


def check_rate(rate_hz: float) -> float:
    """``rate_hz``. Raises InvalidInput unless it is above 0 and at most 10 kHz."""
    if not (math.isfinite(rate_hz) and 0.0 < rate_hz <= 10_000.0):
        raise InvalidInput(f"a rate is above 0 and at most 10000 Hz; got {rate_hz!r}")
    return rate_hz
