"""TimeCursor: live, paused, playing, and its span."""

from __future__ import annotations

import pytest

from zstate.buffer.tracks import TimeSpan
from zstate.errors import InvalidInput
from zstate.view.panels.control_panels import TimeCursor

SECOND = 1_000_000_000


class Time:
    """A clock that advances when the test sets it."""

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


def test_live_cursor_starts_live(live):
    assert live.stamp(span(0, 10)) is None
    assert live.is_live
    assert live.is_playing


def test_paused_cursor_keeps_its_stamp_while_samples_arrive(live, time):
    live.stamp(span(0, 10))
    live.pause()
    time.now_s += 3.0
    assert live.stamp(span(3, 13)) == 10 * SECOND
    assert not live.is_playing


def test_paused_cursor_moves_to_the_oldest_stamp_of_the_buffer(live):
    live.stamp(span(0, 10))
    live.pause()
    assert live.stamp(span(15, 25)) == 15 * SECOND


def test_playing_at_speed_1_never_reaches_live(live, time):
    live.stamp(span(0, 10))
    live.seek(4 * SECOND)
    live.play()
    time.now_s += 2.0
    assert live.stamp(span(2, 12)) == 6 * SECOND
    assert not live.is_live


def test_playing_faster_returns_to_live(live, time):
    live.stamp(span(0, 10))
    live.seek(9 * SECOND)
    live.speed = 4.0
    live.play()
    time.now_s += 1.0
    assert live.stamp(span(1, 11)) is None
    assert live.is_live


def test_changed_speed_applies_from_then_on(live, time):
    live.stamp(span(0, 100))
    live.seek(10 * SECOND)
    live.play()
    time.now_s += 2.0
    live.speed = 0.5
    time.now_s += 4.0
    assert live.stamp(span(0, 100)) == (10 + 2 + 2) * SECOND


def test_seek_is_limited_to_the_span(live):
    live.stamp(span(5, 10))
    live.seek(1 * SECOND)
    assert live.stamp(span(5, 10)) == 5 * SECOND
    live.seek(99 * SECOND)
    assert live.stamp(span(5, 10)) == 10 * SECOND


def test_seek_while_playing_continues_to_play(recorded, time):
    recorded.stamp(span(0, 100))
    recorded.seek(50 * SECOND)
    time.now_s += 1.0
    assert recorded.stamp(span(0, 100)) == 51 * SECOND


def test_seek_from_live_pauses(live, time):
    live.stamp(span(0, 10))
    live.seek(7 * SECOND)
    time.now_s += 1.0
    assert live.stamp(span(0, 10)) == 7 * SECOND


def test_go_live_returns_to_the_newest_samples(live):
    live.stamp(span(0, 10))
    live.pause()
    live.go_live()
    assert live.stamp(span(0, 10)) is None


def test_recording_plays_at_once_and_stops_at_its_end(recorded, time):
    assert recorded.stamp(span(20, 30)) == 20 * SECOND
    time.now_s += 4.0
    assert recorded.stamp(span(20, 30)) == 24 * SECOND
    time.now_s += 40.0
    assert recorded.stamp(span(20, 30)) == 30 * SECOND
    assert not recorded.is_playing
    assert not recorded.is_live


def test_play_restarts_a_finished_recording(recorded, time):
    recorded.stamp(span(20, 30))
    time.now_s += 40.0
    recorded.stamp(span(20, 30))
    recorded.play()
    time.now_s += 1.0
    assert recorded.stamp(span(20, 30)) == 21 * SECOND


def test_empty_recording_has_no_stamp(recorded):
    assert recorded.stamp(None) is None


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_speed_must_be_positive_and_finite(live, speed):
    with pytest.raises(InvalidInput, match="a speed is a positive number"):
        live.speed = speed
    assert live.speed == 1.0
