"""LagDetector: distinguishes a backlog from clock offsets and from the burst after a cut."""

from __future__ import annotations

import logging

import pytest

from zstate.ingest.counters import Counters
from zstate.ingest.stamp_checks import LagDetector

MS = 1_000_000
S = 1_000 * MS


def warning_count(caplog: pytest.LogCaptureFixture, ages_s: list[float], every_s: float = 0.1) -> int:
    """The number of lag warnings for samples with these ages at arrival."""
    lag = LagDetector(Counters())
    with caplog.at_level(logging.WARNING, "zstate"):
        for number, age_s in enumerate(ages_s):
            lag.add("r1", "driver", round(age_s * S), round(number * every_s * S))
    return len(caplog.records)


def test_growing_lag_is_logged_once(caplog):
    assert warning_count(caplog, [1.0 + 0.1 * number for number in range(50)]) == 1
    assert "samples of 'r1', which driver writes, come 2.1 s after their stamps" in caplog.text
    assert "1.0 s shortly before" in caplog.text


@pytest.mark.parametrize(
    "ages_s",
    [
        [30.0, 30.1, 29.9] * 20,
        [5.0 - 0.1 * number for number in range(40)],
        [1.0, 1.9] * 20,
    ],
    ids=["a clock that is off", "a burst after a cut", "an unsteady network"],
)
def test_lag_that_grows_by_less_than_a_second_is_not_logged(caplog, ages_s):
    assert warning_count(caplog, ages_s) == 0


def test_backlog_after_a_pause_starts_with_its_own_least_age(caplog):
    assert warning_count(caplog, [1.0, 4.0, 7.0], every_s=2.5) == 0
