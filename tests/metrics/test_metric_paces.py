from __future__ import annotations

import pytest

from zstate.metrics.collectors import CounterRates


class Hands:
    def __init__(self) -> None:
        self.time_s = 100.0

    def __call__(self) -> float:
        return self.time_s


def noted(paces: CounterRates, clock: Hands, seconds: int, rate_hz: float, count: float = 0.0) -> float:
    """What it has come to after ``seconds``, noted each second."""
    for _ in range(seconds):
        paces.note("a", count)
        clock.time_s += 1.0
        count += rate_hz
    return count


def test_the_first_reading_has_the_rate_of_the_window_before_it():
    clock = Hands()
    paces = CounterRates(clock)
    count = noted(paces, clock, 35, 100.0)
    assert paces.rate_hz("a", count) == 100.0


def test_two_who_read_do_not_disturb_each_other():
    clock = Hands()
    paces = CounterRates(clock)
    count = noted(paces, clock, 20, 50.0)
    for _ in range(100):
        assert paces.rate_hz("a", count) == pytest.approx(50.0)
        clock.time_s += 0.02
        count += 1.0


def test_a_rate_is_that_of_the_last_ten_seconds():
    clock = Hands()
    paces = CounterRates(clock)
    count = noted(paces, clock, 30, 100.0)
    count = noted(paces, clock, 5, 0.0, count)
    assert paces.rate_hz("a", count) == 50.0
    count = noted(paces, clock, 5, 0.0, count)
    assert paces.rate_hz("a", count) == 0.0


def test_what_is_only_read_has_the_rate_since_the_reading_before():
    clock = Hands()
    paces = CounterRates(clock)
    assert paces.rate_hz("a", 40) == 0.0
    clock.time_s += 20.0
    assert paces.rate_hz("a", 240) == (240 - 40) / 20.0
    clock.time_s += 20.0
    assert paces.rate_hz("a", 240) == 0.0


def test_what_begins_anew_has_no_negative_rate():
    clock = Hands()
    paces = CounterRates(clock)
    paces.rate_hz("a", 1000)
    clock.time_s += 1.0
    assert paces.rate_hz("a", 3) == 0.0
    assert paces.rate_hz("b", 3) == 0.0
