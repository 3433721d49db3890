"""When a source that the gate rejects is followed, and how far a compass is believed."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import pytest

from zstate.odometry.fusion import Estimate, Fusion, Heading, Reading, started
from zstate.odometry.invariant_filter import VELOCITY, ImuNoise, Measurement, initial_state
from zstate.odometry.rotations import rotation_exp

S = 1_000_000_000
WRONG, RIGHT = 50.0, 0.0
FUSION = Fusion(ImuNoise(gyro=1e-3, accel=1e-2, gyro_bias=1e-5, accel_bias=1e-4))


def at_rest(yaw: float = 0.0, yaw_sigma: float = 0.01) -> Estimate:
    zero = np.zeros(3)
    covariance = 1e-4 * np.eye(15)
    covariance[2, 2] = yaw_sigma**2
    state = initial_state(
        rotation=rotation_exp(np.array([0.0, 0.0, yaw])),
        velocity=zero,
        position=zero,
        gyro_bias=zero,
        accel_bias=zero,
        covariance=covariance,
    )
    return started(0, state)


def fates(readings: list[tuple[int, float]]) -> list[str]:
    """What becomes of readings of a velocity: stamp [ns] and residual [m/s]. The state never moves."""
    estimate, found = at_rest(), []
    for stamp, residual in readings:
        estimate = at_rest()._replace(stamp=stamp, runs=estimate.runs)
        jacobian = np.zeros((3, 15))
        jacobian[:, VELOCITY] = np.eye(3)
        measured = Measurement(np.array([residual, 0.0, 0.0]), jacobian, 1e-4 * np.eye(3))
        reading = Reading(stamp, lambda _state, _rate, measured=measured: measured)
        estimate, outcome = FUSION.after_reading(estimate, "wheels", reading, None)
        found.append(outcome.fate)
    return found


@pytest.mark.parametrize(("last", "fate"), [(2 * S - 1, "rejected"), (2 * S, "reacquired")])
def test_a_source_that_is_rejected_for_two_seconds_in_a_row_is_followed(last: int, fate: str):
    steps = [(n * S // 10, WRONG) for n in range(20)]
    assert fates([*steps, (last, WRONG)]) == ["rejected"] * 20 + [fate]


@pytest.mark.parametrize(("count", "fate"), [(9, "rejected"), (10, "reacquired")])
def test_fewer_than_ten_rejections_are_no_proof_however_long_they_take(count: int, fate: str):
    assert fates([(n * S, WRONG) for n in range(count)])[-1] == fate


def test_one_reading_that_agrees_ends_the_run_of_rejections():
    steps = [(n * S // 10, RIGHT if n == 15 else WRONG) for n in range(21)]
    assert fates(steps)[-1] == "rejected"


SIGMA = 0.01
"""Of headings and of the yaw at their start [rad]."""


def read(before: Estimate, yaw: float, measured: float, yaw_sigma: float = SIGMA) -> tuple[Estimate, str]:
    """The estimate of a base that heads to ``yaw`` after a heading of the compass, and what became of it."""
    estimate = at_rest(yaw, yaw_sigma)._replace(compasses=before.compasses)
    estimate, outcome = FUSION.after_heading(
        estimate, "compass", Heading(0, measured, SIGMA**2, np.eye(4)), None
    )
    return estimate, outcome.fate


@pytest.mark.parametrize("directions", [1, 6, 11, 12])
def test_a_compass_may_be_off_by_half_a_rad_until_it_was_read_in_all_of_twelve_directions(directions: int):
    estimate = at_rest()
    for number in range(directions):
        yaw = (number + 0.5) * math.tau / 12
        estimate, _ = read(estimate, yaw, yaw)
    estimate, fate = read(estimate, yaw, yaw, yaw_sigma=1.0)
    # The yaw is as sure as the heading, the yaw at its start, and what is unproven of the compass.
    unproven = 0.5 * (1.0 - directions / 12)
    assert fate == "accepted"
    assert math.sqrt(estimate.state.covariance[2, 2]) == pytest.approx(math.hypot(SIGMA, SIGMA, unproven))


@pytest.mark.parametrize(("part", "fate"), [(0.999, "accepted"), (1.001, "rejected")])
def test_a_compass_that_stays_while_the_base_turns_by_more_than_it_may_be_off_is_rejected(
    part: float, fate: str
):
    first, _ = read(at_rest(), 0.1, 0.1)
    # One of twelve directions is proven; both headings and the yaw have an error.
    sigma = math.hypot(SIGMA, SIGMA, SIGMA, 0.5 * 11 / 12)
    of_99_9_percent = NormalDist().inv_cdf(1.0 - 0.001 / 2)
    assert read(first, 0.1 + part * of_99_9_percent * sigma, 0.1)[1] == fate
