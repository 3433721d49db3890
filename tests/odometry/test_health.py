"""Health: quantiles of the chi-square distribution, and sentences on sources."""

import math
from collections.abc import Sequence

import pytest

from zstate.odometry.health import (
    Fate,
    Outcome,
    SourceHealth,
    SourceRecord,
    chi_square_quantile,
    gate,
    nis_band,
)


@pytest.mark.parametrize(
    ("probability", "degrees", "value"),
    # Abramowitz and Stegun, Handbook of Mathematical Functions, table 26.8.
    [(0.999, 1, 10.828), (0.999, 3, 16.266), (0.999, 6, 22.458), (0.975, 3, 9.34840), (0.025, 3, 0.215795),
     (0.025, 1, 0.000982069), (0.975, 100, 129.561), (0.025, 100, 74.2219)],
)  # fmt: skip
def test_quantiles_are_those_of_the_table(probability: float, degrees: int, value: float):
    assert chi_square_quantile(probability, degrees) == pytest.approx(value, rel=1e-4)


@pytest.mark.parametrize(("dimension", "nis"), [(1, 10.828), (3, 16.266), (6, 22.458)])
def test_the_gate_lets_pass_99_9_percent_of_the_readings_by_the_table(dimension: int, nis: float):
    assert gate(dimension) == pytest.approx(nis, rel=1e-4)


def test_the_band_of_a_mean_narrows_with_the_root_of_the_count():
    """A chi-square variable of many degrees n is nearly normal, with the mean n and the variance 2 n."""
    low, high = nis_band(3, 1000)
    width = 2 * 1.96 * (2.0 * 3 / 1000) ** 0.5
    assert high - low == pytest.approx(width, rel=0.01)
    assert 0.5 * (low + high) == pytest.approx(3.0, rel=0.01)


def health(
    nis: float, *, fate: Fate = "accepted", count: int = 100, has_bounds: bool = False
) -> SourceHealth:
    record = SourceRecord(has_bounds=has_bounds)
    for number in range(count):
        record.stamps.append(20_000_000 * number)
        record.keep(Outcome(fate, nis, 3))
    return record.health("wheels", 20_000_000 * count, [], "", history_s=1.0)


def test_sigmas_that_are_right_need_no_sentence():
    found = health(3.1)
    assert found.sentence == ""
    assert found.rate_hz == pytest.approx(50.0)
    assert found.age_s == pytest.approx(0.02)
    assert found.nis_band[0] < found.nis_mean < found.nis_band[1]


def test_wheels_that_bridged_a_pause_are_judged_by_what_they_measured_before():
    record = SourceRecord()
    bridged = Outcome("accepted", math.nan, 0)
    only = record.health("wheels", 0, [bridged], "", history_s=1.0)
    assert (only.accepted, only.dimension, only.sentence) == (1, 0, "")
    assert math.isnan(only.nis_mean)
    for _ in range(100):
        record.keep(Outcome("accepted", 3.1, 3))
    found = record.health("wheels", 0, [bridged], "", history_s=1.0)
    assert (found.accepted, found.dimension, found.sentence) == (101, 3, "")
    assert found.nis_mean == pytest.approx(3.1)


def test_sigmas_that_are_too_small_are_reported_with_their_factor():
    """A sigma that is 2 times too small makes the NIS 4 times as large."""
    assert health(12.0).sentence == (
        "wheels: NIS 12.0 for 3 numbers, expected 0.2 to 9.3: its sigmas are about 2 times too small"
    )


def test_sigmas_that_are_too_large_are_reported_unless_they_are_bounds():
    assert "about 10 times too large" in health(0.03).sentence
    assert health(0.03, has_bounds=True).sentence == ""


def test_rejections_are_reported():
    found = health(3.0, fate="rejected", count=20)
    assert (found.accepted, found.rejected) == (0, 20)
    assert "20 of its last 20 readings were rejected" in found.sentence


def kept(fates: Sequence[Fate]) -> str:
    """The sentence on a source whose readings, with the right NIS, became that."""
    record = SourceRecord()
    for fate in fates:
        record.keep(Outcome(fate, 3.0, 3))
    return record.health("wheels", 0, [], "", history_s=1.0).sentence


def test_more_than_a_tenth_of_the_last_200_readings_must_be_rejected_to_be_reported():
    assert kept(["rejected"] * 20 + ["accepted"] * 180) == ""
    assert "21 of its last 200 readings were rejected" in kept(["rejected"] * 21 + ["accepted"] * 179)
    assert kept(["rejected"] * 1000 + ["accepted"] * 180) == ""


@pytest.mark.parametrize(
    ("nis", "text"),
    [(3.0 * 1.499**2, ""), (3.0 * 1.501**2, "too small"), (3.0 / 3.99**2, ""), (3.0 / 4.01**2, "too large")],
)
def test_sigmas_are_named_that_are_1_5_times_too_small_or_four_times_too_large(nis: float, text: str):
    sentence = health(nis).sentence
    assert text in sentence
    assert bool(sentence) == bool(text)


def test_fewer_than_ten_readings_are_no_evidence_on_sigmas():
    assert health(12.0, count=9).sentence == ""
    assert "too small" in health(12.0, count=10).sentence
