"""The pace of control loops: absolute deadlines, or a device; and real-time scheduling of their threads."""

from __future__ import annotations

import gc
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Literal, TypeAlias

from zstate.clock import Clock, MonotonicClock
from zstate.errors import InvalidInput
from zstate.rate import Rate, RateReport, achieved_hz, check_rate, check_seconds

_LOG = logging.getLogger("zstate")

Realtime: TypeAlias = Literal["fifo", "spin"]
"""How a control loop waits: with SCHED_FIFO, and also without sleeping right before a deadline."""

_SHORTEST_PERIOD_NS = 100_000
_PERIODS = 16
"""The period of a device is the mean of about so many."""

_LONGEST_DEVICE_STEP_NS = 50_000_000
"""A device that is slower than 20 Hz moves its joints slower than their limits, but never by a leap."""

_TICKS_WITH_WAITS = 1000
"""Ticks of a device after which it is checked that at least half of them have waited for it."""

_FIFO_PRIORITY = 50
_SPIN_NS = 200_000
_FASTEST_SPIN_HZ = 2_000.0
"""Above it, a loop would hardly sleep between two spins."""

_LONGEST_SLEEP_NS = 50_000_000
_SHORTEST_SLEEP_NS = 50_000
"""The time that a loop leaves to other threads at each tick, even if it is late."""

_MOST_LOAD = 0.9
_LOAD_WINDOW_NS = 1_000_000_000
"""A loop that uses more of a processor than that for so long leaves SCHED_FIFO."""

_SWITCH_INTERVAL_S = 5e-4
"""For how long another thread of Python may delay a tick: above the spin and the work of a tick, which it
must not interrupt.
"""

_LOCK_CURRENT, _LOCK_FUTURE, _LOCK_ON_FAULT = 1, 2, 4


class DevicePace:
    """Iterate to get the stamp [ns] of each tick of a loop whose body waits for a device.

    The next tick begins when the body has ended. Ends when ``stop`` is set, or after ``seconds``. If fewer
    than half of 1000 ticks have waited, the loop would occupy a processor: after the first 1000 that raises
    InvalidInput, unless the robot has moved. Later there is a warning, and each tick sleeps for 50 us (Linux
    only).
    """

    lateness_ns = 0
    """Always 0: a tick has no deadline."""

    def __init__(self, clock: Clock, stop: threading.Event, seconds: float | None = None) -> None:
        self._longest_ns = check_seconds(seconds) * 1e9
        self._clock = clock
        self._stop = stop
        self._ticks = 0
        self._first: int | None = None
        self._last = 0
        self._period_ns = float(_SHORTEST_PERIOD_NS)
        """The mean of the last periods, which grows from the shortest; longer pauses count as two periods."""
        self._has_moved = False
        self._is_overloaded = False

    def __iter__(self) -> Iterator[int]:
        waits = _count_waits()
        while not self._stop.is_set():
            now = self._clock.now()
            if self._first is None:
                self._first = now
            elif now - self._first >= self._longest_ns:
                return
            else:
                elapsed = self._bounded(now - self._last)
                self._period_ns += (elapsed - self._period_ns) / _PERIODS
            self._last = now
            self._ticks += 1
            yield now
            if self._is_overloaded:
                time.sleep(_SHORTEST_SLEEP_NS * 1e-9)
            elif self._ticks % _TICKS_WITH_WAITS == 0:
                waits = self._check_waits(waits)

    def step_s(self, since: int, now: int) -> float:
        """For how long a robot moves at ``now`` that moved last at ``since`` [ns]: until ``now``, in s.

        After a pause of the device it moves for two of its periods at most, and for 50 ms: slower, never
        further.
        """
        self._has_moved = True
        return self._bounded(now - since) * 1e-9

    def _bounded(self, elapsed_ns: int) -> float:
        return min(elapsed_ns, 2.0 * self._period_ns, _LONGEST_DEVICE_STEP_NS)

    def report(self) -> RateReport:
        """Statistics so far."""
        return RateReport(0.0, achieved_hz(self._ticks, self._first, self._last), self._ticks, 0, 0)

    def _check_waits(self, before: int | None) -> int | None:
        """The count of waits. Raises InvalidInput, or warns, if there were hardly any after ``before``."""
        waits = _count_waits()
        if before is None or waits is None or waits - before >= _TICKS_WITH_WAITS // 2:
            return waits
        text = (
            f"the loop has waited {waits - before} times in {_TICKS_WITH_WAITS} ticks, at "
            f"{1e9 / self._period_ns:.0f} Hz: the device that sets its pace returns at once, or is faster "
            "than the loop. Let read() block until there is a new reading, or pass rate_hz=..."
        )
        if self._ticks == _TICKS_WITH_WAITS and not self._has_moved:
            raise InvalidInput(text)
        self._is_overloaded = True
        _LOG.warning("%s. The loop sleeps for %d us at each tick now", text, _SHORTEST_SLEEP_NS // 1000)
        return waits


class _PreciseClock(MonotonicClock):
    """The monotonic clock with waits that end on time, the last ``spin_ns`` of them without sleep.

    Each wait sleeps for 50 us at least, also after its deadline: a thread with SCHED_FIFO that never sleeps
    would stop all others of its processor. A sleep of the system takes no locks after it has ended, as the
    wait for an event does. In the last part this thread holds the interpreter lock, which another one may
    need some time to release. ``on_overload()`` is called after each second in which this thread has used
    more than 90 % of a processor.
    """

    def __init__(self, spin_ns: int, on_overload: Callable[[], object]) -> None:
        self._spin_ns = spin_ns
        self._on_overload = on_overload
        self._checked_at, self._used_ns = time.monotonic_ns(), time.thread_time_ns()

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        now = time.monotonic_ns()
        if now - self._checked_at > _LOAD_WINDOW_NS:
            self._check_load(now)
        left_ns = max(stamp - self._spin_ns - now, _SHORTEST_SLEEP_NS)
        while left_ns > 0 and not stop.is_set():
            time.sleep(min(left_ns, _LONGEST_SLEEP_NS) * 1e-9)
            left_ns = stamp - self._spin_ns - time.monotonic_ns()
        while time.monotonic_ns() < stamp and not stop.is_set():
            pass
        return not stop.is_set()

    def _check_load(self, now: int) -> None:
        used_ns = time.thread_time_ns()
        if used_ns - self._used_ns > _MOST_LOAD * (now - self._checked_at):
            self._on_overload()
        self._checked_at, self._used_ns = now, used_ns


@contextmanager
def control_loop_pace(
    rate_hz: float | None, realtime: Realtime | None, stop: threading.Event, seconds: float | None
) -> Generator[Rate | DevicePace, None, None]:
    """The ticks of a control loop in this thread; a device sets its pace if ``rate_hz`` is None.

    Inside the block, other threads of Python give up the interpreter after 0.5 ms. With ``realtime`` the
    thread has SCHED_FIFO at priority 50, the memory of the process is locked, and its garbage collector skips
    the objects that exist already. "spin" also does not sleep in the last 200 us before a deadline: at 1 kHz
    the loop occupies a quarter of a processor for that. A tick that is late sleeps for 50 us first, as other
    threads need some of the processor; a loop that uses more than 90 % of one for a second goes on without
    SCHED_FIFO, and logs an error. Raises InvalidInput, with what to do, if the system does not permit it.
    """
    with ExitStack() as restoring:
        restoring.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        clock = MonotonicClock() if realtime is None else _use_realtime(realtime, restoring)
        if rate_hz is None:
            yield DevicePace(clock, stop, seconds)
        else:
            yield Rate(rate_hz, clock, stop, seconds, catch_up=False)


def check_pace(rate_hz: float | None, realtime: Realtime | None) -> None:
    """Raise InvalidInput for a rate or a kind of scheduling that no control loop has on this system."""
    if rate_hz is not None:
        check_rate(rate_hz)
    if realtime not in (None, "fifo", "spin"):
        raise InvalidInput(f"realtime is None, 'fifo' or 'spin', not {realtime!r}")
    if realtime is not None and sys.platform != "linux":
        raise InvalidInput(f"realtime={realtime!r} needs Linux; this is {sys.platform}")
    if realtime == "spin" and rate_hz is None:
        raise InvalidInput("realtime='spin' waits for deadlines, which a device has not: use 'fifo'")
    if realtime == "spin" and rate_hz is not None and rate_hz > _FASTEST_SPIN_HZ:
        raise InvalidInput(
            f"realtime='spin' stays awake for {_SPIN_NS // 1000} us before each tick, which leaves too "
            f"little of a processor above {_FASTEST_SPIN_HZ:g} Hz; got rate_hz={rate_hz!r}: use 'fifo'"
        )


def _use_realtime(realtime: Realtime, restoring: ExitStack) -> Clock:
    """Schedule this thread as ``realtime``; returns the clock for its deadlines."""
    leave_fifo = _use_fifo(realtime, restoring)
    _lock_memory(realtime, restoring)
    if not gc.get_freeze_count():
        gc.collect()
        gc.freeze()
        restoring.callback(gc.unfreeze)

    def on_overload() -> None:
        if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO:
            leave_fifo()
            _LOG.error(
                "the control loop has used more than %.0f %% of a processor for a second, and would leave no "
                "time for other programs: it goes on without SCHED_FIFO. Its work takes longer than its "
                "period: lower rate_hz",
                100.0 * _MOST_LOAD,
            )

    return _PreciseClock(_SPIN_NS if realtime == "spin" else 0, on_overload)


def _use_fifo(realtime: Realtime, restoring: ExitStack) -> Callable[[], object]:
    """Give this thread SCHED_FIFO; returns what takes it away."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        # Threads and processes that this one starts do not inherit it.
        fifo = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, fifo, os.sched_param(_FIFO_PRIORITY))
    except PermissionError:
        raise InvalidInput(
            f"realtime={realtime!r} needs priority {_FIFO_PRIORITY} of SCHED_FIFO, which this system does "
            f"not permit: allow it by `ulimit -r {_FIFO_PRIORITY}` (rtprio in /etc/security/limits.conf), or "
            "by the capability CAP_SYS_NICE (`docker run --cap-add SYS_NICE`)"
        ) from None
    leave_fifo = partial(os.sched_setscheduler, 0, policy | os.SCHED_RESET_ON_FORK, parameters)
    restoring.callback(leave_fifo)
    return leave_fifo


def _lock_memory(realtime: Realtime, restoring: ExitStack) -> None:
    """Keep the pages of this process in memory once they are used."""
    import ctypes  # noqa: PLC0415  # only control loops need it
    import resource  # noqa: PLC0415  # not on every system

    libc = ctypes.CDLL(None, use_errno=True)
    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft != resource.RLIM_INFINITY:
        # With a limit of 0 this needs the capability. Without it, later allocations would fail at the limit.
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, hard))
    failed = libc.mlockall(_LOCK_CURRENT | _LOCK_FUTURE | _LOCK_ON_FAULT)
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (soft, hard))
    if failed:
        raise InvalidInput(
            f"realtime={realtime!r} locks all memory of this process, which this system does not permit "
            f"({os.strerror(ctypes.get_errno())}): allow it by `ulimit -l unlimited` (memlock in "
            "/etc/security/limits.conf), or by the capability CAP_IPC_LOCK (`docker run --cap-add IPC_LOCK`)"
        )
    restoring.callback(libc.munlockall)


def _count_waits() -> int | None:
    """How often this thread has waited since it started; None where the system does not count that."""
    if sys.platform != "linux":
        return None
    import resource  # noqa: PLC0415  # not on every system

    return resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw
