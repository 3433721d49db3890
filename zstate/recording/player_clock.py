"""Player clock: the wall-clock deadlines of log times, and lateness statistics (rosbag2's PlayerClock)."""

from __future__ import annotations

import math
import threading

import numpy as np

from zstate.clock import SET_BACK_NS, Clock
from zstate.errors import InvalidInput

# A playback that was held up (a suspended laptop, a debugger) or cannot keep its rate continues from where it
# is, without a burst of what it missed; shorter delays are caught up.
_LONGEST_DELAY_NS = 1_000_000_000

_REMEMBERED = 1 << 16


class PlayerClock:
    """Converts log times into deadlines of ``clock`` at ``rate`` recorded seconds per second.

    Deadlines are absolute, so lateness does not accumulate. With ``rate=inf`` nothing waits.
    """

    def __init__(self, clock: Clock, rate: float) -> None:
        self.rate = check_speed(rate)
        self.delays = 0
        """How often playback was more than a second late, and continued from there."""
        self._clock = clock
        self._log_time = self._last = 0
        self._start = self._started = 0
        self._is_running = False
        self._played_ns = self._spent_ns = 0

    def start(self, log_time: int) -> None:
        """Set the current log time to ``log_time`` [ns], and run."""
        self.pause()
        self._log_time = self._last = log_time
        self._start = self._started = self._clock.now()
        self._is_running = True

    def pause(self) -> None:
        """Stop the clock until ``start``."""
        self._played_ns, self._spent_ns = self._totals()
        self._is_running = False

    @property
    def achieved(self) -> float:
        """Recorded seconds per second so far."""
        played_ns, spent_ns = self._totals()
        return played_ns / spent_ns if spent_ns else 0.0

    def _totals(self) -> tuple[int, int]:
        if not self._is_running:
            return self._played_ns, self._spent_ns
        spent_ns = self._clock.now() - self._started
        return self._played_ns + self._last - self._log_time, self._spent_ns + spent_ns

    def wait(self, log_time: int, stop: threading.Event) -> bool:
        """Wait until ``log_time`` [ns]; log times never decrease. False if ``stop`` was set before."""
        if math.isinf(self.rate):
            self._last = log_time
            return not stop.is_set()
        now = self._clock.now()
        set_back, delay = self._deadline(self._last) - now, now - self._deadline(log_time)
        if set_back > SET_BACK_NS:  # else playback would wait for the clock
            self._start -= set_back
        elif delay > _LONGEST_DELAY_NS:
            self._start += delay
            self.delays += 1
        if not self._clock.wait_until(self._deadline(log_time), stop):
            return False
        self._last = log_time
        return True

    def lateness(self, log_time: int) -> int:
        """Time since the deadline of ``log_time`` [ns]; 0 at an infinite rate."""
        return 0 if math.isinf(self.rate) else max(0, self._clock.now() - self._deadline(log_time))

    def _deadline(self, log_time: int) -> int:
        return self._start + round((log_time - self._log_time) / self.rate)


class Lateness:
    """Lateness statistics: quantiles of the last 65536 values, and the largest of all."""

    def __init__(self) -> None:
        self._recent = np.zeros(_REMEMBERED, dtype=np.int64)
        self.count = 0
        self.largest = 0

    def add(self, nanoseconds: int) -> None:
        """Add one value."""
        self._recent[self.count % _REMEMBERED] = nanoseconds
        self.count += 1
        self.largest = max(self.largest, nanoseconds)

    def quantile(self, fraction: float) -> int:
        """The lateness [ns] that this fraction did not exceed; 0 without values."""
        known = self._recent[: min(self.count, _REMEMBERED)]
        return int(np.quantile(known, fraction, method="higher")) if self.count else 0


def check_speed(rate: float) -> float:
    """``rate`` if it is above 0 or infinite. Raises InvalidInput otherwise."""
    if math.isnan(rate) or rate <= 0.0:
        raise InvalidInput(f"a replay runs at a rate above 0, as fast as it can at inf; got {rate!r}")
    return rate
