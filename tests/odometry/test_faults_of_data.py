"""BaseEstimator goes on: events that cannot be fused, stamps of another time, absurd numbers, duplicates."""

import math
from typing import Any

import numpy as np
import pytest
from helpers.base_motion import NOISE, mounted, stamp_at

from zstate import InvalidInput, NoData, Transform
from zstate.model.load import load_model
from zstate.odometry import BaseEstimator, DiffDrive, SourceHealth
from zstate.odometry.legs import Legs, SpeedThresholds

LEVEL = Transform("base_link", "imu_link", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
SIGMAS = [0.02] * 3
HOUR = 3600.0
LEG = """<link name="leg{0}"/><link name="foot{0}"/>
  <joint name="slide{0}" type="prismatic"><parent link="base_link"/><child link="leg{0}"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="sole{0}" type="fixed"><parent link="leg{0}"/><child link="foot{0}"/>
    <origin xyz="0 {0} -0.4"/></joint>"""
LEGGED = f'<robot name="slider"><link name="base_link"/>{LEG.format(1)}{LEG.format(2)}</robot>'


def estimator(**options: Any) -> BaseEstimator:
    return BaseEstimator(
        odom="odom", base="base_link", imu="imu_link", buffer=mounted(LEVEL), imu_noise=NOISE, **options
    )


def health_of(base: BaseEstimator, name: str) -> SourceHealth:
    return next(one for one in base.health() if one.name == name)


def imu(base: BaseEstimator, t: float, accel: tuple[float, float, float] = (0.0, 0.0, 9.80665)) -> None:
    base.imu(stamp_at(t), (0.0, 0.0, 0.0), accel)


def drive(
    base: BaseEstimator,
    start: float,
    end: float,
    speed: float = 0.0,
    *,
    before: float = 0.0,
    wheels_ahead: float = 0.0,
) -> None:
    """IMU at 100 Hz and wheels at 50 Hz, of a base that goes from one speed to another with 1 m/s^2."""
    for step in range(round((end - start) * 100)):
        t = start + 0.01 * step
        is_faster = before + t - start < speed
        imu(base, t, (1.0 * is_faster, 0.0, 9.80665))
        if step % 2:
            linear = [before + t - start if is_faster else speed, 0.0, 0.0]
            base.velocity(stamp_at(t + wheels_ahead), linear, sigma=SIGMAS, angular=[0, 0, 0])


def x_of(base: BaseEstimator) -> float:
    return float(base.state().odom_from_base.translation[0])


# One event that fails


def test_heading_of_a_frame_that_points_up_is_rejected_with_its_reason_and_nothing_else():
    up = Transform.from_rpy("odom", "base_link", (0.0, 0.0, 0.0), (0.0, -math.pi / 2, 0.0))
    base = estimator(initial_pose=up)
    for step in range(100):
        imu(base, 0.01 * step, (9.80665, 0.0, 0.0))
        base.heading(stamp_at(0.01 * step), 0.3, 0.05, source="compass")
    assert base.state().stamp == stamp_at(0.99)
    compass = health_of(base, "compass")
    assert compass.rejected == 100
    assert "could not be used" in compass.sentence
    assert "no heading" in compass.sentence


def test_joints_from_before_the_first_contacts_are_rejected_with_their_reason():
    """Contacts are measured from the first call on, so that joints without velocities are accepted."""
    feet = ("foot1", "foot2")
    legs = Legs(load_model(LEGGED), feet, imu="base_link", detection=SpeedThresholds(0.2, 0.4))
    base = estimator(legs=legs)
    for step in range(100):
        imu(base, 0.01 * step)
    base.contacts(stamp_at(0.9), dict.fromkeys(feet, True))
    base.joints(stamp_at(0.8), dict.fromkeys(legs.joint_names, 0.0))
    base.joints(stamp_at(0.95), dict.fromkeys(legs.joint_names, 0.0))
    assert base.state().stamp == stamp_at(0.99)
    assert "could not be used: no velocity of" in health_of(base, "feet").sentence


@pytest.mark.parametrize("sigma", [1e-9, 1e9])
def test_sigmas_of_sensors_are_1e_9_to_1e9(sigma: float):
    further = sigma**1.0001
    estimator().heading(stamp_at(0.0), 0.1, sigma, source="compass")
    estimator().velocity(stamp_at(0.0), [0, 0, 0], sigma=[sigma] * 3)
    with pytest.raises(InvalidInput, match="'compass'"):
        estimator().heading(stamp_at(0.0), 0.1, further, source="compass")
    with pytest.raises(InvalidInput, match="'wheels'"):
        estimator().velocity(stamp_at(0.0), [0, 0, 0], sigma=[further] * 3)


@pytest.mark.parametrize("sigma", [1e300, 1e-300, 0.0, math.nan])
def test_sigmas_that_no_sensor_has_are_refused(sigma: float):
    base = estimator()
    with pytest.raises(InvalidInput, match="'compass'"):
        base.heading(stamp_at(0.0), 0.1, sigma, source="compass")
    with pytest.raises(InvalidInput, match="'wheels'"):
        base.velocity(stamp_at(0.0), [0, 0, 0], sigma=[sigma] * 3)
    with pytest.raises(InvalidInput, match="'wheels'"):
        base.velocity(stamp_at(0.0), [0, 0, 0], covariance=np.eye(3) * sigma)
    pose = Transform("odom", "base_link", (0, 0, 0), (0, 0, 0, 1))
    with pytest.raises(InvalidInput, match="'mocap'"):
        base.pose(stamp_at(0.0), pose, np.eye(6) * sigma, source="mocap")


# Absurd numbers


@pytest.mark.parametrize("value", [1e154, 1e200, 1e308, -2e5])
def test_absurd_samples_of_the_imu_are_refused_and_change_nothing(value: float):
    base = estimator()
    drive(base, 0.0, 2.0)
    before = base.state()
    with pytest.raises(InvalidInput, match="gyro"):
        base.imu(stamp_at(2.0), (value, 0, 0), (0, 0, 9.8))
    with pytest.raises(InvalidInput, match="accel"):
        base.imu(stamp_at(2.0), (0, 0, 0), (value, 0, 9.8))
    with pytest.raises(InvalidInput, match="velocity"):
        base.velocity(stamp_at(2.0), [value, 0, 0], sigma=SIGMAS)
    assert base.state().odom_from_base == before.odom_from_base


def test_estimate_that_is_not_finite_starts_again_from_its_last_pose_with_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
):
    base = estimator()
    drive(base, 0.0, 2.0)
    drive(base, 2.0, 4.0, 0.5)
    before = base.state().odom_from_base
    whole = type(base._fusion).predicted  # pyright: ignore[reportPrivateUsage]

    def infinite(self: Any, *args: Any) -> Any:
        estimate = whole(self, *args)
        return estimate._replace(state=estimate.state._replace(covariance=np.full((15, 15), np.inf)))

    with monkeypatch.context() as patched:
        patched.setattr(type(base._fusion), "predicted", infinite)  # pyright: ignore[reportPrivateUsage]
        imu(base, 4.0)
        state = base.state()
    assert state.odom_from_base.pose7 == pytest.approx(before.pose7, abs=1e-6)
    assert "started again from its last pose" in health_of(base, "imu").sentence
    drive(base, 4.01, 6.01, 0.5, before=0.5)
    assert x_of(base) == pytest.approx(before.translation[0] + 1.0, abs=0.1)


def test_accelerometer_that_reads_zeros_at_first_is_named_and_then_aligned():
    base = estimator()
    for step in range(300):
        imu(base, 0.01 * step, (0.0, 0.0, 0.0))
    with pytest.raises(NoData, match="the accelerometer reads 0"):
        base.state()
    drive(base, 3.0, 5.0)
    state = base.state()
    assert np.isfinite(state.covariance.pose).all()
    assert abs(state.odom_from_base.rpy[0]) < 0.01


def test_accelerometer_in_units_of_g_is_named():
    base = estimator()
    for step in range(300):
        imu(base, 0.01 * step, (0.0, 0.0, 1.0))
    with pytest.raises(NoData, match="not g"):
        base.state()


# Stamps


@pytest.mark.parametrize("source", ["imu", "wheels"])
def test_a_reading_of_the_future_is_refused_and_the_others_go_on(source: str):
    base = estimator()
    drive(base, 0.0, 2.0)
    if source == "imu":
        imu(base, 2.0 + HOUR)
    else:
        base.velocity(stamp_at(2.0 + HOUR), [0.0, 0.0, 0.0], sigma=SIGMAS)
    drive(base, 2.0, 4.0, 0.5)
    assert base.state().stamp == stamp_at(3.99)
    found = health_of(base, source)
    assert "1 reading of the future refused" in found.sentence
    assert found.too_late == 0
    assert base.epoch == 0


def test_joints_of_the_future_are_refused_and_the_others_go_on():
    wheels = DiffDrive("left", "right", radius=0.1, track=0.4)
    base = estimator(wheels=wheels)
    for step in range(400):
        imu(base, 0.01 * step)
        base.joints(stamp_at(0.01 * step), {"left": 0.0, "right": 0.0})
        if step == 200:
            base.joints(stamp_at(HOUR), {"left": 0.0, "right": 0.0})
    assert base.state().stamp == stamp_at(3.99)
    assert "its clock is ahead" in health_of(base, "wheels").sentence


def test_a_first_reading_of_the_future_does_not_stop_the_others():
    base = estimator()
    base.velocity(stamp_at(HOUR), [0.0, 0.0, 0.0], sigma=SIGMAS)
    drive(base, 0.0, 3.0)
    assert base.state().stamp == stamp_at(2.99)


@pytest.mark.parametrize(("ahead", "text"), [(1.1, "1.1 s"), (2.5, "2.5 s"), (HOUR, "3600.0 s")])
def test_wheels_whose_clock_is_ahead_do_not_stop_the_imu_and_are_named(ahead: float, text: str):
    base = estimator()
    drive(base, 0.0, 5.0, wheels_ahead=ahead)
    assert base.state().stamp == stamp_at(4.99)
    sentence = health_of(base, "wheels").sentence
    assert f"stamped {text} after the newest of the others: its clock is ahead" in sentence
    assert "history_s" not in sentence
    imu_health = health_of(base, "imu")
    assert imu_health.too_late == 0


def test_after_a_pause_of_all_sources_the_second_sample_of_the_imu_is_the_present():
    base = estimator()
    drive(base, 0.0, 2.0)
    imu(base, 12.0)
    assert base.state().stamp == stamp_at(1.99)
    imu(base, 12.01)
    assert base.state().stamp == stamp_at(12.01)
    drive(base, 12.02, 14.0)
    assert "all data paused for 10.0 s" in health_of(base, "imu").sentence


def test_without_imu_half_a_second_of_wheels_confirms_a_jump():
    pose = Transform("odom", "base_link", (0, 0, 0), (0, 0, 0, 1))
    base = estimator(initial_pose=pose)

    def wheels(start: float, end: float) -> None:
        for step in range(round((end - start) * 50)):
            base.velocity(stamp_at(start + 0.02 * step), [0.5, 0.0, 0.0], sigma=SIGMAS, angular=[0, 0, 0])

    wheels(0.0, 1.0)
    wheels(5.0, 5.4)
    assert base.state().stamp == stamp_at(0.98)
    wheels(5.4, 6.0)
    assert base.state().stamp == stamp_at(5.98)


def test_time_that_goes_back_is_a_new_epoch_that_starts_anew():
    base = estimator()
    drive(base, 100.0, 102.0)
    drive(base, 102.0, 104.0, 0.5)
    assert x_of(base) > 0.5
    for loop in range(3):
        drive(base, 100.0, 102.0)
        assert base.epoch == loop + 1
        assert base.state().stamp == stamp_at(101.99)
        assert x_of(base) == pytest.approx(0.0, abs=1e-3)
        assert "time went back by" in " ".join(one.sentence for one in base.health())
        drive(base, 102.0, 104.0, 0.5)


def test_a_recording_in_a_loop_gives_the_same_states_each_time():
    base, once = estimator(), estimator()
    drive(once, 100.0, 104.0, 0.0)
    for _ in range(2):
        drive(base, 100.0, 104.0, 0.0)
    assert base.epoch == 1
    assert base.state().odom_from_base == once.state().odom_from_base


def test_stray_old_readings_are_too_late_and_no_epoch():
    base = estimator()
    drive(base, 100.0, 103.0)
    for age in (2.0, 5.0, 50.0, HOUR):
        imu(base, 103.0 - age)
        base.velocity(stamp_at(103.0 - age), [0.0, 0.0, 0.0], sigma=SIGMAS)
    drive(base, 103.0, 104.0)
    assert base.epoch == 0
    assert base.state().stamp == stamp_at(103.99)
    wheels = health_of(base, "wheels")
    assert wheels.too_late == 4
    assert "raise history_s" not in wheels.sentence  # an hour is no delay
    assert "one of the two clocks is wrong" in wheels.sentence


def test_readings_that_are_late_by_a_delay_are_told_to_raise_the_history():
    base = estimator()
    drive(base, 0.0, 3.0)
    base.velocity(stamp_at(1.5), [0.0, 0.0, 0.0], sigma=SIGMAS)
    assert "raise history_s" in health_of(base, "wheels").sentence


# Bounds and duplicates


def test_sources_are_bounded():
    base = estimator()
    with pytest.raises(InvalidInput, match="64 sources"):
        for number in range(100_000):
            base.heading(stamp_at(0.0), 0.1, 0.1, source=f"source {number}")
    assert len(base.health()) == 64


@pytest.mark.long
def test_memory_is_bounded_when_the_imu_never_comes_or_comes_once():
    for samples in (0, 1):
        base = estimator(wheels=DiffDrive("left", "right", radius=0.1, track=0.4))
        for step in range(samples):
            imu(base, 0.01 * step)
        for step in range(20_000):
            base.joints(stamp_at(0.02 * step), {"left": 0.0, "right": 0.0})
        assert len(base._log) < 5000  # pyright: ignore[reportPrivateUsage]
        assert len(base._rotations) < 5000  # pyright: ignore[reportPrivateUsage]


def test_a_flood_of_one_instant_is_refused_in_the_end(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zstate.odometry.estimator._MOST_PER_S", 100)
    base = estimator(history_s=0.1)
    with pytest.raises(InvalidInput, match="too many"):
        for number in range(100_000):
            base.heading(stamp_at(0.0), 1e-6 * number, 0.1, source="compass")


def test_readings_of_another_time_that_wait_are_bounded():
    base = estimator()
    drive(base, 0.0, 1.0)
    for step in range(10_000):
        base.velocity(stamp_at(HOUR + 1e-6 * step), [0.0, 0.0, 0.0], sigma=SIGMAS)
    runs = base._order._runs  # pyright: ignore[reportPrivateUsage]
    assert sum(len(run.held) for run in runs.values()) <= 2000


def test_the_same_message_twice_counts_once():
    once, twice = estimator(), estimator()
    pose = Transform("odom", "base_link", (0.01, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    for base, count in ((once, 1), (twice, 2)):
        drive(base, 0.0, 2.0)
        for _ in range(count):
            imu(base, 2.0)
            base.velocity(stamp_at(2.0), [0.1, 0.0, 0.0], sigma=SIGMAS)
            base.pose(stamp_at(2.0), pose, np.eye(6) * 0.01, source="mocap")
            base.heading(stamp_at(2.0), 0.2, 0.1, source="compass")
    np.testing.assert_array_equal(once.state().covariance.pose, twice.state().covariance.pose)
    assert [(one.name, one.accepted) for one in once.health()] == [
        (one.name, one.accepted) for one in twice.health()
    ]


# The user's own jumps


def test_reset_starts_anew_and_aligns_again():
    base = estimator()
    drive(base, 0.0, 2.0)
    drive(base, 2.0, 4.0, 0.5)
    base.reset()
    assert base.epoch == 1
    with pytest.raises(NoData, match="no samples of the IMU"):
        base.state()
    assert base.health() == ()
    drive(base, 4.0, 6.0)
    assert x_of(base) == pytest.approx(0.0, abs=1e-3)


def test_reset_with_a_pose_starts_there():
    base = estimator()
    drive(base, 0.0, 2.0)
    base.reset(Transform.from_rpy("odom", "base_link", (3.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    drive(base, 2.0, 3.0)
    state = base.state().odom_from_base
    assert state.translation == pytest.approx([3.0, 1.0, 0.0], abs=0.05)
    assert state.rpy[2] == pytest.approx(1.0, abs=0.05)


def test_set_pose_places_the_base_and_keeps_velocity_tilt_and_biases():
    base = estimator()
    drive(base, 0.0, 2.0)
    drive(base, 2.0, 5.0, 0.5)
    before = base.state()
    base.set_pose(Transform.from_rpy("odom", "base_link", (3.0, 1.0, 0.2), (0.4, -0.3, 1.0)))
    state = base.state()
    assert state.odom_from_base.translation == pytest.approx([3.0, 1.0, 0.2], abs=1e-9)
    roll, pitch, yaw = state.odom_from_base.rpy
    assert (roll, pitch) == pytest.approx(before.odom_from_base.rpy[:2], abs=1e-9)
    assert yaw == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(state.twist, before.twist, atol=1e-9)
    np.testing.assert_array_equal(state.gyro_bias, before.gyro_bias)
    np.testing.assert_array_equal(state.accel_bias, before.accel_bias)
    np.testing.assert_allclose(state.covariance.twist, before.covariance.twist, rtol=1e-6, atol=1e-12)
    assert math.sqrt(state.covariance.pose[0, 0]) < 1e-3
    drive(base, 5.0, 7.0, 0.5, before=0.5)
    after = base.state().odom_from_base.translation
    assert after[:2] == pytest.approx([3.0 + math.cos(1.0), 1.0 + math.sin(1.0)], abs=0.03)


def test_set_pose_has_the_covariance_of_its_transform():
    base = estimator()
    drive(base, 0.0, 2.0)
    given = np.diag([0.04, 0.09, 0.01, 1.0, 1.0, 0.02])
    pose = Transform.from_rpy("odom", "base_link", (30.0, 10.0, 0.0), (0.0, 0.0, 1.0))
    base.set_pose(pose.with_covariance(given))
    found = base.state().covariance.pose
    rows = np.ix_([0, 1, 2, 5], [0, 1, 2, 5])
    # The yaw bends the ellipse by a second order term, which is zero for a base that was just placed.
    np.testing.assert_allclose(found[rows], given[rows], atol=1e-6)
    tilt = np.sqrt(found.diagonal()[3:5])
    assert (tilt < 0.03).all()  # of gravity


def test_late_events_from_before_do_not_move_a_pose_that_was_set():
    base = estimator()
    drive(base, 0.0, 3.0)
    base.set_pose(Transform("odom", "base_link", (3.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    base.velocity(stamp_at(2.5), [0.05, 0.0, 0.0], sigma=SIGMAS)
    assert base.state().odom_from_base.translation == pytest.approx([3.0, 1.0, 0.0], abs=1e-9)


def test_a_compass_does_not_pull_back_a_yaw_that_was_set():
    base = estimator()
    for step in range(600):
        imu(base, 0.01 * step)
        base.heading(stamp_at(0.01 * step), 0.7, 0.05, source="compass")
        if step == 300:
            base.set_pose(Transform.from_rpy("odom", "base_link", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    assert base.state().odom_from_base.rpy[2] == pytest.approx(1.0, abs=0.01)


def test_a_pose_cannot_be_set_before_the_alignment_nor_of_other_frames():
    base = estimator()
    with pytest.raises(NoData):
        base.set_pose(Transform("odom", "base_link", (0, 0, 0), (0, 0, 0, 1)))
    with pytest.raises(InvalidInput, match="'map'"):
        base.set_pose(Transform("map", "base_link", (0, 0, 0), (0, 0, 0, 1)))
    with pytest.raises(InvalidInput, match="'map'"):
        base.reset(Transform("map", "base_link", (0, 0, 0), (0, 0, 0, 1)))
