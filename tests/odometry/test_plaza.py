"""BaseEstimator on real recordings: a mower with wheels and a gyro, against its positions by RTK."""

from itertools import pairwise

import numpy as np
import pytest
from helpers import plaza
from helpers.base_motion import mounted

from zstate import Transform
from zstate.odometry import BaseEstimator, ImuNoise
from zstate.odometry.invariant_filter import Floats

# One setting for the robot. It has no accelerometer: its unknown accelerations are the noise of one.
NOISE = ImuNoise(gyro=1e-3, accel=0.5, gyro_bias=1e-5, accel_bias=1e-4, gyro_scale=0.01)
SIGMA = [0.02, 0.02, 0.02]
LEVEL = Transform("base_link", "imu_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def estimated(data: plaza.Plaza) -> Floats:
    """The path by BaseEstimator, at the stamps of the truth but the first: (N, 2)."""
    base = BaseEstimator(
        odom="odom", base="base_link", imu="imu_link", buffer=mounted(LEVEL), imu_noise=NOISE
    )
    points = np.zeros((len(data.increments), 2))
    seconds = data.truth[:, 0] - data.truth[0, 0] + 1.0
    for row, (start, end) in enumerate(pairwise(seconds.tolist())):
        _, distance, turn = data.increments[row]
        speed, rate = distance / (end - start), turn / (end - start)
        for part in (0.125, 0.375, 0.625, 0.875):
            stamp = round(1e9 * (start + part * (end - start)))
            base.imu(stamp, (0.0, 0.0, rate), (0.0, speed * rate, 9.80665))
        middle = round(0.5e9 * (start + end))
        base.velocity(middle, [speed, 0.0, 0.0], sigma=SIGMA, scale=0.01)
        if end > 2.0:  # aligned
            points[row] = base.state(round(1e9 * end)).odom_from_base.translation[:2]
    return points


def dead_reckoned(data: plaza.Plaza) -> Floats:
    """The path by the increments alone."""
    _, distances, turns = data.increments.T
    yaw = np.cumsum(turns) - 0.5 * turns
    return np.cumsum(distances[:, None] * np.stack((np.cos(yaw), np.sin(yaw)), axis=1), axis=0)


@pytest.mark.parametrize("name", ["Plaza1", "Plaza2"])
def test_a_real_mower_is_found_as_well_as_by_dead_reckoning(name: str):
    """Plaza1: 1.5 m after 1861 m. Plaza2 starts with a gyro bias, which standstill shows: 5 m, not 16."""
    folder = plaza.folder()
    if folder is None:
        pytest.skip("the recordings are in the gtsam wheel")
    data = plaza.load(folder / f"{name}_.mat")
    truth = data.truth[1:, 1:3]
    error = plaza.aligned_error(estimated(data), truth)
    assert error < 1.2 * plaza.aligned_error(dead_reckoned(data), truth)
    assert error < {"Plaza1": 1.5, "Plaza2": 6.0}[name]
