from __future__ import annotations

import time

import pytest

from zstate.cli.metered_buffer import Mark, Meter


def test_a_measure_counts_what_came_between_its_marks():
    meter = Meter()
    meter.note(0)
    first = meter.mark()
    for _ in range(3):
        meter.note(0)
    last = Mark(first.time_s + 0.5, meter.mark().count)
    meter.note(0)
    assert meter.measure(first, last).rate_hz == pytest.approx(3 / 0.5)


def test_latency_is_the_median_of_the_samples_between_the_marks_alone():
    meter = Meter()

    def note(age_s: int) -> None:
        meter.note(time.time_ns() - age_s * 1_000_000_000)

    note(1000)
    first = meter.mark()
    for age_s in (30, 10, 20):
        note(age_s)
    last = meter.mark()
    note(2000)
    measure = meter.measure(first, last)
    assert measure.latency_s == pytest.approx(20.0, abs=5.0)
    assert measure.age_s == pytest.approx(2000.0, abs=5.0)


def test_nothing_measured_is_nothing_claimed():
    meter = Meter()
    mark = meter.mark()
    measure = meter.measure(mark, mark)
    assert (measure.rate_hz, measure.latency_s, measure.age_s) == (0.0, None, None)
    assert not meter.has_begun.is_set()
