from __future__ import annotations

from zstate.metrics.pace import Paces


class Hands:
    def __init__(self) -> None:
        self.time_s = 100.0

    def __call__(self) -> float:
        return self.time_s


def test_a_rate_is_that_since_the_reading_before():
    clock = Hands()
    paces = Paces(clock)
    assert paces.rate_hz("a", 40) == 0.0
    clock.time_s += 2.0
    assert paces.rate_hz("a", 240) == (240 - 40) / 2.0
    clock.time_s += 10.0
    assert paces.rate_hz("a", 240) == 0.0


def test_two_who_ask_at_once_are_given_the_same():
    clock = Hands()
    paces = Paces(clock)
    paces.rate_hz("a", 0)
    clock.time_s += 1.0
    assert paces.rate_hz("a", 100) == paces.rate_hz("a", 101) == 100.0


def test_what_begins_anew_has_no_negative_rate():
    clock = Hands()
    paces = Paces(clock)
    paces.rate_hz("a", 1000)
    clock.time_s += 1.0
    assert paces.rate_hz("a", 3) == 0.0
    assert paces.rate_hz("b", 3) == 0.0
