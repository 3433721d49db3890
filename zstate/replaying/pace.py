"""Pace: when what was recorded is due again, and how late it came."""

from __future__ import annotations

import math
import threading

import numpy as np

from zstate.clock import Clock
from zstate.errors import InvalidInput

# A replay that was held up (a suspended laptop, a debugger) or cannot keep its rate goes on from where it
# is, without a burst of what it missed; shorter delays are made up for.
_LONGEST_DELAY_NS = 1_000_000_000
# A system clock that was set back would make the replay wait for it.
_SET_BACK_NS = 100_000_000

_REMEMBERED = 1 << 16


class Pace:
    """Turns log times into deadlines of ``clock``: ``rate`` recorded seconds a second.

    Deadlines are absolute, so that no lateness is handed on. ``rate=inf`` waits for nothing.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self.rate = check_speed(rate)
        self.delays = 0
        """How often it fell behind by more than a second, and went on from there."""
        self._clock = clock
        self._log_time = self._last = 0
        self._start = self._began = 0
        self._is_running = False
        self._played_ns = self._spent_ns = 0

    def begin(self, log_time: int) -> None:
        """It is ``log_time`` [ns] now."""
        self.rest()
        self._log_time = self._last = log_time
        self._start = self._began = self._clock.now()
        self._is_running = True

    def rest(self) -> None:
        """The time from now on until ``begin`` does not count."""
        self._played_ns, self._spent_ns = self._account()
        self._is_running = False

    @property
    def achieved(self) -> float:
        """How many recorded seconds a second there were so far."""
        played_ns, spent_ns = self._account()
        return played_ns / spent_ns if spent_ns else 0.0

    def _account(self) -> tuple[int, int]:
        if not self._is_running:
            return self._played_ns, self._spent_ns
        spent_ns = self._clock.now() - self._began
        return self._played_ns + self._last - self._log_time, self._spent_ns + spent_ns

    def wait(self, log_time: int, stop: threading.Event) -> bool:
        """Wait until ``log_time`` [ns]; log times never decrease. False when ``stop`` was set before."""
        if math.isinf(self.rate):
            self._last = log_time
            return not stop.is_set()
        now = self._clock.now()
        set_back, delay = self._deadline(self._last) - now, now - self._deadline(log_time)
        if set_back > _SET_BACK_NS:
            self._start -= set_back
        elif delay > _LONGEST_DELAY_NS:
            self._start += delay
            self.delays += 1
        if not self._clock.wait_until(self._deadline(log_time), stop):
            return False
        self._last = log_time
        return True

    def lateness(self, log_time: int) -> int:
        """How long ago ``log_time`` was due [ns]; 0 where nothing is waited for."""
        return 0 if math.isinf(self.rate) else max(0, self._clock.now() - self._deadline(log_time))

    def _deadline(self, log_time: int) -> int:
        return self._start + round((log_time - self._log_time) / self.rate)


class Lateness:
    """How late things were: quantiles of the last 65536, and the largest of all."""

    def __init__(self) -> None:
        self._recent = np.zeros(_REMEMBERED, dtype=np.int64)
        self.count = 0
        self.largest = 0

    def add(self, nanoseconds: int) -> None:
        """One more."""
        self._recent[self.count % _REMEMBERED] = nanoseconds
        self.count += 1
        self.largest = max(self.largest, nanoseconds)

    def quantile(self, fraction: float) -> int:
        """The lateness [ns] that this fraction did not exceed; 0 for none at all."""
        known = self._recent[: min(self.count, _REMEMBERED)]
        return int(np.quantile(known, fraction, method="higher")) if self.count else 0


def check_speed(rate: float) -> float:
    """A rate to replay at: above 0, or infinite. Raises InvalidInput."""
    if math.isnan(rate) or rate <= 0.0:
        raise InvalidInput(f"a replay runs at a rate above 0, as fast as it can at inf; got {rate!r}")
    return rate
