"""Figures of a reader, from synthetic recordings."""

from __future__ import annotations

from fractions import Fraction
from math import ceil

import numpy as np
import pytest

from bench.recording import (
    GRID,
    Recording,
    Window,
    distance,
    latency_grid,
    percentile,
    pose_errors,
    rate_in,
    reader_figures,
    rotation_angle,
)

SECOND = 10**9
BEGIN = 1_789_012_345_678_901_234
WINDOW = Window(BEGIN, BEGIN + 2 * SECOND)


def recording(
    stamps: list[int], robots: list[int] | None = None, times: list[int] | None = None
) -> Recording:
    return Recording(
        *(np.array(numbers, dtype=np.int64) for numbers in (stamps, robots or [0] * len(stamps), times or []))
    )


@pytest.mark.parametrize("count", [1, 2, 99, 1000, 4001])
def test_percentile_is_the_smallest_latency_not_exceeded_by_that_percentage(count: int) -> None:
    latencies = np.random.default_rng(count).lognormal(5.0, 1.0, count)
    grid = latency_grid(latencies)
    ordered = np.sort(latencies)
    for percent in (50, 99, 99.9, 100):
        place = max(1, ceil(Fraction(str(percent)) * count / 100))
        assert percentile(grid, percent) == round(float(ordered[place - 1]), 1)
    assert len(grid) == len(GRID)


def test_reader_without_answers_has_no_latencies() -> None:
    assert latency_grid(np.empty(0)) == []


def test_steady_rate_is_exact_for_any_window_offset() -> None:
    for offset in (0, 1, 3_333_333, 9_999_999):
        times = BEGIN + offset + np.arange(-50, 500) * 10_000_000
        assert rate_in(times, WINDOW) == pytest.approx(100.0, rel=1e-12)


def test_pause_lowers_the_rate_also_at_the_end_of_the_window() -> None:
    times = BEGIN + np.arange(0, 100) * 10_000_000  # one second of two
    assert rate_in(times, WINDOW) == 50.0
    assert rate_in(np.append(times, BEGIN + 3 * SECOND), WINDOW) == pytest.approx(100 / 3)


def test_unanswered_samples_stamped_in_the_window_are_lost() -> None:
    stamps = [BEGIN - 1, BEGIN, BEGIN + 1, BEGIN + SECOND, WINDOW.end - 1, WINDOW.end]
    answered = [BEGIN, WINDOW.end - 1, WINDOW.end]
    figures = reader_figures(
        recording(stamps), recording(answered, times=[one + 5000 for one in answered]), WINDOW, 100.0
    )
    assert (figures["answered"], figures["lost"]) == (2, 2)


def test_equal_stamps_of_two_robots_are_two_samples() -> None:
    sent = recording([BEGIN + 7, BEGIN + 7], [3, 4])
    figures = reader_figures(sent, recording([BEGIN + 7], [4], [BEGIN + 9]), WINDOW, 100.0)
    assert figures["lost"] == 1


def test_answers_after_more_than_a_period_are_late() -> None:
    stamps = [BEGIN, BEGIN + 1, BEGIN + 2]
    times = [BEGIN + 10_000_000, BEGIN + 1 + 10_000_001, BEGIN + 2 + 30_000_000]
    sent, answered = recording(stamps), recording(stamps, times=times)
    assert reader_figures(sent, answered, WINDOW, 100.0)["late"] == 2


def test_writer_files_yield_robot_and_tick_of_each_sample(tmp_path) -> None:
    np.array([10, 11, 20, 21, 30], dtype=np.int64).tofile(tmp_path / "writer0.stamps")
    np.array([12, 22], dtype=np.int64).tofile(tmp_path / "writer1.stamps")
    sent = Recording.read_writers(str(tmp_path), {"writer0": [0, 2], "writer1": [1]})
    assert sent.stamps.tolist() == [10, 11, 20, 21, 30, 12, 22]
    assert sent.robots.tolist() == [0, 2, 0, 2, 0, 1, 1]
    assert sent.ticks.tolist() == [0, 0, 1, 1, 2, 0, 1]


def test_answer_is_compared_with_the_row_sent_at_its_stamp() -> None:
    expected = np.array([[float(n), 0, 0, 0, 0, 0, 1] for n in range(3)])
    sent = Recording(BEGIN + np.arange(5), np.zeros(5, dtype=np.int64), ticks=np.arange(5))
    right = (BEGIN + 4, 0, [1.0, 0, 0, 0, 0, 0, 1])  # the rows begin again at tick 3
    wrong = (BEGIN + 1, 0, [1.0, 2.0, 0, 0, 0, 0, -1])
    found = pose_errors(sent, expected, [right, wrong, (BEGIN + 2, 0, "Oops: no"), (BEGIN, 0, None)], BEGIN)
    assert found == {
        "compared": 2,
        "most_m": 2.0,
        "most_rad": 0.0,
        "errors": 1,
        "first_error": "Oops: no",
    }


def test_answer_at_a_stamp_without_sample_is_an_error() -> None:
    sent = Recording(np.array([BEGIN]), np.array([0]), ticks=np.array([0]))
    found = pose_errors(sent, np.eye(1, 7), [(BEGIN + 1, 0, [0.0] * 7)], BEGIN)
    assert (found["compared"], found["errors"]) == (0, 1)


@pytest.mark.parametrize("angle", [1e-12, 1e-6, 0.3, 3.0])
def test_angle_between_poses_is_exact_even_if_tiny(angle: float) -> None:
    rotated = [0, 0, 0, 0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)]
    upright = [0, 0, 0, 0.0, 0.0, 0.0, 1.0]
    assert rotation_angle(rotated, upright) == pytest.approx(angle, rel=1e-9)
    assert rotation_angle([-one for one in rotated], upright) == pytest.approx(angle, rel=1e-9)


def test_distance_between_poses_is_that_of_their_origins() -> None:
    assert distance([1, 2, 3, 0, 0, 0, 1], [1, 5, 7, 0, 0, 1, 0]) == 5.0
