import threading
from itertools import pairwise

import pytest
from helpers.processes import SteppingClock

from zstate.clock import SystemClock
from zstate.errors import InvalidInput
from zstate.rate import Rate, check_rate

SECOND = 1_000_000_000


@pytest.mark.parametrize("rate_hz", [0, 0.0, -1.0, float("nan"), float("inf"), 10_000.1])
def test_a_rate_that_cannot_be_kept_is_refused_with_its_value(rate_hz: float):
    with pytest.raises(InvalidInput, match=f"at most 10000 Hz; got {rate_hz!r}"):
        check_rate(rate_hz)


@pytest.mark.parametrize("rate_hz", [1e-3, 1, 10_000.0])
def test_a_rate_between_zero_and_ten_kilohertz_is_accepted(rate_hz: float):
    assert check_rate(rate_hz) == rate_hz


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf")])
def test_a_duration_is_a_positive_number(seconds: float):
    with pytest.raises(InvalidInput, match="seconds is a positive number"):
        Rate(10.0, SystemClock(), threading.Event(), seconds)


@pytest.mark.parametrize(("rate_hz", "seconds"), [(3.0, 7.0), (1000.0, 2.5), (0.3, 100.0), (10_000.0, 0.01)])
def test_the_kth_tick_is_k_periods_after_the_first_to_the_nanosecond(rate_hz: float, seconds: float):
    clock = SteppingClock()
    rate = Rate(rate_hz, clock, threading.Event(), seconds)
    stamps = list(rate)
    assert stamps == [5 + round(tick * SECOND / rate_hz) for tick in range(round(seconds * rate_hz))]
    assert rate.report().rate_hz == pytest.approx(rate_hz, rel=1e-9)
    assert (rate.report().ticks, rate.report().skipped) == (len(stamps), 0)


def test_a_late_tick_does_not_delay_the_next():
    late = 30_000_000
    clock = SteppingClock(0, lateness={2: late})
    stamps = list(Rate(100.0, clock, threading.Event(), 0.08))
    period = SECOND // 100
    # The third tick is 30 ms late; the next three follow it at once; then all is as planned.
    assert stamps == [0, period, *[2 * period + late] * 4, 6 * period, 7 * period]


def test_after_a_long_delay_the_ticks_that_passed_are_skipped_and_counted():
    clock = SteppingClock(0, lateness={1: SECOND})
    rate = Rate(10.0, clock, threading.Event(), 3.0)
    stamps = list(rate)
    # The tick of 0.1 s came at 1.1 s: those of 0.1 to 1.0 s are given up, that of 1.1 s is due now.
    assert stamps == [0, *(tick * SECOND // 10 for tick in range(11, 30))]
    assert (rate.report().ticks, rate.report().skipped) == (20, 10)


@pytest.mark.parametrize(("domain", "longest"), [("system", SECOND // 10), ("sim", SECOND)])
def test_ticks_of_the_past_are_skipped_after_a_delay_of_more_than_0_1_s_and_of_simulated_time_1_s(
    domain: str, longest: int
):
    for delay, skipped in ((longest, 0), (longest + 1, longest * 100 // SECOND)):
        clock = SteppingClock(0, lateness={2: delay})
        clock.domain = domain
        rate = Rate(100.0, clock, threading.Event(), 2.0)
        assert len(list(rate)) == 200 - skipped
        assert rate.report().skipped == skipped


def test_ticks_and_skipped_ticks_add_up():
    rate = Rate(10.0, SteppingClock(0, lateness={1: 100 * SECOND}), threading.Event(), 3.0)
    list(rate)
    assert rate.report().ticks + rate.report().skipped == 30


def test_a_clock_that_is_set_back_is_followed_at_the_same_rate():
    clock = SteppingClock(1000 * SECOND)
    stamps = []
    for stamp in Rate(10.0, clock, threading.Event(), 1.0):
        stamps.append(stamp)
        if len(stamps) == 3:
            clock.stamp = 400 * SECOND
    period = SECOND // 10
    assert stamps[3:] == [400 * SECOND + tick * period for tick in range(1, 8)]


def test_stop_ends_the_rate_and_the_report_has_its_ticks():
    stop = threading.Event()
    rate = Rate(10.0, SteppingClock(), stop)
    for number, _ in enumerate(rate, 1):
        if number == 4:
            stop.set()
    assert rate.report().ticks == 4


def test_a_report_before_the_second_tick_has_rate_zero():
    rate = Rate(10.0, SteppingClock(), threading.Event(), 0.1)
    assert rate.report().rate_hz == 0.0
    list(rate)
    assert (rate.report().rate_hz, rate.report().ticks) == (0.0, 1)


def test_stop_ends_a_wait_at_the_systems_clock_at_once():
    stop = threading.Event()
    ticks = iter(Rate(0.001, SystemClock(), stop))
    next(ticks)
    threading.Timer(0.05, stop.set).start()
    assert next(ticks, None) is None


def test_without_catching_up_no_two_ticks_follow_at_once():
    # The tick of 20 ms comes at 55 ms: those of 20 to 40 ms are given up, that of 50 ms is due now.
    clock = SteppingClock(0, lateness={2: 35_000_000})
    rate = Rate(100.0, clock, threading.Event(), 0.08, catch_up=False)
    latenesses = []
    stamps = []
    for stamp in rate:
        stamps.append(stamp // 1_000_000)
        latenesses.append(rate.lateness_ns // 1_000_000)
    assert stamps == [0, 10, 55, 60, 70]
    assert latenesses == [0, 0, 35, 0, 0]
    assert (rate.report().ticks, rate.report().skipped) == (5, 3)


def test_without_catching_up_ticks_are_half_a_period_apart_at_least():
    # The tick of 20 ms comes at 29.9 ms, 0.1 ms before the next deadline, which is given up.
    clock = SteppingClock(0, lateness={2: 9_900_000})
    rate = Rate(100.0, clock, threading.Event(), 0.06, catch_up=False)
    assert [stamp / 1_000_000 for stamp in rate] == [0, 10, 29.9, 40, 50]
    assert (rate.report().ticks, rate.report().skipped) == (5, 1)


def test_a_step_lasts_no_longer_than_a_period_and_than_the_time_since_the_last_one():
    # The tick of 20 ms comes at 24.9 ms: that of 30 ms follows after half a period.
    clock = SteppingClock(0, lateness={2: 4_900_000})
    rate = Rate(100.0, clock, threading.Event(), 0.05, catch_up=False)
    stamps = list(rate)
    assert [stamp / 1_000_000 for stamp in stamps] == [0, 10, 24.9, 30, 40]
    steps = [rate.step_s(before, after) for before, after in pairwise(stamps)]
    assert steps == pytest.approx([0.010, 0.010, 0.0051, 0.010])


# The pace of a device
