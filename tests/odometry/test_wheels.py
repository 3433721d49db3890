"""Wheels: the velocity of a base from the rotations of its wheels, and back."""

import math

import numpy as np
import pytest

from zstate import InvalidInput
from zstate.odometry import Ackermann, DiffDrive, Mecanum, WheelNoise, Wheels

DIFF = DiffDrive("left", "right", radius=0.1, track=0.5)
SKID = DiffDrive(("fl", "rl"), ("fr", "rr"), radius=0.1, track=0.5)
MECANUM = Mecanum("fl", "fr", "rl", "rr", radius=0.1, track=0.5, wheelbase=0.6)
CAR = Ackermann("rl", "rr", ("sl", "sr"), radius=0.3, track=1.4, wheelbase=2.5)


def driven(wheels: Wheels, linear: tuple[float, float, float], yaw_rate: float, start: float) -> None:
    """Drive for 0.1 s, and check that the wheels measure what they were commanded."""
    before = dict.fromkeys(wheels.joint_names, start)
    rates = wheels.joint_velocities(linear, (0.0, 0.0, yaw_rate))
    after = {name: before[name] + 0.1 * rates.get(name, 0.0) for name in before}
    if isinstance(wheels, Ackermann):
        angles = wheels.steering_angles(linear, (0.0, 0.0, yaw_rate))
        before, after = before | angles, after | angles
    measured = wheels.velocity(before, after, 0.1)
    np.testing.assert_allclose(measured.linear, linear, atol=1e-12)
    np.testing.assert_allclose(measured.angular, (0.0, 0.0, yaw_rate), atol=1e-12)


@pytest.mark.parametrize("wheels", [DIFF, SKID, MECANUM, CAR], ids=["diff", "skid", "mecanum", "car"])
@pytest.mark.parametrize("start", [0.0, 100.0])
def test_wheels_measure_the_velocity_that_they_are_commanded(wheels: Wheels, start: float):
    driven(wheels, (0.7, 0.0, 0.0), 0.4, start)
    driven(wheels, (-0.7, 0.0, 0.0), 0.4, start)
    if isinstance(wheels, Mecanum):
        driven(wheels, (0.2, -0.3, 0.0), 0.4, start)


def test_a_car_on_a_circle_has_its_inner_front_wheel_steered_more():
    """The axes of all wheels meet at the middle of the circle, 10 m to the left of the rear axle."""
    angles = CAR.steering_angles((2.0, 0.0, 0.0), (0.0, 0.0, 0.2))
    assert angles["sl"] == pytest.approx(math.atan(2.5 / (10.0 - 0.7)))
    assert angles["sr"] == pytest.approx(math.atan(2.5 / (10.0 + 0.7)))


def test_mecanum_wheels_turn_a_base_in_place_by_half_of_track_and_wheelbase():
    rates = MECANUM.joint_velocities((0.0, 0.0, 0.0), (0.0, 0.0, 0.4))
    rim = 0.5 * (0.5 + 0.6) * 0.4 / 0.1
    assert rates == pytest.approx({"fl": -rim, "fr": rim, "rl": -rim, "rr": rim})


def test_positions_that_wrap_at_a_half_turn_are_short_rotations():
    before, after = {"left": 3.1, "right": 3.1}, {"left": -3.1, "right": -3.1}
    measured = DIFF.velocity(before, after, 1.0)
    assert measured.linear[0] == pytest.approx(0.1 * (math.tau - 6.2))


def test_slip_grows_with_the_speed_and_what_wheels_cannot_do_is_measured_as_zero():
    noise = WheelNoise(slip=0.1, speed=0.01, lateral=0.03, vertical=0.04)
    np.testing.assert_allclose(np.diag(noise.covariance(2.0)), (0.01**2 + 0.2**2, 0.03**2, 0.04**2))
    sideways = MECANUM.velocity(
        dict.fromkeys(["fl", "fr", "rl", "rr"], 0.0), {"fl": -1, "fr": 1, "rl": 1, "rr": -1}, 0.1
    )
    assert sideways.linear[1] == pytest.approx(1.0)
    assert sideways.covariance[1, 1] == sideways.covariance[0, 0]


def test_velocities_that_wheels_cannot_drive_are_refused():
    with pytest.raises(InvalidInput, match="x and about z only"):
        DIFF.joint_velocities((1.0, 0.2, 0.0), (0.0, 0.0, 0.0))
    with pytest.raises(InvalidInput, match="only as it drives"):
        CAR.joint_velocities((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def test_impossible_geometry_and_noise_are_refused():
    with pytest.raises(InvalidInput, match="radius"):
        DiffDrive("left", "right", radius=0.0, track=0.5)
    with pytest.raises(InvalidInput, match="'left', 'left'"):
        DiffDrive("left", "left", radius=0.1, track=0.5)
    with pytest.raises(InvalidInput, match=r"'lateral' of wheels is finite and above 0; got 0\.0"):
        WheelNoise(lateral=0.0)
    WheelNoise(slip=0.0, scale=0.0, lateral=1e-300)
    with pytest.raises(InvalidInput, match=r"'slip' of wheels is finite and 0 or more; got -0\.1"):
        WheelNoise(slip=-0.1)
