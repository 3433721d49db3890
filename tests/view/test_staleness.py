"""Staleness: silence is a matter of the rate, and is said with the time since when."""

from __future__ import annotations

from datetime import datetime

import pytest

from zstate.view.staleness import is_silent, silence_text


@pytest.mark.parametrize(
    ("silent_s", "rate_hz", "expected"),
    [
        (0.9, 100.0, False),
        (1.1, 100.0, True),
        (1.1, None, True),
        (9.0, 1.0, False),
        (11.0, 1.0, True),
    ],
)
def test_a_robot_is_silent_after_ten_periods_a_second_at_least(silent_s, rate_hz, expected):
    assert is_silent(silent_s, rate_hz) == expected


@pytest.mark.parametrize(
    ("silent_s", "lasting"),
    [(4.71, "4 s"), (75.0, "1 min 15 s"), (3 * 3600 + 25 * 60 + 7, "3 h 25 min")],
)
def test_it_is_said_how_long_and_since_when(silent_s, lasting):
    now = datetime(2026, 3, 4, 15, 6, 7).astimezone()
    since = datetime.fromtimestamp(now.timestamp() - silent_s).astimezone()
    assert silence_text(silent_s, now.timestamp()) == f"silent for {lasting}, since {since:%H:%M:%S}"
