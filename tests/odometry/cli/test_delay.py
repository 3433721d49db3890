"""Delays of stamps by two measurements of one motion, whose delay is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.odometry.cli.delay import Series, fitted_delay

SECONDS = 60.0
IMU_TIMES = np.arange(0.0, SECONDS, 0.005)


def yaw(seconds: np.ndarray) -> np.ndarray:
    """Turns with periods of 3 to 9 s."""
    return 1.2 * np.sin(0.7 * seconds) + 0.4 * np.sin(2.1 * seconds + 1.0)


def source(delay_s: float, *, noise: float = 0.0, seed: int = 0, rate_hz: float = 20.0) -> Series:
    seconds = np.arange(0.0, SECONDS, 1.0 / rate_hz)
    slip = np.cumsum(np.random.default_rng(seed).normal(0.0, noise / math.sqrt(rate_hz), len(seconds)))
    # Wheels that turn by 0.7 of what they say, and a gyro with a bias.
    return Series(seconds, 1.4 * yaw(seconds - delay_s) + 0.03 * seconds + slip)


IMU = Series(IMU_TIMES, yaw(IMU_TIMES))


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 100.0])
@pytest.mark.parametrize("delay_s", [-0.31, -0.004, 0.0, 0.123, 0.4])
def test_delay_is_found_in_spite_of_scale_and_bias(delay_s: float, rate_hz: float):
    found = fitted_delay(IMU, source(delay_s, rate_hz=rate_hz))
    assert found is not None
    assert found.delay_s == pytest.approx(delay_s, abs=1e-3)


@pytest.mark.long
def test_standard_deviation_is_that_of_the_errors():
    """Of 100 sources that slip: a sum of squares of 100 is from 0.62 to 1.49 in 99.9 % of all cases."""
    errors: list[float] = []
    for seed in range(100):
        found = fitted_delay(IMU, source(0.1, noise=0.05, seed=seed))
        assert found is not None
        errors.append((found.delay_s - 0.1) / found.sigma_s)
    assert 0.62 / 1.4 < np.mean(np.square(errors)) < 1.49 * 1.4, np.mean(np.square(errors))


@pytest.mark.parametrize(
    "other",
    [
        pytest.param(Series(IMU_TIMES, 0.1 * IMU_TIMES), id="even turn"),
        pytest.param(Series(IMU_TIMES, -yaw(IMU_TIMES)), id="mirrored"),
        pytest.param(source(0.1, noise=3.0), id="noise"),
        pytest.param(source(0.9), id="further than it is searched"),
        pytest.param(Series(IMU_TIMES[:10], yaw(IMU_TIMES[:10])), id="few"),
    ],
)
def test_motion_that_does_not_show_the_delay_gives_none(other: Series):
    assert fitted_delay(IMU, other) is None


def test_pauses_of_a_source_are_left_out():
    seconds, values = source(0.1)
    before, after = seconds < 20.0, seconds > 35.0
    paused = Series(
        np.concatenate((seconds[before], seconds[after])),
        np.concatenate((values[before], values[after] + math.tau)),
    )
    found = fitted_delay(IMU, paused)
    assert found is not None
    assert found.delay_s == pytest.approx(0.1, abs=1e-3)
