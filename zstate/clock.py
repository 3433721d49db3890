"""Where "now" comes from: the system, a simulation, or the hand of a test.

Nothing in ``model``, ``buffer`` or ``wire`` reads a clock by itself; it is handed one of these.
"""

from __future__ import annotations

import threading
import time
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import is_masked
from zstate.errors import InvalidInput

_STAMP_RANGE = 2**63

# A signal that arrives just as a lock is being waited for is not seen before that wait ends.
LONGEST_WAIT_S = 0.5

SYSTEM = "system"
"""The domain of real time, which all machines share as far as their clocks agree."""

SIMULATED = "sim"
"""The domain of the time that a simulation or a replay tells."""

SET_BACK_NS = 100_000_000
"""The clock of a writer was set back if the next samples are stamped by more before those it sent earlier."""


class ClockOffset(NamedTuple):
    """How far another clock is ahead of this host's, and the uncertainty of that [ns]."""

    offset_ns: int
    uncertainty_ns: int


class Clock(Protocol):
    """Two questions about time. Stamps are integer nanoseconds since the Unix epoch.

    Stamps of one ``domain`` may be compared, those of two say nothing of each other: it is "system", or
    the name of a simulated time.
    """

    @property
    def domain(self) -> str:
        """Whose time it tells."""
        ...

    def now(self) -> int:
        """The present stamp [ns]."""
        ...

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        """Block until ``stamp``, or until ``stop`` is set. True when the stamp was reached.

        A clock that is set back may end the wait, with True, before that: ask it for the time.
        """
        ...


class SystemClock:
    """The wall clock of this machine."""

    domain = SYSTEM

    def now(self) -> int:
        return time.time_ns()

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        remaining_s = (stamp - time.time_ns()) * 1e-9
        return not (wait_interruptible(stop, remaining_s) if remaining_s > 0.0 else stop.is_set())


class ManualClock:
    """A clock that moves only when told to, for tests and for replay by hand."""

    def __init__(self, start: int = 0, domain: str = SYSTEM) -> None:
        self.domain = domain
        self._now = start
        self._moved = threading.Condition()

    def now(self) -> int:
        return self._now

    def set(self, stamp: int) -> None:
        """Jump to ``stamp``, forwards or backwards, and wake whoever waits for it."""
        with self._moved:
            self._now = stamp
            self._moved.notify_all()

    def advance(self, seconds: float) -> None:
        """Move forwards by ``seconds``."""
        self.set(self._now + round(seconds * 1e9))

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        with self._moved:
            # ``stop`` cannot notify this condition, so it is looked at every 50 ms of real time.
            while self._now < stamp and not stop.is_set():
                self._moved.wait(0.05)
        return not stop.is_set()


def wait_interruptible(event: threading.Event, timeout_s: float | None = None) -> bool:
    """``event.wait(timeout_s)`` that Ctrl-C ends within half a second, whenever it comes."""
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    while True:
        left_s = LONGEST_WAIT_S if deadline is None else deadline - time.monotonic()
        if event.wait(min(max(left_s, 0.0), LONGEST_WAIT_S)):
            return True
        if left_s <= LONGEST_WAIT_S and deadline is not None:
            return False


def check_stamp(stamp: Any) -> int:
    """A stamp as an int; integers and datetime64[ns] of numpy are welcome.

    Floats are not: they lose nanoseconds.
    """
    if type(stamp) is int and -_STAMP_RANGE <= stamp < _STAMP_RANGE:
        return stamp
    if isinstance(stamp, np.integer):
        return check_stamp(int(cast("np.integer[Any]", stamp)))
    if isinstance(stamp, np.datetime64):
        return int(check_stamps(np.atleast_1d(cast("np.datetime64[Any]", stamp)))[0])
    raise InvalidInput(
        f"a stamp is a 64-bit integer count of nanoseconds since the Unix epoch, not {stamp!r}; "
        "use time.time_ns(), or round(seconds * 1e9) when seconds is all there is"
    )


def check_stamps(stamps: ArrayLike) -> NDArray[np.int64]:
    """Stamps as an int64 array (T,): of integers [ns], or of datetime64[ns], both exact.

    Raises InvalidInput for floats, other units of datetime64, NaT, masked arrays and other shapes.
    """
    try:
        array: NDArray[Any] = np.asarray(stamps)
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"stamps are a flat array of integer nanoseconds: {error}") from None
    if array.dtype.kind == "M":
        return _stamps_from_dates(array)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu") or is_masked(stamps):
        raise InvalidInput(
            f"stamps are a flat array of integer nanoseconds, or of datetime64[ns]; got shape {array.shape} "
            f"of {'masked ' * is_masked(stamps)}{array.dtype}"
        )
    if array.size and array.dtype.kind == "u" and int(array.max()) >= _STAMP_RANGE:
        raise InvalidInput(f"stamps must fit 64-bit signed integers; got {array.max()}")
    return array.astype(np.int64)


def _stamps_from_dates(dates: NDArray[np.datetime64]) -> NDArray[np.int64]:
    unit, _ = np.datetime_data(dates.dtype)
    if dates.ndim != 1 or dates.dtype != np.dtype("datetime64[ns]"):
        raise InvalidInput(
            f"dates as stamps are a flat array of datetime64[ns]; got shape {dates.shape} in units of "
            f"{unit!r}: convert with .astype('datetime64[ns]')"
        )
    if np.isnat(dates).any():
        raise InvalidInput("a stamp is NaT, which is no instant")
    return dates.astype(np.int64)


def format_stamp(stamp: int) -> str:
    """A stamp as seconds with all nine digits."""
    seconds, nanoseconds = divmod(abs(stamp), 1_000_000_000)
    return f"{'-' if stamp < 0 else ''}{seconds}.{nanoseconds:09d}"
