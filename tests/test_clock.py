"""Clocks and stamps."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from helpers.processes import DEADLINE_S

from zstate.clock import ManualClock, StopEvent, SystemClock, check_stamp, format_stamp, wait_interruptible
from zstate.errors import InvalidInput


@pytest.mark.parametrize("stamp", [0, -1, 1_790_000_000_123_456_789, -(2**63), 2**63 - 1])
def test_every_64_bit_integer_is_an_ordinary_stamp(stamp: int) -> None:
    assert check_stamp(stamp) == stamp
    assert check_stamp(np.int64(stamp)) == stamp


def test_numpy_integer_is_returned_as_an_int() -> None:
    assert type(check_stamp(np.uint32(7))) is int


@pytest.mark.parametrize(
    "stamp", [1.0, np.float64(1.0), True, "1", None, 2**63, -(2**63) - 1, np.uint64(2**63)]
)
def test_stamp_other_than_a_64_bit_integer_is_refused_with_advice(stamp: object) -> None:
    with pytest.raises(InvalidInput, match=r"time\.time_ns\(\)"):
        check_stamp(stamp)


@pytest.mark.parametrize(
    ("stamp", "text"),
    [(0, "0.000000000"), (1, "0.000000001"), (1_500_000_000, "1.500000000"), (-1, "-0.000000001")],
)
def test_a_stamp_reads_as_seconds_with_all_nine_digits(stamp: int, text: str) -> None:
    assert format_stamp(stamp) == text


def test_the_system_clock_has_the_time_of_the_system() -> None:
    before = time.time_ns()
    assert before <= SystemClock().now() <= time.time_ns()


def test_the_system_clock_reaches_an_instant_and_not_before() -> None:
    instant = SystemClock().now() + 5_000_000
    assert SystemClock().wait_until(instant, threading.Event())
    assert SystemClock().now() >= instant


def test_a_wait_for_an_instant_ends_when_it_is_stopped() -> None:
    stop = threading.Event()
    stop.set()
    far = 2**62
    assert not SystemClock().wait_until(far, stop)
    assert not ManualClock().wait_until(far, stop)
    assert not SystemClock().wait_until(0, stop)


def test_a_manual_clock_moves_only_when_it_is_set() -> None:
    clock = ManualClock(5)
    assert clock.now() == 5
    clock.advance(1e-9)
    assert clock.now() == 6
    clock.set(-3)
    assert clock.now() == -3


def test_a_wait_for_a_manual_clock_ends_when_the_clock_reaches_the_stamp() -> None:
    clock, reached = ManualClock(), threading.Event()

    def wait() -> None:
        assert clock.wait_until(1_000_000_000, threading.Event())
        reached.set()

    waiter = threading.Thread(target=wait)
    waiter.start()
    clock.advance(0.5)
    assert not reached.is_set()
    clock.advance(0.5)
    assert reached.wait(10.0)
    waiter.join()


def test_waiting_in_slices_ends_when_the_event_is_set_or_the_time_is_up() -> None:
    event = threading.Event()
    assert not wait_interruptible(event, 0.0)
    assert not wait_interruptible(event, 0.01)
    threading.Timer(0.01, event.set).start()
    assert wait_interruptible(event)
    assert wait_interruptible(event, -1.0)


def interrupt(work: Callable[[], object], *, at: int) -> bool:
    """Raise KeyboardInterrupt at step ``at`` of ``work``, as a signal's handler may; whether it has one."""
    steps = 0

    def trace(*_: object) -> Callable[..., object]:
        nonlocal steps
        steps += 1
        if steps == at:
            raise KeyboardInterrupt
        return trace

    sys.settrace(trace)
    try:
        work()
    except KeyboardInterrupt:
        return True
    finally:
        sys.settrace(None)
    return False


def test_a_stop_event_outlives_an_interrupt_at_any_step_of_its_wait() -> None:
    at, was_interrupted = 0, True
    while was_interrupted:
        stop, at = StopEvent(), at + 1
        was_interrupted = interrupt(lambda: wait_interruptible(stop, 0.001), at=at)  # noqa: B023 - at once
        setter = threading.Thread(target=stop.set, daemon=True)
        setter.start()
        setter.join(DEADLINE_S)
        assert not setter.is_alive()
        assert stop.wait(0.0)
    assert at > 5


def test_a_set_stop_event_ends_the_waits_of_all_threads() -> None:
    stop = StopEvent()
    waits = [
        threading.Thread(target=stop.wait, args=(within_s,), daemon=True) for within_s in (None, None, 60.0)
    ]
    for wait in waits:
        wait.start()
    assert not stop.wait(0.001)
    stop.set()
    stop.set()
    for wait in waits:
        wait.join(DEADLINE_S)
        assert not wait.is_alive()
    assert stop.wait()
