"""Clocks (system, simulated, manual) and checks of stamps.

``model``, ``buffer`` and ``wire`` never read the system clock; callers pass them a clock.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.format import SECOND_NS
from zstate.checks import is_masked
from zstate.errors import InvalidInput

_STAMP_RANGE = 2**63

# A signal that arrives as a thread starts to wait for a lock is handled only after that wait.
LONGEST_WAIT_S = 0.5

SYSTEM = "system"
"""The domain of real time, shared by all machines whose clocks agree."""

SIMULATED = "sim"
"""The domain of the time of a simulation or a playback."""

MONOTONIC = "monotonic"
"""The domain of the time since an arbitrary instant, which nothing sets; its stamps never leave a process."""

SET_BACK_NS = 100_000_000
"""A clock that is behind its newest stamp by more than this [ns] was set back; by less, samples are late."""

LATE_NS = 1_000_000_000
"""Samples of a smaller age are on time: a shorter wait is no backlog."""

FAR_NS = 60_000_000_000
"""No network delays a sample by this much; a larger difference is a clock that was never set."""


class ClockOffset(NamedTuple):
    """Offset of another clock ahead of this host's, and its uncertainty [ns]."""

    offset_ns: int
    uncertainty_ns: int


class Clock(Protocol):
    """Source of the present time. Stamps are integer nanoseconds since the Unix epoch.

    Only stamps of the same ``domain`` may be compared: "system", or the name of a simulated time.
    """

    @property
    def domain(self) -> str:
        """The clock domain."""
        ...

    def now(self) -> int:
        """The present stamp [ns]."""
        ...

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        """Block until ``stamp``, or until ``stop`` is set. True when the stamp was reached.

        If the clock is set back, the wait may end with True before the stamp: check ``now()``.
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


class MonotonicClock:
    """The monotonic clock of this machine, for the deadlines of control loops."""

    domain = MONOTONIC

    def now(self) -> int:
        return time.monotonic_ns()

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        remaining_s = (stamp - time.monotonic_ns()) * 1e-9
        return not (wait_interruptible(stop, remaining_s) if remaining_s > 0.0 else stop.is_set())


class ManualClock:
    """A clock that is set by its owner, for tests and manual playback."""

    def __init__(self, start: int = 0, domain: str = SYSTEM) -> None:
        self.domain = domain
        self._now = start
        self._moved = threading.Condition()

    def now(self) -> int:
        return self._now

    def set(self, stamp: int) -> None:
        """Jump to ``stamp``, forwards or backwards, and wake all waiting threads."""
        with self._moved:
            self._now = stamp
            self._moved.notify_all()

    def advance(self, seconds: float) -> None:
        """Move forwards by ``seconds``."""
        self.set(self._now + round(seconds * 1e9))

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        with self._moved:
            # ``stop`` cannot notify this condition, so it is checked every 50 ms of real time.
            while self._now < stamp and not stop.is_set():
                self._moved.wait(0.05)
        return not stop.is_set()


class StopEvent(threading.Event):
    """The event that stops a loop, which outlives what the handler of a signal raises in its wait.

    ``threading.Event.wait`` is Python: KeyboardInterrupt may leave its lock held, so that ``set`` waits for
    ever, or not held, a RuntimeError: that is one of a thousand interrupts of a loop at 1 kHz (CPython 3.11).
    Here the wait is one call of C. It is never cleared.
    """

    def __init__(self) -> None:
        super().__init__()
        self._gate = threading.Lock()
        self._gate.acquire()

    def set(self) -> None:
        super().set()
        with suppress(RuntimeError):  # it is open
            self._gate.release()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, at most ``timeout`` [s]; whether it is."""
        within_s = -1.0 if timeout is None else max(timeout, 0.0)
        if not self.is_set() and self._gate.acquire(timeout=within_s):
            self._gate.release()
        return self.is_set()


def wait_interruptible(event: threading.Event, timeout_s: float | None = None) -> bool:
    """``event.wait(timeout_s)`` that Ctrl-C always ends within half a second."""
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    while True:
        left_s = LONGEST_WAIT_S if deadline is None else deadline - time.monotonic()
        if event.wait(min(max(left_s, 0.0), LONGEST_WAIT_S)):
            return True
        if left_s <= LONGEST_WAIT_S and deadline is not None:
            return False


def check_stamp(stamp: Any) -> int:
    """A stamp as an int, from an int or numpy's integers and datetime64[ns].

    Raises InvalidInput for other types; floats would lose nanoseconds.
    """
    if type(stamp) is int and -_STAMP_RANGE <= stamp < _STAMP_RANGE:
        return stamp
    if isinstance(stamp, np.integer):
        return check_stamp(int(cast("np.integer[Any]", stamp)))
    if isinstance(stamp, np.datetime64):
        return int(check_stamps(np.atleast_1d(cast("np.datetime64[Any]", stamp)))[0])
    raise InvalidInput(
        f"a stamp is a 64-bit integer count of nanoseconds since the Unix epoch, not {stamp!r}; "
        "use time.time_ns(), or round(seconds * 1e9) if only seconds are known"
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
        unit, _ = np.datetime_data(array.dtype)
        if array.ndim != 1 or array.dtype != np.dtype("datetime64[ns]"):
            raise InvalidInput(
                f"dates as stamps are a flat array of datetime64[ns]; got shape {array.shape} in units of "
                f"{unit!r}: convert with .astype('datetime64[ns]')"
            )
        if np.isnat(array).any():
            raise InvalidInput("a stamp is NaT, which is no instant")
        return array.astype(np.int64)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu") or is_masked(stamps):
        raise InvalidInput(
            f"stamps are a flat array of integer nanoseconds, or of datetime64[ns]; got shape {array.shape} "
            f"of {'masked ' * is_masked(stamps)}{array.dtype}"
        )
    if array.size and array.dtype.kind == "u" and int(array.max()) >= _STAMP_RANGE:
        raise InvalidInput(f"stamps must fit 64-bit signed integers; got {array.max()}")
    return array.astype(np.int64)


def check_stamps_of_points(stamps: ArrayLike, count: int) -> NDArray[np.int64]:
    """The stamps of ``count`` points: (1,) of one stamp for all of them, else (count,).

    Raises InvalidInput as ``check_stamps``, and for another number of stamps.
    """
    if isinstance(stamps, (int, float, np.generic)):
        return np.array([check_stamp(stamps)])
    instants = check_stamps(stamps)
    if len(instants) != count:
        raise InvalidInput(
            f"{count} points have {len(instants)} stamps; pass a stamp for each, or one as an int for all"
        )
    return instants


def format_stamp(stamp: int) -> str:
    """A stamp as seconds with all nine digits."""
    seconds, nanoseconds = divmod(abs(stamp), SECOND_NS)
    return f"{'-' if stamp < 0 else ''}{seconds}.{nanoseconds:09d}"
