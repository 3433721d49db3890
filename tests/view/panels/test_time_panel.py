"""ReplayClock: the present, and any instant that is remembered."""

from __future__ import annotations

import pytest

from zstate.buffer.snapshot import TimeSpan
from zstate.errors import InvalidInput
from zstate.view.panels.time_panel import TimeCursor

SECOND = 1_000_000_000


class Time:
    """Passes when it is told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def live(time) -> TimeCursor:
    return TimeCursor(now_s=time)


@pytest.fixture
def recorded(time) -> TimeCursor:
    return TimeCursor(live=False, now_s=time)


def span(oldest_s: float, newest_s: float) -> TimeSpan:
    return TimeSpan(round(oldest_s * SECOND), round(newest_s * SECOND))


def test_it_begins_in_the_present(live):
    assert live.stamp(span(0, 10)) is None
    assert live.is_live
    assert live.is_playing


def test_paused_it_stands_still_while_new_samples_come(live, time):
    live.stamp(span(0, 10))
    live.pause()
    time.now_s += 3.0
    assert live.stamp(span(3, 13)) == 10 * SECOND
    assert not live.is_playing


def test_what_is_forgotten_meanwhile_cannot_be_looked_at(live):
    live.stamp(span(0, 10))
    live.pause()
    assert live.stamp(span(15, 25)) == 15 * SECOND


def test_played_on_it_goes_as_fast_as_time_and_never_catches_up(live, time):
    live.stamp(span(0, 10))
    live.seek(4 * SECOND)
    live.play()
    time.now_s += 2.0
    assert live.stamp(span(2, 12)) == 6 * SECOND
    assert not live.is_live


def test_played_faster_it_comes_back_to_the_present(live, time):
    live.stamp(span(0, 10))
    live.seek(9 * SECOND)
    live.speed = 4.0
    live.play()
    time.now_s += 1.0
    assert live.stamp(span(1, 11)) is None
    assert live.is_live


def test_a_change_of_speed_holds_from_then_on(live, time):
    live.stamp(span(0, 100))
    live.seek(10 * SECOND)
    live.play()
    time.now_s += 2.0
    live.speed = 0.5
    time.now_s += 4.0
    assert live.stamp(span(0, 100)) == (10 + 2 + 2) * SECOND


def test_seeking_goes_no_further_than_what_is_known(live):
    live.stamp(span(5, 10))
    live.seek(1 * SECOND)
    assert live.stamp(span(5, 10)) == 5 * SECOND
    live.seek(99 * SECOND)
    assert live.stamp(span(5, 10)) == 10 * SECOND


def test_seeking_while_it_plays_it_plays_on_from_there(recorded, time):
    recorded.stamp(span(0, 100))
    recorded.seek(50 * SECOND)
    time.now_s += 1.0
    assert recorded.stamp(span(0, 100)) == 51 * SECOND


def test_seeking_out_of_the_present_stands_still_there(live, time):
    live.stamp(span(0, 10))
    live.seek(7 * SECOND)
    time.now_s += 1.0
    assert live.stamp(span(0, 10)) == 7 * SECOND


def test_it_returns_to_the_present_when_told_to(live):
    live.stamp(span(0, 10))
    live.pause()
    live.go_live()
    assert live.stamp(span(0, 10)) is None


def test_a_recording_plays_at_once_and_stops_at_its_end(recorded, time):
    assert recorded.stamp(span(20, 30)) == 20 * SECOND
    time.now_s += 4.0
    assert recorded.stamp(span(20, 30)) == 24 * SECOND
    time.now_s += 40.0
    assert recorded.stamp(span(20, 30)) == 30 * SECOND
    assert not recorded.is_playing
    assert not recorded.is_live


def test_a_recording_that_has_ended_is_played_anew(recorded, time):
    recorded.stamp(span(20, 30))
    time.now_s += 40.0
    recorded.stamp(span(20, 30))
    recorded.play()
    time.now_s += 1.0
    assert recorded.stamp(span(20, 30)) == 21 * SECOND


def test_nothing_is_shown_of_a_recording_of_nothing(recorded):
    assert recorded.stamp(None) is None


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_speed_that_leads_nowhere_is_refused(live, speed):
    with pytest.raises(InvalidInput, match="a speed is a positive number"):
        live.speed = speed
    assert live.speed == 1.0
