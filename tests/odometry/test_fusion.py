"""The numbers of the guide: when a source is followed, what is rest or shock, how fast the pose moves."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from zstate.odometry.fusion import (
    Displacement,
    Estimate,
    Fusion,
    Heading,
    Inertia,
    Pause,
    Reading,
    imu_remarks,
    is_still,
    odom_pose,
    started,
)
from zstate.odometry.invariant_filter import (
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    ImuNoise,
    Measurement,
    initial_state,
    plain_covariance,
    white_noise,
)
from zstate.odometry.rotations import rotation_exp
from zstate.odometry.turning import Turning

S = 1_000_000_000
WRONG, RIGHT = 50.0, 0.0
FUSION = Fusion(ImuNoise(gyro=1e-3, accel=1e-2, gyro_bias=1e-5, accel_bias=1e-4))


def at_rest(yaw: float = 0.0, yaw_sigma: float = 0.01, sigma: float = 0.01) -> Estimate:
    zero = np.zeros(3)
    covariance = sigma**2 * np.eye(15)
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
        estimate, "compass", Heading(0, measured, SIGMA**2, np.eye(3)[0]), None
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


@pytest.mark.parametrize(("directions", "is_turned"), [(9, False), (10, True)])
def test_the_pose_follows_a_compass_that_was_right_in_ten_of_twelve_directions(
    directions: int, is_turned: bool
):
    estimate = at_rest()
    for number in range(directions):
        yaw = (number + 0.5) * math.tau / 12
        estimate, _ = read(estimate, yaw, yaw, yaw_sigma=1.0 if number else SIGMA)
    assert estimate.offset.is_turned == is_turned


@pytest.mark.parametrize("north", [0.0, 1.0, -2.5])
def test_a_compass_may_have_any_north(north: float):
    estimate = at_rest()
    for yaw in (0.1, 0.7, 1.3):  # in three of twelve directions
        estimate, fate = read(estimate, yaw, yaw + north)
        assert fate == "accepted"
    assert estimate.compasses["compass"].deviation == 0.0


@pytest.mark.parametrize("seconds", [0, 3])
def test_a_compass_is_off_by_half_the_range_of_its_errors_less_its_noise_and_the_drift_of_the_gyro(
    seconds: int,
):
    error, bias_sigma = 0.3, 0.01
    estimate, _ = read(at_rest(), 0.1, 0.1)
    for yaw, wrong, stamp in ((1.6, error, 0), (3.2, -error, seconds * S)):
        estimate = at_rest(yaw, SIGMA, bias_sigma)._replace(stamp=stamp, compasses=estimate.compasses)
        reading = Heading(stamp, yaw + wrong, SIGMA**2, np.eye(3)[0])
        estimate, _ = FUSION.after_heading(estimate, "compass", reading, None)
    expected = error**2 - 2.0 * SIGMA**2 - (bias_sigma * seconds) ** 2
    assert estimate.compasses["compass"].deviation == pytest.approx(expected)


UPWARDS = np.array([0.0, 0.0, 9.80665])
SAMPLE = S // 200


def sampled(estimate: Estimate, count: int, gyro: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Estimate:
    """The estimate after samples of an IMU of 200 Hz."""
    for _ in range(count):
        sample = Inertia(estimate.stamp + SAMPLE, np.array(gyro), UPWARDS)
        estimate, _ = FUSION.after_inertia(estimate, sample)
    return estimate


@pytest.mark.parametrize(("silent", "is_coasting"), [(S // 10, False), (S // 10 + 1, True)])
def test_the_base_coasts_if_its_imu_is_silent_for_more_than_a_tenth_of_a_second(
    silent: int, is_coasting: bool
):
    estimate = sampled(at_rest(), 100)
    assert FUSION.predicted(estimate, estimate.stamp + silent, None).is_coasting == is_coasting


@pytest.mark.parametrize(("silent", "is_pause"), [(S // 2, False), (S // 2 + 1, True)])
def test_a_silence_of_all_for_more_than_half_a_second_is_a_pause(silent: int, is_pause: bool):
    estimate = sampled(at_rest(), 100)
    paused = FUSION.predicted(estimate, estimate.stamp + silent, None)
    assert (paused.pause is not None) == is_pause


def test_in_a_pause_the_base_may_turn_by_0_5_rad_per_s_and_drive_at_2_m_per_s():
    estimate = sampled(at_rest(), 100)
    coasted = FUSION.predicted(estimate, estimate.stamp + S // 2, None)
    paused = FUSION.predicted(estimate, estimate.stamp + S // 2 + 2 * S, None)
    added = np.diag(paused.state.covariance - coasted.state.covariance)
    assert added[ROTATION] == pytest.approx([0.0, 0.0, (0.5 * 2.0) ** 2])
    assert added[POSITION] == pytest.approx([(2.0 * 2.0) ** 2] * 3)
    assert added[GYRO_BIAS] == pytest.approx([1e-5**2 * 2.0] * 3)


def test_a_way_of_wheels_over_a_pause_is_unsure_by_a_part_of_it():
    before = sampled(at_rest(), 100)
    paused = FUSION.predicted(before, before.stamp + 3 * S, None)
    way, turn = 2.0, 0.5
    reading = Displacement(paused.stamp, before.stamp, np.array([way, 0.0, 0.0]), turn, np.eye(4))
    after, outcome = FUSION.after_pause(paused, reading, None)
    assert outcome is not None
    added = np.diag(after.state.covariance - before.state.covariance)
    # The place along the way, which the turns before the pause do not move.
    assert added[POSITION][0] == pytest.approx((0.02 + 0.3 * way) ** 2)
    assert added[ROTATION] == pytest.approx([0.02**2, 0.02**2, (0.02 + 0.3 * turn) ** 2])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_base_stands_up_to_5_mm_per_s_and_0_02_rad_per_s(axis: int):
    zero, one = np.zeros(3), np.eye(3)[axis]
    assert is_still(0.005 * one, zero)
    assert not is_still(0.00501 * one, zero)
    assert is_still(zero, 0.02 * one)
    assert not is_still(zero, 0.02001 * one)


@pytest.mark.parametrize(("rate", "is_turned"), [(0.0299, False), (0.0301, True)])
def test_a_gyro_that_reads_more_than_0_03_rad_per_s_while_wheels_stand_is_turned(
    rate: float, is_turned: bool
):
    standing = at_rest()._replace(wheels_at=0, moved_at=-S)
    remarks = imu_remarks(sampled(standing, 20, (0.0, 0.0, rate)))  # an interval of 0.1 s
    assert any("while the wheels stand" in remark for remark in remarks) == is_turned


@pytest.mark.parametrize(
    ("gyro", "accel", "is_integrated"),
    [(9.99, 49.9, (True, True)), (10.01, 49.9, (False, True)), (9.99, 50.1, (True, False))],
)
def test_a_sample_that_jumps_by_more_than_10_rad_per_s_or_50_m_per_s2_is_not_integrated(
    gyro: float, accel: float, is_integrated: tuple[bool, bool]
):
    before = sampled(at_rest(), 2)
    jump = Inertia(before.stamp + SAMPLE, np.array([gyro, 0.0, 0.0]), UPWARDS + np.array([accel, 0.0, 0.0]))
    after, _ = FUSION.after_inertia(before, jump)
    assert (after.rate[0] == gyro, after.force[0] == accel) == is_integrated


def test_the_noise_of_the_imu_is_a_mean_of_a_second():
    before = sampled(at_rest(), 2)
    assert before.vibration is not None
    before = before._replace(vibration=before.vibration._replace(averaged=10_000))
    bend = 0.3
    after, _ = FUSION.after_inertia(before, Inertia(before.stamp + SAMPLE, np.array([bend, 0, 0]), UPWARDS))
    assert after.vibration is not None
    # The second difference of white noise has six times its variance; a sample is 5 ms of the second.
    assert after.vibration.variance[0] == pytest.approx(0.005 * bend**2 / 6.0)


@pytest.mark.parametrize(("factor", "is_used"), [(1.49, False), (1.51, True)])
def test_the_noise_of_the_samples_is_used_if_its_variance_is_1_5_times_that_which_is_stated(
    factor: float, is_used: bool
):
    before = sampled(at_rest(), 100)
    assert before.vibration is not None
    stated = white_noise(FUSION.noise)
    seen = np.full(6, 1.0)
    seen[:3] = factor
    # A sample has the variance of the density over its time; one more without noise takes 5 ms of a second.
    vibration = before.vibration._replace(
        averaged=10_000, variance=seen * stated / before.sampled_s / (1.0 - 0.005)
    )
    after = sampled(before._replace(vibration=vibration), 1)
    assert after.vibration is not None
    assert after.vibration.white == pytest.approx((seen if is_used else 1.0) * stated)


@pytest.mark.parametrize(("scale", "shift"), [(0.01, 0.0), (0.0, 0.002), (0.01, 0.002), (0.0, 0.0)])
def test_the_scale_and_the_bias_of_a_gyro_are_errors_of_the_yaw_that_do_not_average_out(
    scale: float, shift: float
):
    noise = replace(FUSION.noise, gyro_scale=scale, gyro_bias_shift=shift)
    fusion, estimate, rate = Fusion(noise), at_rest(), 0.4
    for stamp in range(0, 2 * S + 1, SAMPLE):
        sample = Inertia(stamp, np.array([0.0, 0.0, rate]), UPWARDS)
        estimate, _ = fusion.after_inertia(estimate, sample)
    added = (fusion.settled(estimate).state.covariance - estimate.state.covariance)[2, 2]
    assert added == pytest.approx((scale * rate * 2.0) ** 2 + (shift * 2.0) ** 2)


def compared(
    apart: float, bias_sigma: float, *, was_at_rest: bool, x: float = 0.0, speed: float = 0.0
) -> Estimate:
    """The estimate after ten seconds straight on, in which wheels turned by ``apart`` more than the gyro.

    The base is at ``x`` [m] then and has ``speed`` along it [m/s].
    """
    estimate = sampled(at_rest(sigma=bias_sigma), 2)
    place, velocity = np.array([x, 0.0, 0.0]), np.array([speed, 0.0, 0.0])
    estimate = estimate._replace(state=estimate.state._replace(position=place, velocity=velocity))
    turning = Turning(10.0, apart, 0.0, apart * apart, 0.0, 0.0)
    estimate = estimate._replace(turning=turning, wheels_at=estimate.stamp - 1, was_at_rest=was_at_rest)
    unsure = Measurement(np.zeros(3), np.eye(3, 15), 1e12 * np.eye(3))
    reading = Reading(
        estimate.stamp,
        lambda _state, _rate: unsure,
        is_still=False,
        angular=np.array([0.0, 0.0, apart]),
        upright=np.array([0.0, 0.0, 1.0]),
    )
    return FUSION.after_reading(estimate, "wheels", reading, None)[0]


def test_the_tilt_of_a_mount_is_told_in_degrees():
    tilts: dict[int, np.ndarray] = {}
    for sector in range(8):
        estimate = at_rest((sector + 0.5) * math.tau / 12)._replace(tilts=tilts)
        upright = rotation_exp(np.array([0.0, math.radians(5.0), 0.0]))[2]
        unsure = Measurement(np.zeros(3), np.eye(3, 15), 1e12 * np.eye(3))
        reading = Reading(0, lambda _state, _rate, unsure=unsure: unsure, is_still=False, upright=upright)
        tilts = FUSION.after_reading(estimate, "wheels", reading, None)[0].tilts
    (remark,) = imu_remarks(at_rest()._replace(tilts=tilts))
    assert remark.startswith("the base is tilted by 5 degrees whichever way it heads")


@pytest.mark.parametrize("apart", [0.0, 0.003, 0.006])
def test_a_bias_that_wheels_agree_with_is_as_sure_as_that_of_calibrated_gyros_or_as_they_agree(apart: float):
    found = compared(apart, 0.05, was_at_rest=False)
    variance = 0.002**2 + max(0.0, apart**2 - RADII**2)
    row = GYRO_BIAS.start + 2
    assert found.state.covariance[row, row] == pytest.approx(variance, rel=1e-3)


RADII = 0.004
"""[rad/s] The standard deviation of the rate of wheels, whose radii differ."""


@pytest.mark.parametrize(("part", "is_told"), [(2.99, False), (3.01, True), (-3.01, True)])
@pytest.mark.parametrize(
    ("was_at_rest", "sigma"),
    # Of a bias that was measured its own standard deviation, of another that of gyros that are calibrated.
    [(True, math.hypot(RADII, 0.005)), (False, math.hypot(RADII, 0.002))],
)
def test_wheels_and_gyro_that_are_three_sigmas_apart_contradict_each_other(
    part: float, is_told: bool, was_at_rest: bool, sigma: float
):
    found = compared(part * sigma, 0.005 if was_at_rest else 0.05, was_at_rest=was_at_rest)
    assert (
        any("rates of gyro and wheels differ by a constant" in text for text in imu_remarks(found)) == is_told
    )


def test_a_measured_bias_that_wheels_contradict_is_as_unsure_as_the_difference_and_so_is_the_yaw():
    apart, bias_sigma = 0.05, 0.005
    before, found = (compared(one, bias_sigma, was_at_rest=True) for one in (0.0, apart))
    added = np.diag(found.state.covariance - before.state.covariance)
    expected = np.zeros(15)
    expected[GYRO_BIAS.start + 2] = apart**2
    expected[ROTATION.start + 2] = (apart * 10.0) ** 2
    assert added == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("x", [0.0, 100.0])
def test_a_yaw_that_wheels_contradict_is_unsure_about_the_middle_of_the_last_ten_seconds_way(x: float):
    """Wherever the origin is, so that the position does not become sure on a way back to it."""
    apart, bias_sigma, speed = 0.05, 0.005, 0.5
    before, found = (
        plain_covariance(compared(one, bias_sigma, was_at_rest=True, x=x, speed=speed).state)
        for one in (0.0, apart)
    )
    yaw, along, across = ROTATION.start + 2, POSITION.start, POSITION.start + 1
    added = (found - before)[np.ix_([yaw, along, across], [yaw, along, across])]
    effects = apart * 10.0 * np.array([1.0, 0.0, speed * 10.0 / 2.0])
    assert added == pytest.approx(np.outer(effects, effects), abs=1e-6)


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0])
def test_a_gyro_that_vibrates_as_often_as_wheels_are_read_has_no_bias(phase: float):
    """Its samples at those instants are all alike; the wheels measure means."""
    estimate = at_rest(sigma=0.02)
    unsure = Measurement(np.zeros(3), np.eye(3, 15), 1e12 * np.eye(3))
    for number in range(2400):
        stamp = number * SAMPLE
        rate = 0.06 * math.sin(math.tau * 20.0 * stamp * 1e-9 + phase)
        estimate, _ = FUSION.after_inertia(estimate, Inertia(stamp, np.array([0.0, 0.0, rate]), UPWARDS))
        if number % 10 == 0:  # at 20 Hz
            reading = Reading(
                stamp,
                lambda _state, _rate: unsure,
                is_still=False,
                angular=np.zeros(3),
                upright=np.array([0.0, 0.0, 1.0]),
            )
            estimate, _ = FUSION.after_reading(estimate, "wheels", reading, None)
    assert imu_remarks(estimate) == []
    assert abs(estimate.state.gyro_bias[2]) < 1e-3


def test_a_bias_that_a_rest_finds_is_no_contradiction_to_the_wheels_before():
    estimate = at_rest(sigma=0.02)._replace(turning=Turning(10.0, 0.0, 0.02, 0.0, 0.0004, 0.0), wheels_at=0)
    for number in range(1, 101):
        sample = Inertia(number * SAMPLE, np.array([0.0, 0.0, 0.02]), UPWARDS)
        estimate, _ = FUSION.after_inertia(estimate._replace(wheels_at=sample.stamp), sample)
    assert estimate.was_at_rest
    assert estimate.turning == Turning()


@pytest.mark.parametrize(("later", "is_told"), [(30 * S - 1, True), (30 * S, False)])
def test_a_pause_is_a_sentence_for_30_seconds(later: int, is_told: bool):
    remarks = imu_remarks(at_rest()._replace(stamp=S + later, pause=Pause(S, 3.2, is_bridged=True)))
    assert remarks == ["all data paused for 3.2 s: wheels measured the way"] * is_told


@pytest.mark.parametrize(
    ("degrees", "directions", "is_told"), [(3.99, 8, False), (4.01, 8, True), (4.01, 7, False)]
)
def test_a_tilt_of_more_than_four_degrees_in_eight_directions_is_that_of_the_mount(
    degrees: float, directions: int, is_told: bool
):
    tilts = {sector: np.array([math.radians(degrees), 0.0, 0.0]) for sector in range(directions)}
    assert bool(imu_remarks(at_rest()._replace(tilts=tilts))) == is_told


def pose_after(rows: slice, axis: int, *, is_position: bool) -> np.ndarray:
    """The continuous pose half a second later, when a measurement moves the estimate by 0.5 (m or rad)."""
    estimate = at_rest(yaw_sigma=1.0, sigma=1.0)._replace(stamp=S // 2)
    jacobian = np.zeros((1, 15))
    jacobian[0, rows.start + axis] = 1.0
    measured = Measurement(np.array([0.5]), jacobian, np.array([[1e-8]]))
    reading = Reading(S // 2, lambda _state, _rate: measured, is_position=is_position)
    after, outcome = FUSION.after_reading(estimate, "source", reading, None)
    assert outcome.fate == "accepted"
    return odom_pose(after, np.eye(4))[0]


def test_the_pose_follows_measured_poses_at_0_2_m_per_s_and_0_05_rad_per_s():
    assert pose_after(POSITION, 0, is_position=True)[:3, 3] == pytest.approx([0.5 * 0.2, 0.0, 0.0], abs=1e-6)
    turned = pose_after(ROTATION, 2, is_position=True)
    assert math.atan2(turned[1, 0], turned[0, 0]) == pytest.approx(0.5 * 0.05)


def test_the_pose_is_levelled_at_0_05_rad_per_s():
    tilted = pose_after(ROTATION, 0, is_position=False)
    assert math.atan2(tilted[2, 1], tilted[2, 2]) == pytest.approx(0.5 * 0.05)


def test_velocities_move_the_pose_only_from_then_on():
    assert (pose_after(VELOCITY, 0, is_position=False) == np.eye(4)).all()
