"""A magnetometer as a source of the yaw: honest, beside iron and motors, on a slope, in wrong units."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from helpers.base_motion import mounted, stamp_at

from zstate import InvalidInput, Transform
from zstate.checks import Floats
from zstate.odometry import BaseEstimator, ImuNoise, SourceHealth
from zstate.odometry.magnetism import EarthField
from zstate.odometry.rotations import rotation_exp

STRENGTH, DIP, NORTH = 48e-6, math.radians(63.0), 1.0
EARTH = STRENGTH * np.array(
    (math.cos(DIP) * math.cos(NORTH), math.cos(DIP) * math.sin(NORTH), -math.sin(DIP))
)
"""In the axes of the odometry, whose x axis is 1 rad clockwise of magnetic north."""

HZ, SIGMA_DEG = 20, 5.0
DRIFTING = ImuNoise(
    gyro=1e-3, accel=2e-2, gyro_bias=5e-4, accel_bias=1e-3, gyro_scale=0.0, gyro_bias_shift=0.0
)


class Drive(NamedTuple):
    """What became of a drive: errors of the yaw and their sigmas at each second [rad], and the estimator."""

    errors: Floats
    sigmas: Floats
    base: BaseEstimator

    @property
    def health(self) -> SourceHealth:
        return next(one for one in self.base.health() if one.name == "mag")


def estimator() -> BaseEstimator:
    """Of a base whose magnetometer is turned by 90 degrees about its vertical."""
    buffer = mounted(Transform("base_link", "imu_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    buffer.insert_static(Transform.from_rpy("base_link", "mag", (0.2, 0.0, 0.5), (0.0, 0.0, math.pi / 2)))
    return BaseEstimator(odom="odom", base="base_link", imu="imu_link", buffer=buffer, imu_noise=DRIFTING)


def measured(world_from_base: Floats) -> Floats:
    """The field of the Earth in the axes of the magnetometer of ``estimator``."""
    x, y, z = world_from_base.T @ EARTH
    return np.array((y, -x, z))


def upright(yaw: float) -> Floats:
    """world_from_base of a level base."""
    return rotation_exp(np.array((0.0, 0.0, yaw)))


def yaw_rate(t: float) -> float:
    return 0.0 if t < 2.0 else 0.4 * math.sin(0.2 * t) + 0.3


def drive(
    distorted: Callable[[float, Floats], Floats | None],
    *,
    seconds: float = 120.0,
    expected: EarthField | None = None,
    roll: float = 0.0,
) -> Drive:
    """Two seconds at rest, then turns, while the bias of the gyro drifts by one sigma of its walk.

    ``distorted(t, field)`` is what the magnetometer measures at the time t [s], None for nothing. ``roll``
    [rad] is that of the floor.
    """
    base, random = estimator(), np.random.default_rng(5)
    yaw, errors, sigmas = 0.0, list[float](), list[float]()
    slope = rotation_exp(np.array((roll, 0.0, 0.0)))
    for step in range(round(seconds * HZ)):
        t = step / HZ
        rotation = slope @ upright(yaw)
        rate, speed = yaw_rate(t), 0.0 if t < 2.0 else 0.5
        bias = DRIFTING.gyro_bias * math.sqrt(t)
        gyro = np.array((0.0, 0.0, rate + bias)) + random.normal(0.0, DRIFTING.gyro * math.sqrt(HZ), 3)
        accel = rotation.T @ (0.0, 0.0, 9.80665) + (0.0, speed * rate, 0.0)
        base.imu(stamp_at(t), gyro, accel)
        if step % 2 == 0:
            base.velocity(stamp_at(t), (speed, 0.0, 0.0), sigma=[0.02] * 3)
            field = distorted(t, measured(rotation) + random.normal(0.0, 3e-7, 3))
            if field is not None:
                sigma = math.radians(SIGMA_DEG)
                base.magnetic_field(stamp_at(t), field, sigma, source="mag", frame="mag", expected=expected)
        if step % HZ == 0 and t >= 3.0:
            state = base.state()
            true_yaw = math.atan2(rotation[1, 0], rotation[0, 0])
            errors.append(math.remainder(state.odom_from_base.rpy[2] - true_yaw, math.tau))
            sigmas.append(math.sqrt(state.covariance.pose[5, 5]))
        yaw += 0.5 * (rate + yaw_rate(t + 1.0 / HZ)) / HZ  # as between two samples of a gyro
    return Drive(np.array(errors), np.array(sigmas), base)


@pytest.mark.long
def test_a_magnetometer_bounds_the_drift_of_a_gyro_to_its_sigma():
    without, honest = drive(lambda t, field: None), drive(lambda t, field: field)
    assert abs(without.errors[-1]) > math.radians(15.0)
    assert max(abs(honest.errors[60:])) < math.radians(SIGMA_DEG)
    assert (abs(honest.errors) < 3.0 * honest.sigmas).all()
    # Errors of a magnetometer do not average out: the yaw is never surer than one reading of it.
    assert math.radians(SIGMA_DEG) < honest.sigmas[-1] < math.radians(1.2 * SIGMA_DEG)
    assert (honest.health.accepted, honest.health.rejected) == (1200, 0)
    assert honest.health.sentence == ""


HARD_IRON = STRENGTH * math.cos(DIP) * np.array((math.sin(math.radians(20.0)), 0.0, 0.0))
SOFT_IRON = np.diag((1.0 + math.sin(math.radians(20.0)), 1.0 - math.sin(math.radians(20.0)), 1.0))
"""Which turn the level field by up to 20 degrees, once and twice in a turn of the base."""


@pytest.mark.long
@pytest.mark.parametrize(
    "distorted",
    [
        pytest.param(lambda t, field: field + HARD_IRON, id="hard iron"),
        pytest.param(lambda t, field: SOFT_IRON @ field, id="soft iron", marks=pytest.mark.soak),
    ],
)
def test_iron_on_the_robot_takes_the_weight_of_its_magnetometer(
    distorted: Callable[[float, Floats], Floats],
):
    found = drive(distorted)
    assert (abs(found.errors) < 3.0 * found.sigmas).all()
    assert found.sigmas[-1] > math.radians(15.0)
    assert "degrees as the base moves, against the gyro, and weighted so" in found.health.sentence
    assert "the magnetometer is not calibrated" in found.health.sentence


@pytest.mark.parametrize("expected", [None, EarthField(0.0, STRENGTH, DIP)], ids=["start", "Earth"])
def test_the_current_of_a_motor_is_rejected_and_named(expected: EarthField | None):
    current = np.array((0.0, 0.0, 0.327 * STRENGTH))
    found = drive(
        lambda t, field: field - current if 8.0 <= t < 10.0 else field, seconds=12.0, expected=expected
    )
    assert (found.health.accepted, found.health.rejected) == (100, 20)
    whose = "at the start" if expected is None else "of the Earth here"
    usual = re.search(
        rf"30 % stronger than the (\S+) uT {whose}: iron or a motor is near", found.health.sentence
    )
    assert usual
    assert float(usual[1]) == pytest.approx(1e6 * STRENGTH, abs=0.9)  # the noise of one reading is 0.3 uT
    assert max(abs(found.errors)) < math.radians(2.0)


def test_a_start_beside_a_magnet_is_told_from_the_field_of_the_earth_at_the_place():
    magnet = np.array((2e-5, 0.0, -2e-5))
    found = drive(
        lambda t, field: field + magnet if t < 5.0 else field,
        seconds=12.0,
        expected=EarthField(0.0, STRENGTH, DIP),
    )
    assert (found.health.accepted, found.health.rejected) == (70, 50)
    assert "degrees as the base moves" not in found.health.sentence


def test_a_robot_on_a_slope_of_ten_degrees_has_the_yaw_of_a_level_one():
    found = drive(lambda t, field: field, seconds=15.0, roll=math.radians(10.0))
    # A field that is not levelled would turn by 2 tan(63 degrees) sin(10 degrees), 39 degrees.
    assert found.health.rejected == 0
    assert found.health.nis_mean < (2.0 / SIGMA_DEG) ** 2
    assert max(abs(found.errors)) < math.radians(2.0)


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ([0.2, 0.0, -0.43], r"'mag' is 0.474 T, .* 1 gauss 1e-4 T"),
        ([2e-9, 0.0, -4e-9], r"'mag' is 4.47e-09 T"),
        ([20.0, 0.0, -43.0], "'mag'"),
        ([2e-5, math.nan, -4e-5], "'mag'"),
    ],
    ids=["gauss", "nothing", "microtesla", "NaN"],
)
def test_fields_in_other_units_are_refused_with_the_name_of_their_source(field: list[float], text: str):
    with pytest.raises(InvalidInput, match=text):
        estimator().magnetic_field(stamp_at(0.0), field, 0.1, source="mag", frame="mag")


@pytest.mark.parametrize("sigma", [0.0, math.nan, 1e10])
def test_a_sigma_that_is_none_is_refused(sigma: float):
    with pytest.raises(InvalidInput, match="'mag' has a sigma of"):
        estimator().magnetic_field(stamp_at(0.0), EARTH, sigma, source="mag")


def test_at_a_magnetic_pole_there_is_no_heading():
    base = estimator()
    for step in range(200):
        base.imu(stamp_at(0.01 * step), (0.0, 0.0, 0.0), (0.0, 0.0, 9.80665))
        base.magnetic_field(stamp_at(0.01 * step), (3e-6, 0.0, -55e-6), 0.1, source="mag")
    assert "this axis has no heading: it is 87 degrees from level" in " ".join(
        one.sentence for one in base.health()
    )
