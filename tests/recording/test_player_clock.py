"""Deadlines of a replay, by a clock that goes where it is waited for."""

from __future__ import annotations

import math
import threading

import pytest
from helpers.processes import SteppingClock

from zstate.errors import InvalidInput
from zstate.recording.player_clock import Lateness, PlayerClock

MS = 1_000_000
S = 1_000_000_000


def test_deadlines_are_absolute_and_divided_by_the_rate():
    clock = SteppingClock(1000, {0: 3 * MS, 1: 70 * MS})
    pace, stop = PlayerClock(clock, 2.0), threading.Event()
    pace.start(50 * S)
    for n in range(1, 5):
        assert pace.wait(50 * S + n * 100 * MS, stop)
    assert clock.waits == [1000 + n * 50 * MS for n in range(1, 5)]
    # 400 ms of the recording in 200 ms: the second wait ended 70 ms late, the third was over at once.
    assert pace.achieved == 2.0


def test_lateness_is_counted_from_the_deadline():
    clock = SteppingClock(0, {0: 3 * MS})
    pace = PlayerClock(clock, 1.0)
    pace.start(0)
    pace.wait(S, threading.Event())
    assert pace.lateness(S) == 3 * MS


def test_playback_continues_after_a_long_delay_without_a_burst():
    clock = SteppingClock(0, {0: 5 * S})
    pace, stop = PlayerClock(clock, 1.0), threading.Event()
    pace.start(0)
    for second in (1, 2, 3):
        pace.wait(second * S, stop)
    assert clock.waits == [1 * S, 6 * S, 7 * S]
    assert pace.delays == 1


def test_clock_that_is_set_back_is_followed():
    clock = SteppingClock(100 * S)
    pace, stop = PlayerClock(clock, 1.0), threading.Event()
    pace.start(0)
    pace.wait(S, stop)
    clock.stamp -= 50 * S
    pace.wait(2 * S, stop)
    assert clock.waits == [101 * S, 52 * S]


@pytest.mark.parametrize(
    ("set_back", "next_wait"), [(100 * MS, 102 * S), (100 * MS + 1, 102 * S - 100 * MS - 1)]
)
def test_clock_that_is_behind_by_more_than_a_tenth_of_a_second_was_set_back(set_back: int, next_wait: int):
    clock = SteppingClock(100 * S)
    pace, stop = PlayerClock(clock, 1.0), threading.Event()
    pace.start(0)
    pace.wait(S, stop)
    clock.stamp -= set_back
    pace.wait(2 * S, stop)
    assert clock.waits == [101 * S, next_wait]


@pytest.mark.parametrize(("delay", "delays"), [(S, 0), (S + 1, 1)])
def test_playback_that_is_more_than_a_second_late_continues_from_there(delay: int, delays: int):
    clock = SteppingClock(0)
    pace, stop = PlayerClock(clock, 1.0), threading.Event()
    pace.start(0)
    clock.stamp = S + delay
    pace.wait(S, stop)
    assert pace.delays == delays
    assert pace.lateness(S) == (0 if delays else S)


def test_infinite_rate_never_waits():
    clock = SteppingClock()
    pace = PlayerClock(clock, math.inf)
    pace.start(0)
    assert pace.wait(3600 * S, threading.Event())
    assert clock.waits == []
    assert pace.lateness(3600 * S) == 0


def test_wait_returns_false_when_stopped():
    stop = threading.Event()
    stop.set()
    for rate in (1.0, math.inf):
        pace = PlayerClock(SteppingClock(), rate)
        pace.start(0)
        assert not pace.wait(S, stop)


def test_pauses_do_not_count_into_the_achieved_rate():
    clock = SteppingClock(0)
    pace, stop = PlayerClock(clock, 1.0), threading.Event()
    pace.start(0)
    pace.wait(S, stop)
    pace.pause()
    clock.stamp += 100 * S
    pace.start(S)
    pace.wait(2 * S, stop)
    assert pace.achieved == 1.0


@pytest.mark.parametrize("rate", [0.0, -1.0, math.nan])
def test_rate_must_be_above_zero(rate: float):
    with pytest.raises(InvalidInput, match="rate above 0"):
        PlayerClock(SteppingClock(), rate)


def test_quantiles_are_recorded_values():
    lateness = Lateness()
    assert lateness.quantile(0.5) == 0
    for nanoseconds in range(1, 101):
        lateness.add(nanoseconds)
    assert (lateness.quantile(0.5), lateness.quantile(0.99), lateness.largest) == (51, 100, 100)
    for _ in range(70_000):
        lateness.add(7)
    assert (lateness.quantile(0.99), lateness.largest, lateness.count) == (7, 100, 70_100)
