"""When a source that the gate rejects is followed: after 2 s and 10 rejections in a row."""

from __future__ import annotations

import numpy as np
import pytest

from zstate.odometry.fusion import Estimate, Fusion, Reading, started
from zstate.odometry.invariant_filter import VELOCITY, ImuNoise, Measurement, initial_state

S = 1_000_000_000
WRONG, RIGHT = 50.0, 0.0


def at_rest() -> Estimate:
    zero = np.zeros(3)
    state = initial_state(
        rotation=np.eye(3),
        velocity=zero,
        position=zero,
        gyro_bias=zero,
        accel_bias=zero,
        covariance=1e-4 * np.eye(15),
    )
    return started(0, state)


def fates(readings: list[tuple[int, float]]) -> list[str]:
    """What becomes of readings of a velocity: stamp [ns] and residual [m/s]. The state never moves."""
    fusion, estimate, found = (
        Fusion(ImuNoise(gyro=1e-3, accel=1e-2, gyro_bias=1e-5, accel_bias=1e-4)),
        at_rest(),
        [],
    )
    for stamp, residual in readings:
        estimate = at_rest()._replace(stamp=stamp, runs=estimate.runs)
        jacobian = np.zeros((3, 15))
        jacobian[:, VELOCITY] = np.eye(3)
        measured = Measurement(np.array([residual, 0.0, 0.0]), jacobian, 1e-4 * np.eye(3))
        reading = Reading(stamp, lambda _state, _rate, measured=measured: measured)
        estimate, outcome = fusion.after_reading(estimate, "wheels", reading, None)
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
