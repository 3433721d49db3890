from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.driving import Driver, Setpoint
from zstate.errors import InvalidInput
from zstate.odometry.invariant_filter import ImuNoise
from zstate.odometry.simulated_rover import SimulatedRover, SimulatedWheels, tracking_twist
from zstate.sources.square_drive import SquareDrive, WheelPair
from zstate.transform import Transform

WHEELS = WheelPair(0.08, 0.32)
# Turned by a quarter about x, so that the base's z is the IMU's y: the mount must be used.
MOUNT = Transform.from_rpy("base", "imu", (0.1, -0.05, 0.2), (math.pi / 2, 0.0, 0.0))
SILENT = ImuNoise(gyro=1e-15, accel=1e-15, gyro_bias=0.0, accel_bias=0.0)
MS = 1_000_000
START = 1_700_000_000 * 1000 * MS


def rover_at_rest(noise: ImuNoise = SILENT, **options: float) -> SimulatedRover:
    rover = SimulatedRover(WHEELS, MOUNT, noise, **options)  # pyright: ignore[reportArgumentType]
    rover.advance(START)
    return rover


def test_constant_wheel_rates_drive_the_arc_of_the_wheels_kinematics():
    """After the lag of 50 ms: v = r (l + r) / 2 and w = r (r - l) / b, on a circle of the radius v / w."""
    rover = rover_at_rest()
    rover.drive((4.0, 6.0))
    rover.advance(START + 1000 * MS)  # 20 time constants
    x, y, yaw = rover.pose
    rover.advance(START + 3000 * MS)
    speed, rate = 0.08 * 5.0, 0.08 * 2.0 / 0.32
    turned = rate * 2.0
    ahead, left = speed / rate * math.sin(turned), speed / rate * (1.0 - math.cos(turned))
    assert rover.pose == pytest.approx(
        (
            x + ahead * math.cos(yaw) - left * math.sin(yaw),
            y + ahead * math.sin(yaw) + left * math.cos(yaw),
            yaw + turned,
        ),
        abs=1e-6,
    )


def test_imu_on_a_circle_has_gravity_and_the_centripetal_acceleration_of_its_mount():
    rover = rover_at_rest()
    rover.drive((4.0, 6.0))
    rover.advance(START + 2000 * MS)
    rover.imu(START + 2000 * MS)
    (reading,) = rover.imu(START + 2005 * MS)
    assert reading.stamp == START + 2002 * MS + MS // 2
    speed, rate = 0.4, 0.5
    force = (-(rate**2) * 0.1, speed * rate + rate**2 * 0.05, 9.80665)
    # imu axes: x of the base, then its z, then minus its y
    assert reading.gyro == pytest.approx([0.0, rate, 0.0], abs=1e-9)
    assert reading.accel == pytest.approx([force[0], force[2], -force[1]], abs=1e-9)


def test_integrated_imu_readings_are_the_motion():
    """Sums of the means: the yaw, and from rest to rest no speed along any axis that does not turn."""
    rover = rover_at_rest(slip=0.05)
    yaw = speed = 0.0
    for tick in range(1, 401):
        if tick == 10:
            rover.drive((5.0, 5.0))
        (reading,) = rover.imu(START + 5 * tick * MS)
        yaw += 0.005 * reading.gyro[1]
        speed += 0.005 * reading.accel[0]
    assert yaw == pytest.approx(rover.pose.yaw, abs=1e-12)
    newest = rover.poses([START + 1999 * MS, START + 2000 * MS])
    way = float(np.hypot(*np.diff(newest[:, :2], axis=0)[0]))
    assert speed == pytest.approx(way / 0.001, abs=0.02)  # the lever of the slip's yaw, 0.1 m * w^2


def test_the_same_seed_gives_the_same_run_and_another_one_another():
    noise = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=1e-4, accel_bias=1e-3)

    def run(seed: int) -> list[float]:
        rover = rover_at_rest(noise, slip=0.02, seed=seed)
        rover.drive((3.0, 2.0))
        *_, last = rover.imu(START + 245 * MS)
        return [*last.gyro, *last.accel, *rover.pose]

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_white_noise_has_its_density_and_biases_stay():
    noise = ImuNoise(gyro=1e-2, accel=1e-1, gyro_bias=0.0, accel_bias=0.0)
    rover = SimulatedRover(WHEELS, MOUNT, noise, gyro_bias=(0.0, 0.3, 0.0), accel_bias=(1.0, 0.0, 0.0))
    rover.advance(START)
    readings = [one for tick in range(1, 2001) for one in rover.imu(START + 5 * tick * MS)]
    gyro = np.array([one.gyro for one in readings])
    accel = np.array([one.accel for one in readings])
    # A density over sqrt(dt); 6000 numbers know a deviation to 1 / sqrt(12000), or 0.9 %.
    assert gyro.std(axis=0).mean() == pytest.approx(1e-2 / math.sqrt(0.005), rel=0.04)
    assert accel.std(axis=0).mean() == pytest.approx(1e-1 / math.sqrt(0.005), rel=0.04)
    mean_gyro, mean_accel = 1e-2 / math.sqrt(0.005 * 2000), 1e-1 / math.sqrt(0.005 * 2000)
    assert gyro.mean(axis=0) == pytest.approx([0.0, 0.3, 0.0], abs=5 * mean_gyro)
    assert accel.mean(axis=0) == pytest.approx([1.0, 9.80665, 0.0], abs=5 * mean_accel)


def test_wheels_that_slip_turn_as_far_and_get_less_far_or_further():
    sure, slipping = rover_at_rest(), rover_at_rest(slip=0.1, seed=3)
    for rover in (sure, slipping):
        rover.drive((5.0, 5.0))
    turned = [rover.joints(START + 2000 * MS).positions.tolist() for rover in (sure, slipping)]
    assert turned[0] == turned[1]
    assert abs(slipping.pose.x / sure.pose.x - 1.0) > 1e-4
    assert abs(slipping.pose.x / sure.pose.x - 1.0) < 0.3


def test_late_reader_of_the_imu_finds_the_same_readings():
    """A program that was stalled for 70 ms gets 14 readings of 5 ms, not one mean of them."""
    prompt, late = rover_at_rest(), rover_at_rest()
    for rover in (prompt, late):
        rover.drive((4.0, 6.0))
    expected = [one for tick in range(1, 21) for one in prompt.imu(START + 5 * tick * MS)]
    late.joints(START + 33 * MS)  # another program reads the wheels at its own instants
    found = [one for elapsed in (30, 100) for one in late.imu(START + elapsed * MS)]
    assert [one.stamp for one in found] == [START + 5 * tick * MS - 5 * MS // 2 for tick in range(1, 21)]
    assert [one.gyro.tolist() for one in found] == [one.gyro.tolist() for one in expected]


def test_readings_and_poses_of_the_last_two_seconds_are_kept():
    rover = rover_at_rest()
    rover.drive((4.0, 6.0))
    readings = rover.imu(START + 5_000 * MS)
    assert [readings[0].stamp, len(readings)] == [START + 3_000 * MS + 5 * MS // 2, 2000 // 5]
    assert rover.has_poses_since(START + 3_000 * MS)
    assert not rover.has_poses_since(START + 3_000 * MS - 1)


def test_after_a_long_pause_the_rover_stands_and_poses_from_before_it_are_forgotten():
    rover = rover_at_rest()
    rover.drive((5.0, 5.0))
    rover.advance(START + 900 * MS)
    before = rover.pose
    rover.advance(START + 60_000 * MS)
    assert rover.pose == before
    assert rover.joints(START + 60_000 * MS).velocities == pytest.approx([0.0, 0.0], abs=0.0)
    assert [rover.has_poses_since(START + elapsed * MS) for elapsed in (900, 60_000)] == [False, True]
    with pytest.raises(InvalidInput, match="has poses of the 0 s until"):
        rover.poses([START + 900 * MS])


def test_it_is_a_driver_that_drives_a_square_until_it_is_enabled():
    rover = rover_at_rest(slip=0.02)
    square = SquareDrive(WHEELS)

    def autopilot(stamp: int) -> tuple[float, float]:
        return WHEELS.roll(*tracking_twist(square.state(stamp - START), rover.pose))

    wheels: Driver = SimulatedWheels(rover, ("l", "r"), autopilot)
    for tick in range(1, 1601):
        wheels.read(START + 10 * tick * MS)
    expected = square.state(16_000 * MS)
    assert rover.pose[:2] == pytest.approx((expected.x, expected.y), abs=0.05)
    assert math.remainder(rover.pose.yaw, math.tau) == pytest.approx(0.0, abs=0.1)
    with pytest.raises(InvalidInput, match="enabled"):
        wheels.write(Setpoint(0, np.zeros(2), np.ones(2)))
    wheels.enable(True)
    wheels.write(Setpoint(0, np.zeros(2), np.array([2.0, -2.0])))
    reading = wheels.read(START + 17_000 * MS)
    assert reading is not None
    assert reading.velocities == pytest.approx([2.0, -2.0], abs=1e-6)
    wheels.stop("hold")
    reading = wheels.read(START + 18_000 * MS)
    assert reading is not None
    assert reading.velocities == pytest.approx([0.0, 0.0], abs=1e-6)
