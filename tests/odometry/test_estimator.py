"""BaseEstimator: consistent in simulated runs, the same for any order of arrival, robust against a source."""

import math
from typing import Any

import numpy as np
import pytest
from helpers.base_motion import (
    NOISE,
    START,
    WHEEL_HZ,
    Motion,
    NoisyImu,
    RoughDrive,
    mounted,
    stamp_at,
    tilted_mount,
)

from zstate import InFuture, InvalidInput, NoData, Transform, UnknownFrame, se3
from zstate.model.load import load_model
from zstate.odometry import BaseEstimator, BaseState, DiffDrive, ImuNoise, SourceHealth
from zstate.odometry.health import chi_square_quantile
from zstate.odometry.invariant_filter import Floats
from zstate.odometry.legs import ForceThresholds, Legs, SpeedThresholds

SIGMA = 0.02
LEVEL = Transform("base_link", "imu_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
WHEELS = DiffDrive("left", "right", radius=0.1, track=0.4)


def estimator(mount: Transform = LEVEL, **options: Any) -> BaseEstimator:
    buffer = mounted(mount)
    return BaseEstimator(
        odom="odom", base="base_link", imu="imu_link", buffer=buffer, imu_noise=NOISE, **options
    )


Call = tuple[float, str, tuple[Any, ...]]


def calls_of(seed: int, seconds: float) -> tuple[Motion, list[Call]]:
    """A motion in 3D, and calls of an estimator with their times, in the order of their stamps."""
    motion, random = Motion(seed), np.random.default_rng(seed)
    times, gyro, accel = NoisyImu(motion, tilted_mount(), seconds, random).samples()
    wheel_times = np.arange(0.0025, seconds - 0.01, 1.0 / WHEEL_HZ)
    linear = motion.velocity(wheel_times) + random.normal(0.0, SIGMA, (len(wheel_times), 3))
    calls: list[Call] = [(t, "imu", (g, a)) for t, g, a in zip(times.tolist(), gyro, accel, strict=True)]
    calls += [(t, "velocity", (v,)) for t, v in zip(wheel_times.tolist(), linear, strict=True)]
    return motion, sorted(calls, key=lambda call: call[0])


def feed(base: BaseEstimator, calls: list[Call], **options: Any) -> None:
    for t, kind, values in calls:
        if kind == "imu":
            base.imu(stamp_at(t), *values)
        else:
            base.velocity(stamp_at(t), *values, sigma=[SIGMA] * 3, scale=0.0, **options)


def late(calls: list[Call], kind: str, seed: int) -> list[Call]:
    """The calls as they arrive if those of ``kind`` are up to 0.3 s late, and out of order."""
    random = np.random.default_rng(seed)
    delays = {id(call): random.uniform(0.0, 0.3) if call[1] == kind else 0.0 for call in calls}
    return sorted(calls, key=lambda call: call[0] + delays[id(call)])


def squared_errors(motion: Motion, state: BaseState) -> tuple[float, float, float]:
    """The normalised squared errors of position, attitude and velocity: chi-square with 3 degrees each."""
    at = np.array([(state.stamp - START) * 1e-9])
    (rotation,), (velocity,), (position,) = motion.truth(at)
    estimated = state.odom_from_base.matrix
    turn = se3.quaternion_from_matrix(rotation @ estimated[:3, :3].T)
    errors = (
        (position - estimated[:3, 3], state.covariance.pose[:3, :3]),
        (np.array(se3.rotation_vector(turn, se3.SCALARS)), state.covariance.pose[3:, 3:]),
        (rotation.T @ velocity - state.twist.linear, state.covariance.twist[:3, :3]),
    )
    position_nees, attitude, speed = (
        float(error @ np.linalg.solve(covariance, error)) for error, covariance in errors
    )
    return position_nees, attitude, speed


def health_of(base: BaseEstimator, name: str) -> SourceHealth:
    return next(health for health in base.health() if health.name == name)


@pytest.mark.long
@pytest.mark.parametrize("runs", [5, pytest.param(25, marks=pytest.mark.soak)])
def test_errors_are_as_large_as_their_covariances_with_a_source_late_and_shuffled(runs: int):
    """Runs of 5 s in 3D, from rest, with a turned IMU."""
    errors: list[tuple[float, float, float]] = []
    for seed in range(runs):
        motion, calls = calls_of(seed, 5.0)
        base = estimator(tilted_mount())
        feed(base, late(calls, "velocity", seed))
        errors.append(squared_errors(motion, base.state()))
        assert health_of(base, "wheels").too_late == 0
    low, high = (chi_square_quantile(p, 3 * runs) / runs for p in (0.001, 0.999))
    position, attitude, speed = np.mean(errors, axis=0).tolist()
    assert low < attitude < high
    assert low < speed < high
    # The pose is continuous: the square by which the estimate differs from it is in its covariance as well,
    # which is an upper limit.
    assert 0.8 * low < position < high


def test_the_rate_of_a_twist_has_the_noise_of_one_sample():
    noise = ImuNoise(gyro=5e-3, accel=2e-2, gyro_bias=0.0, accel_bias=0.0, gyro_scale=0.0)
    base = BaseEstimator(
        odom="odom", base="base_link", imu="imu_link", buffer=mounted(LEVEL), imu_noise=noise
    )
    for number in range(300):
        base.imu(stamp_at(number / 200), [0.0] * 3, [0.0, 0.0, 9.80665])
    # A density of 5e-3 is a variance of 5e-3^2 * 200 in a sample at 200 Hz; the bias adds 0.01^2.
    variances = np.diag(base.state().covariance.twist)[3:]
    np.testing.assert_allclose(variances, 5e-3**2 * 200 + 0.01**2, rtol=0.01)


@pytest.mark.long
def test_the_order_of_arrival_does_not_matter_nor_when_states_are_read():
    _, calls = calls_of(1, 4.0)
    in_order, shuffled = estimator(tilted_mount()), estimator(tilted_mount())
    feed(in_order, calls)
    for number, call in enumerate(late(late(calls, "velocity", 1), "imu", 2)):
        feed(shuffled, [call])
        if number % 50 == 0 and number > 300:
            shuffled.state()
    for at in (None, stamp_at(3.7)):
        one, other = in_order.state(at), shuffled.state(at)
        assert one.stamp == other.stamp
        np.testing.assert_allclose(one.odom_from_base.pose7, other.odom_from_base.pose7, atol=1e-9)
        np.testing.assert_allclose(one.covariance.pose, other.covariance.pose, atol=1e-9)
        np.testing.assert_allclose(one.twist, other.twist, atol=1e-9)


def test_a_late_sample_of_the_rest_at_the_start_aligns_the_base_once_more():
    _, calls = calls_of(1, 0.9)
    late_one = next(call for call in calls if call[0] > 0.2 and call[1] == "imu")
    in_order, aligned_before = estimator(tilted_mount()), estimator(tilted_mount())
    feed(in_order, calls)
    feed(aligned_before, [call for call in calls if call is not late_one])
    without = aligned_before.state()
    feed(aligned_before, [late_one])
    expected, found = in_order.state(), aligned_before.state()
    np.testing.assert_allclose(found.gyro_bias, expected.gyro_bias, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        found.odom_from_base.pose7, expected.odom_from_base.pose7, rtol=0.0, atol=1e-12
    )
    assert np.abs(without.gyro_bias - expected.gyro_bias).max() > 1e-9


def test_events_older_than_the_history_are_counted_and_change_nothing():
    _, calls = calls_of(2, 3.0)
    base = estimator(tilted_mount(), history_s=0.5)
    feed(base, calls)
    before = base.state().odom_from_base
    base.velocity(stamp_at(2.0), [9.0, 0.0, 0.0], sigma=[SIGMA] * 3)
    assert base.state().odom_from_base == before
    wheels = health_of(base, "wheels")
    assert wheels.too_late == 1
    assert "raise history_s" in wheels.sentence


def drive(
    base: BaseEstimator,
    seconds: float,
    *,
    speed: float = 0.0,
    yaw_rate: float = 0.0,
    start: float = 0.0,
    imu: bool = True,
    wheels: bool = True,
    slip: float = 0.0,
    gyro_bias: float = 0.0,
) -> float:
    """A base on the floor at constant velocity: IMU at 100 Hz, wheels at 50 Hz. Returns the end."""
    for step in range(round(seconds * 100)):
        t = start + 0.01 * step
        if imu:
            base.imu(stamp_at(t), (0.0, 0.0, yaw_rate + gyro_bias), (0.0, speed * yaw_rate, 9.80665))
        if wheels and step % 2:
            linear, angular = [speed + slip, 0.0, 0.0], [0.0, 0.0, yaw_rate]
            base.velocity(stamp_at(t), linear, sigma=[SIGMA] * 3, angular=angular)
    return start + seconds


def test_wheels_that_slip_are_rejected_and_reported():
    base = estimator()
    t = drive(base, 3.0)
    t = drive(base, 1.0, start=t, slip=1.0)
    state = base.state()
    assert state.odom_from_base.translation[0] < 0.1  # 1 m by the wheels
    wheels = health_of(base, "wheels")
    assert wheels.rejected >= 45
    assert "were rejected" in wheels.sentence


@pytest.mark.parametrize(("seconds", "is_lost"), [(1.02, False), (1.04, True)])
def test_a_source_that_is_rejected_for_more_than_a_second_is_said_to_be_lost(seconds: float, is_lost: bool):
    """The wheels are read each 20 ms, at first 10 ms after the begin of their slip."""
    base = estimator()
    t = drive(base, 3.0)
    drive(base, seconds, start=t, slip=1.0)
    sentence = health_of(base, "wheels").sentence
    assert ("rejected for 1.0 s in a row: the estimate is lost" in sentence) == is_lost
    assert ("in a row" in sentence) == is_lost


def test_a_source_that_contradicts_for_seconds_is_followed_at_last():
    base = estimator()
    t = drive(base, 3.0)
    drive(base, 6.0, start=t, slip=1.0)
    assert health_of(base, "wheels").reacquired >= 1
    assert base.state().twist.linear[0] == pytest.approx(1.0, abs=0.1)


def test_a_gyro_at_rest_measures_its_bias():
    base = estimator()
    drive(base, 8.0, gyro_bias=0.012)
    state = base.state()
    assert state.gyro_bias[2] == pytest.approx(0.012, abs=1e-4)
    assert abs(state.odom_from_base.rpy[2]) < 1e-3  # 0.1 rad without it
    assert health_of(base, "standstill").accepted > 10
    assert health_of(base, "standstill").rate_hz == pytest.approx(10.0)


def test_without_imu_the_wheels_predict_and_the_state_is_marked():
    base = estimator()
    t = drive(base, 3.0)
    t = drive(base, 2.0, start=t, speed=0.5, yaw_rate=0.3)
    assert not base.state().is_coasting
    before = base.state()
    drive(base, 1.0, start=t, speed=0.5, yaw_rate=0.3, imu=False)
    state = base.state()
    assert state.is_coasting
    moved = before.odom_from_base.inverse() @ state.odom_from_base
    assert moved.translation[0] == pytest.approx(0.5 / 0.3 * math.sin(0.3), abs=0.05)
    assert moved.rpy[2] == pytest.approx(0.3, abs=0.03)
    assert state.covariance.pose[5, 5] > 10 * before.covariance.pose[5, 5]
    assert "silent" in health_of(base, "imu").sentence


def test_a_turn_while_all_sources_are_silent_is_inside_the_claim():
    base = estimator()
    t = drive(base, 3.0)
    t = drive(base, 2.0, start=t, speed=0.5)
    gap_s, yaw_rate = 0.4, 0.9
    drive(base, 1.0, start=t + gap_s, speed=0.5, yaw_rate=yaw_rate)
    state = base.state()
    error = yaw_rate * (gap_s + 1.0) - state.odom_from_base.rpy[2]
    assert error == pytest.approx(yaw_rate * gap_s, abs=0.05)  # nothing measured it
    assert abs(error) < 3.0 * math.sqrt(state.covariance.pose[5, 5])


def test_no_state_is_later_than_half_a_second_after_the_newest_event():
    base = estimator()
    drive(base, 2.0)
    base.state(stamp_at(2.4))
    with pytest.raises(InFuture, match="coast"):
        base.state(stamp_at(2.6))


def test_before_alignment_the_state_is_an_error_with_what_is_missing():
    base = estimator()
    with pytest.raises(NoData, match="no samples of the IMU"):
        base.state()
    drive(base, 0.2)
    with pytest.raises(NoData, match=r"0\.5 s at rest"):
        base.state()


def test_an_even_turn_from_the_first_sample_on_is_no_bias_of_the_gyro():
    base = estimator()
    drive(base, 3.0, speed=0.3, yaw_rate=0.06)
    assert base.state().odom_from_base.rpy[2] == pytest.approx(0.06 * 2.99, abs=1e-3)


def test_gravity_is_found_through_a_turned_mount():
    """An IMU upside down and turned, at rest: the base is level, at the origin, with the yaw zero."""
    mount = tilted_mount()
    base = estimator(mount)
    force = mount.matrix[:3, :3].T @ (0.0, 0.0, 9.80665)
    for step in range(100):
        base.imu(stamp_at(0.01 * step), (0.0, 0.0, 0.0), force)
        base.velocity(stamp_at(0.01 * step), (0.0, 0.0, 0.0), sigma=[SIGMA] * 3)
    pose = base.state().odom_from_base
    np.testing.assert_allclose(pose.rpy, 0.0, atol=1e-6)
    np.testing.assert_allclose(pose.translation, 0.0, atol=1e-6)


def test_wheels_from_joints_drive_a_line_in_any_order_of_readings():
    rates = WHEELS.joint_velocities([0.5, 0.0, 0.0], [0.0, 0.0, 0.0])
    states: list[BaseState] = []
    for groups in (1, 3):
        base = estimator(wheels=WHEELS, history_s=5.0)
        drive(base, 3.0, speed=0.5, wheels=False)
        readings = [(0.02 * i, {name: rate * 0.02 * i for name, rate in rates.items()}) for i in range(150)]
        # With three groups, every third reading comes first: two thirds divide a displacement.
        for group in range(groups):
            for t, positions in readings[group::groups]:
                base.joints(stamp_at(t), positions)
        states.append(base.state(stamp_at(2.9)))
    first, second = states
    np.testing.assert_array_equal(first.odom_from_base.pose7, second.odom_from_base.pose7)
    np.testing.assert_allclose(first.twist.linear, (0.5, 0.0, 0.0), atol=0.01)
    assert first.odom_from_base.translation[0] == pytest.approx(0.5 * 2.9, abs=0.01)


LEG = """<link name="leg{0}"/><link name="foot{0}"/>
  <joint name="slide{0}" type="prismatic"><parent link="base_link"/><child link="leg{0}"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="sole{0}" type="fixed"><parent link="leg{0}"/><child link="foot{0}"/>
    <origin xyz="0 {0} -0.4"/></joint>"""
LEGGED = f'<robot name="slider"><link name="base_link"/>{LEG.format(1)}{LEG.format(2)}</robot>'


def test_feet_on_the_ground_push_the_base_forward():
    """Feet that slide back by 0.2 m under the base, and stay where they are: 0.1 m/s, reached in 0.2 s."""
    legs = Legs(load_model(LEGGED), ["foot1", "foot2"], imu="base_link")
    base = estimator(legs=legs)
    base.contacts(START, {"foot1": True, "foot2": True})
    for step in range(411):
        t = 0.01 * step
        moved_s = max(0.0, t - 2.0)
        pushed_s = min(moved_s, 0.2)
        base.imu(stamp_at(t), (0.0, 0.0, 0.0), (0.5 * (0.0 < moved_s < 0.2), 0.0, 9.80665))
        slid = 0.25 * pushed_s**2 + 0.1 * (moved_s - pushed_s)
        base.joints(stamp_at(t), dict.fromkeys(legs.joint_names, -slid))
    assert base.state().odom_from_base.translation[0] == pytest.approx(0.2, abs=0.01)
    assert health_of(base, "feet").accepted > 380


@pytest.mark.long
def test_a_robot_that_stands_on_all_feet_measures_the_bias_of_its_gyro():
    legs = Legs(load_model(LEGGED), ["foot1", "foot2"], imu="base_link")
    base = estimator(legs=legs)
    base.contacts(START, {"foot1": True, "foot2": True})
    random = np.random.default_rng(3)
    for step in range(1200):
        t = 0.01 * step
        base.imu(
            stamp_at(t), random.normal((0.0, 0.0, 0.01), 0.002), random.normal((0.0, 0.0, 9.80665), 0.02)
        )
        positions = random.normal(0.0, 0.001, len(legs.joint_names)).tolist()
        base.joints(stamp_at(t), dict(zip(legs.joint_names, positions, strict=True)))
    state = base.state()
    assert state.gyro_bias[2] == pytest.approx(0.01, abs=0.001)
    assert abs(state.odom_from_base.rpy[2]) < 0.01
    assert math.sqrt(state.covariance.pose[5, 5]) < 0.05
    assert health_of(base, "standstill").accepted > 100


def wander(compass: bool, hard_iron: float) -> tuple[float, float, BaseEstimator]:
    """The yaw error [rad] and its sigma after 45 s of turns, with a compass if any."""
    base = estimator()
    random = np.random.default_rng(5)
    yaw, t = 0.0, 0.0
    for step in range(45 * 50):
        t = 0.02 * step
        rate = 0.0 if t < 2.0 else 0.4 * math.sin(0.1 * t) + 0.2
        speed = 0.0 if t < 2.0 else 0.5
        gyro = np.array([0.0, 0.0, rate + 0.002]) + random.normal(0.0, 1e-3 * math.sqrt(50), 3)
        base.imu(stamp_at(t), gyro, (0.0, speed * rate, 9.80665))
        if step % 2:
            linear = np.array([speed, 0.0, 0.0]) + random.normal(0.0, SIGMA, 3)
            base.velocity(stamp_at(t), linear, sigma=[SIGMA] * 3, angular=(0.0, 0.0, rate))
        if compass and step % 5 == 0:
            measured = yaw + 1.0 + hard_iron * math.sin(yaw + 0.5)
            base.heading(stamp_at(t), measured, 0.03, source="compass")
        yaw += rate * 0.02
    state = base.state()
    error = math.remainder(state.odom_from_base.rpy[2] - yaw, math.tau)
    return error, math.sqrt(state.covariance.pose[5, 5]), base


@pytest.mark.long
def test_a_compass_with_hard_iron_of_35_degrees_is_no_worse_than_none():
    without, _, _ = wander(compass=False, hard_iron=0.0)
    error, sigma, base = wander(compass=True, hard_iron=math.radians(35.0))
    assert abs(error) < abs(without) + 0.5 * sigma
    assert abs(error) < 3.0 * sigma
    # Its readings are weighted by its deviation, which is in the gate too: none of them is rejected.
    compass = health_of(base, "compass")
    assert (compass.accepted, compass.rejected) == (450, 0)
    assert "off by about 35 degrees as the base moves" in compass.sentence


def drive_roughly(seed: int, *, compass: bool) -> tuple[float, list[float], float]:
    """The distance of the end from the truth, squared normalised errors of x and y each 5 s, and the distance
    by dead reckoning."""
    drive = RoughDrive(seed, 60.0)
    wheels = DiffDrive("left", "right", radius=drive.radius, track=drive.track)
    noise = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
    base = BaseEstimator(
        odom="odom", base="base_link", imu="imu_link", buffer=mounted(drive.mount), imu_noise=noise,
        wheels=wheels,
    )  # fmt: skip
    squares, place = list[float](), 0
    error: Floats = np.zeros(2)
    for row, (left, right) in enumerate(drive.wheels.tolist()):
        t = 0.1 * row
        while place < len(drive.imu_times) and drive.imu_times[place] <= t:
            base.imu(stamp_at(float(drive.imu_times[place])), drive.gyro[place], drive.accel[place])
            place += 1
        base.joints(stamp_at(t), {"left": left, "right": right})
        if compass:
            base.heading(stamp_at(t), float(drive.compass[row]), 0.05, source="compass")
        if row >= 50 and row % 50 == 0:
            state = base.state(stamp_at(t))
            error = drive.position[10 * row] - np.array(state.odom_from_base.translation[:2])
            squares.append(float(error @ np.linalg.solve(state.covariance.pose[:2, :2], error)))
    last = 10 * (len(drive.wheels) - 1)
    reckoned = float(np.linalg.norm(drive.dead_reckoned() - drive.position[last]))
    return float(np.linalg.norm(error)), squares, reckoned


@pytest.mark.long
@pytest.mark.parametrize("drives", [1, pytest.param(2, marks=pytest.mark.soak)])
def test_a_rough_drive_is_inside_its_claim_with_a_bad_compass_and_better_than_dead_reckoning(drives: int):
    runs = [drive_roughly(seed, compass=compass) for seed in range(drives) for compass in (False, True)]
    errors, squares, reckoned = zip(*runs, strict=True)
    # 99.7 % of the chi-square distribution of two degrees of freedom are below 11.8: three sigma.
    assert max(nees[-1] for nees in squares) < 11.8
    assert np.mean(squares) < 3.0  # 2 is expected
    assert sum(errors) < sum(reckoned)
    with_compass, without = sum(errors[1::2]), sum(errors[::2])
    assert with_compass < 1.1 * without


@pytest.mark.parametrize(
    "covariance",
    [np.zeros((3, 3)), -np.eye(3), np.eye(2), np.full((3, 3), math.nan), np.eye(3) + np.eye(3, k=1)],
    ids=["zero", "negative", "shape", "NaN", "asymmetric"],
)
def test_what_is_no_covariance_is_refused_with_the_name_of_its_source(covariance: Floats):
    with pytest.raises(InvalidInput, match="'gnss'"):
        estimator().velocity(START, [0.0, 0.0, 0.0], covariance=covariance, source="gnss")


def test_measurements_that_are_not_finite_are_refused_with_the_name_of_their_source():
    base = estimator()
    with pytest.raises(InvalidInput, match="gyro of source 'imu'"):
        base.imu(START, (math.nan, 0.0, 0.0), (0.0, 0.0, 9.8))
    with pytest.raises(InvalidInput, match="'compass'"):
        base.heading(START, math.nan, 0.1, source="compass")


def test_the_mount_of_a_sensor_that_is_missing_is_an_unknown_frame_with_near_misses():
    with pytest.raises(UnknownFrame, match="imu_link"):
        BaseEstimator(odom="odom", base="base_link", imu="imu_lnk", buffer=mounted(LEVEL), imu_noise=NOISE)


def test_an_initial_pose_is_where_the_base_is_at_its_first_event_without_rest():
    start = Transform("odom", "base_link", (2.0, -1.0, 0.0), (0.0, 0.0, math.sin(0.4), math.cos(0.4)))
    base = estimator(initial_pose=start)
    drive(base, 2.0, speed=0.5)
    moved = start.inverse() @ base.state().odom_from_base
    assert moved.translation[0] == pytest.approx(0.5 * 1.99, abs=0.05)
    assert moved.rpy[2] == pytest.approx(0.0, abs=0.02)


def test_poses_bound_the_drift_of_wheels():
    """Wheels that are half too fast, 0.2 m in 8 s, and a motion capture at 10 Hz that is good to 1 cm."""
    base = estimator()
    t = drive(base, 2.0)
    for step in range(80):
        drive(base, 0.1, start=t + 0.1 * step, speed=0.05, slip=0.025)
        pose = Transform("odom", "base_link", (0.005 * step, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        base.pose(stamp_at(t + 0.1 * step), pose, 1e-4 * np.eye(6), source="mocap")
    state = base.state()
    assert state.odom_from_base.translation[0] == pytest.approx(0.05 * 7.99, abs=0.03)
    assert state.covariance.pose[0, 0] < 0.01**2
    assert health_of(base, "mocap").accepted == 80


@pytest.mark.long
def test_of_two_headings_that_disagree_the_worse_one_is_named():
    """A base that turns by 0.5 rad/s, and two compasses, of which one has a hard iron of 0.5 rad."""
    base, random = estimator(), np.random.default_rng(3)
    drive(base, 2.0)
    for step in range(200):
        t = 2.0 + 0.1 * step
        yaw = 0.05 * step
        drive(base, 0.1, start=t, yaw_rate=0.5)
        base.heading(stamp_at(t), yaw + 1.0 + random.normal(0.0, 0.02), 0.02, source="good")
        base.heading(stamp_at(t), yaw + 0.5 * math.sin(yaw), 0.02, source="bad")
    good, bad = health_of(base, "good"), health_of(base, "bad")
    assert bad.nis_mean > 10.0 * good.nis_mean
    assert good.rejected == 0
    assert "off by about" in bad.sentence
    assert "sigmas are about" in bad.sentence
    assert base.state().odom_from_base.rpy[2] == pytest.approx(
        math.remainder(0.5 * 19.99, math.tau), abs=0.03
    )


def test_wheels_that_spin_on_the_spot_are_rejected_and_reported():
    """For a second both wheels of a standing base turn with 0.8 m/s."""
    base = estimator(wheels=WHEELS, history_s=5.0)
    rate, angle = WHEELS.joint_velocities([0.8, 0.0, 0.0], [0.0, 0.0, 0.0])["left"], 0.0
    drive(base, 4.0, wheels=False)
    for step in range(200):
        angle += 0.02 * rate * (step >= 150)
        base.joints(stamp_at(0.02 * step), {"left": angle, "right": angle})
    assert base.state().odom_from_base.translation[0] < 0.1
    wheels = health_of(base, "wheels")
    assert wheels.rejected >= 40
    assert "were rejected" in wheels.sentence


@pytest.mark.parametrize("detection", [ForceThresholds(40.0, 20.0), SpeedThresholds(0.1, 0.2)])
def test_feet_that_are_detected_on_the_ground_push_the_base_forward(
    detection: ForceThresholds | SpeedThresholds,
):
    """One foot carries 50 N and slides back by 0.2 m under the base, the other swings ahead at 0.5 m/s."""
    legs = Legs(load_model(LEGGED), ["foot1", "foot2"], imu="base_link", detection=detection)
    base = estimator(legs=legs)
    for step in range(401):
        t = 0.01 * step
        moves = max(0.0, t - 2.0)
        base.imu(stamp_at(t), (0.0, 0.0, 0.0), (0.0, 0.0, 9.80665))
        base.joints(
            stamp_at(t),
            {"slide1": -0.1 * moves, "slide2": 0.5 * moves},
            velocities={"slide1": -0.1 * (moves > 0.0), "slide2": 0.5 * (moves > 0.0)},
            efforts={"slide1": 50.0, "slide2": 50.0 * (moves == 0.0)},
        )
    # The slip of one foot for 2 s has a sigma of 0.014 m.
    assert base.state().odom_from_base.translation[0] == pytest.approx(0.2, abs=0.03)


def test_a_replay_of_the_same_calls_is_the_same_bit_for_bit_whenever_states_are_read():
    _, calls = calls_of(4, 3.0)
    live, replayed = estimator(tilted_mount()), estimator(tilted_mount())
    for call in calls:
        feed(live, [call])
        if call[0] > 2.0:
            live.state()
    feed(replayed, calls)
    one, other = live.state(), replayed.state()
    assert one.odom_from_base.pose7.tobytes() == other.odom_from_base.pose7.tobytes()
    assert one.covariance.pose.tobytes() == other.covariance.pose.tobytes()
    assert one.covariance.twist.tobytes() == other.covariance.twist.tobytes()
    assert repr(live.health()) == repr(replayed.health())  # NaN equals NaN
