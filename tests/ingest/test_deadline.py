"""Deadlines, by a clock that is given."""

from __future__ import annotations

import math

import pytest

from zstate.ingest.deadline import Deadline, DeadlineMonitor, is_stale

WRITER = ("r1", 7)


def monitored(*times_s: float) -> DeadlineMonitor:
    monitor = DeadlineMonitor()
    monitor.register(WRITER)
    for now_s in times_s:
        assert monitor.on_sample(WRITER, now_s) is None
    return monitor


@pytest.mark.parametrize(("period_s", "silence_s"), [(0.01, 0.5), (0.05, 0.5), (0.2, 2.0)])
def test_deadline_is_ten_periods_and_at_least_half_a_second(period_s: float, silence_s: float):
    monitor = monitored(*(100.0 + period_s * number for number in range(50)))
    due_s = 100.0 + period_s * 49 + silence_s
    stale, next_s = monitor.expired(due_s - 1e-3)
    assert not stale
    assert next_s == pytest.approx(due_s)
    stale, next_s = monitor.expired(due_s + 1e-3)
    assert stale == {WRITER: pytest.approx(silence_s + 1e-3)}
    assert next_s == math.inf


@pytest.mark.parametrize(
    ("period_s", "thinned_s", "silence_s"),
    [(0.2, 0.2, 3 * 0.2 + 0.2), (1.0, 1.0, 3 * 1.0 + 0.2), (0.05, 0.05, 0.5), (0.02, 0.2, 0.5)],
)
def test_of_a_thinned_stream_three_periods_and_a_margin_are_enough(
    period_s: float, thinned_s: float, silence_s: float
):
    """Within its site the same robot comes faster, and is treated as any other."""
    monitor = monitored(*(100.0 + period_s * number for number in range(50)))
    monitor.thinned_s = {"r1": thinned_s, "r2": 1e-3}
    due_s = 100.0 + period_s * 49 + silence_s
    assert monitor.expired(due_s - 1e-3) == ({}, pytest.approx(due_s))
    assert monitor.expired(due_s + 1e-3) == ({WRITER: pytest.approx(silence_s + 1e-3)}, math.inf)


def test_writer_becomes_stale_once_until_its_next_sample():
    monitor = monitored(1.0, 1.1)
    assert monitor.expired(9.0)[0]
    assert not monitor.expired(10.0)[0]
    assert monitor.on_sample(WRITER, 11.1) == pytest.approx(10.0)
    assert monitor.on_sample(WRITER, 11.2) is None
    assert monitor.expired(19.0)[0]


def test_writer_with_fewer_than_two_samples_is_not_stale():
    assert monitored().expired(1e9) == ({}, math.inf)
    assert monitored(1.0).expired(1e9) == ({}, math.inf)


def test_samples_of_unregistered_writers_are_ignored():
    monitor = DeadlineMonitor()
    for now_s in (1.0, 2.0):
        assert monitor.on_sample(WRITER, now_s) is None
    assert monitor.expired(1e9) == ({}, math.inf)


def test_unregister_returns_whether_the_writer_was_stale():
    monitor = monitored(1.0, 1.1)
    monitor.register(WRITER)
    monitor.expired(9.0)
    assert [monitor.unregister(WRITER) for _ in range(3)] == [True, True, False]
    assert not monitored(1.0, 1.1).unregister(WRITER)


@pytest.mark.parametrize(
    ("silent_s", "rate_hz", "expected"),
    [(0.4, 100.0, False), (0.6, 100.0, True), (1e9, None, False), (9.0, 1.0, False), (11.0, 1.0, True)],
)
def test_known_rate_gives_the_same_deadline(silent_s: float, rate_hz: float | None, expected: bool):
    assert is_stale(silent_s, rate_hz) == expected


def test_slower_writer_misses_two_deadlines_and_no_third():
    deadline = Deadline()
    for number in range(100):
        deadline.on_sample(0.01 * number)
    missed: list[bool] = []
    for second in range(1, 6):
        missed.append(deadline.is_missed(second + 0.99))
        deadline.on_sample(second + 1.0)
    assert missed == [True, True, False, False, False]


def test_silence_does_not_count_as_a_period():
    deadline = Deadline()
    for now_s in (0.0, 0.1, 0.2, 60.0, 60.1):
        deadline.on_sample(now_s)
    assert deadline.due_s == pytest.approx(60.1 + 1.0)


def test_fixed_time_limits_the_wait_for_a_second_sample():
    deadline = Deadline(unknown_s=2.0)
    assert not deadline.is_missed(1e9)
    deadline.on_sample(10.0)
    assert (deadline.is_missed(11.9), deadline.is_missed(12.1)) == (False, True)
