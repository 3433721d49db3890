from __future__ import annotations

import pytest

from zstate.clock import ManualClock
from zstate.metrics.buffer import MeteredBuffer

SECOND = 1_000_000_000
NOW = 1_789_000_000 * SECOND


def metered(*ages_s: float) -> MeteredBuffer:
    """A buffer that gets a sample of each age, in this order."""
    buffer = MeteredBuffer(ManualClock(NOW))
    for age_s in ages_s:
        stamp = NOW - round(age_s * SECOND)
        buffer.insert_many([("r1/base", "r1/tool")], stamp, [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    return buffer


def test_latency_is_the_median_and_age_that_of_the_newest():
    buffer = metered(0.3, 0.1, 0.02)
    measure = buffer.measure("r1")
    assert measure.latency_s == pytest.approx(0.1)
    assert measure.age_s == pytest.approx(0.02)
    assert measure.rate_hz > 0.0
    assert buffer.statistics_of("r1").count == 3
    assert buffer.has_samples.is_set()


def test_samples_of_another_robot_do_not_count():
    assert metered(0.1).measure("r2") == MeteredBuffer().measure("r2")


def test_without_samples_there_are_no_figures():
    buffer = metered()
    measure = buffer.measure("r1")
    assert (measure.rate_hz, measure.latency_s, measure.age_s) == (0.0, None, None)
    assert not buffer.has_samples.is_set()
