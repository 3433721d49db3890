"""What is stated of any source: the delay of its stamps, its gate, and the numbers that are used."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from helpers.base_motion import NOISE, mounted
from helpers.recordings import HUSKY_DATUM

from zstate import InvalidInput, Transform
from zstate.odometry import (
    BaseEstimator,
    BaseState,
    DiffDrive,
    FixNoise,
    HeadingNoise,
    MapEstimator,
    PoseNoise,
    VelocityNoise,
    WheelNoise,
)
from zstate.odometry.health import chi_square_quantile
from zstate.odometry.messages import Fix, Imu, Pose, Velocity
from zstate.odometry.sensors import Estimators, Sensor, sensor
from zstate.odometry.source_noise import POSE_AXES, SensorNoise, SourceNoise
from zstate.wire.messages import to_block

MS = 1_000_000
START = 1_000_000_000_000
LEVEL, ACROSS = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))
IMU = Transform("base", "imu", (0.0, 0.0, 0.0), LEVEL)
SIDE = Transform("base", "side", (0.0, 0.0, 0.0), ACROSS)
"""A frame whose x axis is the base's y axis."""
ORIGIN = Transform("odom", "base", (0.0, 0.0, 0.0), LEVEL)


def new_base(**options: Any) -> BaseEstimator:
    buffer = mounted(IMU)
    buffer.insert_static(SIDE)
    return BaseEstimator(
        odom="odom",
        base="base",
        imu="imu",
        buffer=buffer,
        imu_noise=NOISE,
        initial_pose=ORIGIN.with_covariance(1e-4 * np.eye(6)),
        **options,
    )


def rested(base: BaseEstimator, first: int, last: int) -> None:
    """Samples of an IMU at rest at 100 Hz, from ``first`` to ``last`` [ms]."""
    for ms in range(first, last + 1, 10):
        base.imu(START + ms * MS, [0.0, 0.0, 0.0], [0.0, 0.0, 9.80665])


def message_of(noise: SensorNoise, stamp: int) -> Any:
    """A reading of a base that is not where it was predicted to be."""
    head = (stamp, 0, 1)
    match noise:
        case VelocityNoise():
            return Velocity(*head, "base", to_block([0.05, 0.0, 0.0]))
        case PoseNoise():
            return Pose(*head, "odom", "", to_block([0.02, 0.0, 0.0, *LEVEL]))
        case HeadingNoise():
            zero = to_block([0.0] * 3)
            return Imu(*head, "imu", zero, zero, to_block([0.0, 0.0, math.sin(0.01), math.cos(0.01)]))
        case FixNoise():
            return Fix(*head, "base", HUSKY_DATUM.latitude, HUSKY_DATUM.longitude)


def state_after(one: Sensor, delay_ns: int) -> BaseState:
    base = new_base()
    in_map = MapEstimator(base, map="map", buffer=mounted(IMU))
    rested(base, 0, 500)
    for ms in (200, 300, 400):
        one.add(Estimators(base, in_map), message_of(one.noise, START + ms * MS + delay_ns))
    assert [health.accepted for health in base.health() if health.dimension] in ([], [3])
    assert not in_map.health() or in_map.health()[0].age_s == pytest.approx(0.1)
    return base.state()


@pytest.mark.parametrize("delay_ms", [40, -40, 90])
@pytest.mark.parametrize("kind", [VelocityNoise, PoseNoise, HeadingNoise, FixNoise])
def test_readings_of_a_source_that_is_late_count_at_their_own_instant(kind: Any, delay_ms: int):
    sigmas = {VelocityNoise: {"sigma": 0.1}, HeadingNoise: {"sigma_deg": 2.0}, FixNoise: {"sigma": 1.0}}
    stated = sigmas.get(kind, {"sigma": 0.1, "sigma_deg": 2.0})
    in_time = state_after(sensor("a", kind(**stated)), 0)
    late = state_after(sensor("a", kind(**stated, delay_s=delay_ms * 1e-3)), delay_ms * MS)
    assert late.stamp == in_time.stamp
    assert np.array_equal(late.odom_from_base.pose7, in_time.odom_from_base.pose7)
    assert np.array_equal(late.covariance.pose, in_time.covariance.pose)
    assert np.array_equal(late.twist.linear, in_time.twist.linear)


def test_readings_of_wheels_that_are_late_count_at_their_own_instant():
    found: list[BaseState] = []
    for delay_ms in (0, 40):
        noise = WheelNoise(delay_s=delay_ms * 1e-3)
        base = new_base(wheels=DiffDrive("left", "right", radius=0.1, track=0.4, noise=noise))
        rested(base, 0, 500)
        for ms in range(100, 401, 20):
            base.joints(START + (ms + delay_ms) * MS, dict.fromkeys(("left", "right"), 0.001 * ms))
        found.append(base.state())
    assert np.array_equal(found[0].odom_from_base.pose7, found[1].odom_from_base.pose7)
    assert found[0].twist.linear[0] > 0.05


def outcome(kind: str, distance: float, gate: float) -> tuple[int, float]:
    """How many readings were rejected, and the NIS of the last, of one ``distance`` off the estimate."""
    base = new_base()
    rested(base, 0, 100)
    stamp = START + 50 * MS
    if kind == "velocity":
        base.velocity(stamp, [distance, 0.0, 0.0], sigma=[0.1] * 3, gate=gate, source="a")
    elif kind == "pose":
        pose = Transform("odom", "base", (distance, 0.0, 0.0), LEVEL)
        base.pose(stamp, pose, 0.01 * np.eye(6), gate=gate, source="a")
    elif kind == "position":
        base.position(stamp, [distance, 0.0, 0.0], 0.01 * np.eye(3), gate=gate, source="a", frame="base")
    elif kind == "wheels":
        noise = WheelNoise(gate=gate, slip=0.0, speed=0.1)
        base = new_base(wheels=DiffDrive("left", "right", radius=1.0, track=0.4, noise=noise))
        rested(base, 0, 100)
        for ms, angle in ((40, 0.0), (60, 0.02 * distance)):
            base.joints(START + ms * MS, dict.fromkeys(("left", "right"), angle))
    (health,) = [one for one in base.health() if one.dimension]
    return health.rejected, health.nis_mean


@pytest.mark.parametrize("gate", [0.9, 0.999, 0.999999])
@pytest.mark.parametrize(
    ("kind", "dimension"), [("velocity", 3), ("pose", 6), ("position", 3), ("wheels", 3)]
)
def test_gate_is_the_part_of_readings_of_so_many_numbers_that_pass(kind: str, dimension: int, gate: float):
    _, nis = outcome(kind, 0.1, gate)
    edge = 0.1 * math.sqrt(chi_square_quantile(gate, dimension) / nis)
    assert [outcome(kind, part * edge, gate)[0] for part in (0.99, 1.01)] == [0, 1]


@pytest.mark.parametrize(("gate", "rejected"), [(0.9, 1), (0.999, 0)])
def test_gate_of_headings_is_that_of_one_number_beside_what_a_compass_may_be_off(gate: float, rejected: int):
    """0.96 rad off, where a compass that was read in one direction may be off by 0.5 * 11 / 12 rad."""
    base = new_base()
    rested(base, 0, 100)
    for ms, yaw in ((20, 0.1), (40, 1.06)):
        base.heading(START + ms * MS, yaw, 0.01, source="a", gate=gate)
    (health,) = [one for one in base.health() if one.dimension]
    assert health.rejected == rejected


@pytest.mark.parametrize("gate", [0.5, 1.0, math.nan])
def test_gate_that_is_no_probability_is_refused(gate: float):
    with pytest.raises(InvalidInput, match="the gate of a source is the part of its readings that pass"):
        SourceNoise(gate=gate)
    with pytest.raises(InvalidInput, match="the gate of a source"):
        new_base().velocity(START, [0.0] * 3, sigma=[0.1] * 3, gate=gate)


def test_velocity_in_one_axis_of_its_sensor_says_nothing_of_the_others():
    """A radar that looks to the left: its x is the base's y. Its y and z are no numbers of a motion."""
    states: list[BaseState] = []
    unknown = np.diag((0.01, 0.0, -1.0))
    unknown[0, 1:] = unknown[1:, 0] = math.nan
    for linear, covariance, axes in (
        ([0.02, 5.0, -3.0], unknown, ["x"]),
        ([0.02, 0.0, 0.0], np.diag((0.01, 1e12, 1e12)), ["x", "y", "z"]),
    ):
        base = new_base()
        rested(base, 0, 100)
        base.velocity(START + 50 * MS, linear, covariance=covariance, axes=axes, frame="side", source="a")
        (health,) = [one for one in base.health() if one.dimension]
        assert (health.dimension, health.accepted) == (len(axes), 1)
        states.append(base.state())
    one, other = states
    assert one.twist.linear == pytest.approx(other.twist.linear, abs=1e-9)
    assert one.covariance.twist == pytest.approx(other.covariance.twist, rel=1e-6, abs=1e-12)
    assert one.twist.linear[1] > 1e-5 > abs(one.twist.linear[0])


def test_base_stands_whatever_the_axes_say_that_are_not_used():
    base = new_base()
    rested(base, 0, 1000)
    for ms in range(0, 1000, 20):
        base.velocity(START + ms * MS, [0.0, 0.7, 0.0], sigma=[0.1] * 3, axes=["x"])
    assert "standstill" in [one.name for one in base.health()]


PLANAR = ["x", "y", "yaw"]


def pitched_pose(axes: list[str]) -> tuple[BaseState, BaseState]:
    """A base on a ramp of 0.2 rad at a height of 2 m before and after a pose of a localiser in 2D."""
    ramp = Transform.from_rpy("odom", "base", (0.0, 0.0, 2.0), (0.0, 0.2, 1.0))
    base = new_base()
    base.reset(ramp.with_covariance(1e-2 * np.eye(6)))
    before: BaseState | None = None
    for ms in range(0, 101, 10):
        up = ramp.matrix[:3, :3].T @ (0.0, 0.0, 9.80665)
        base.imu(START + ms * MS, [0.0, 0.0, 0.0], up)
    before = base.state()
    flat = Transform.from_rpy("odom", "base", (0.1, -0.1, 0.0), (0.0, 0.0, 1.1))
    base.pose(START + 100 * MS, flat, 1e-4 * np.eye(6), axes=axes, source="a", gate=1.0 - 1e-9)
    return before, base.follower("world").state()


def test_planar_pose_moves_a_base_in_the_plane_and_leaves_height_and_tilt():
    before, after = pitched_pose(PLANAR)
    move = after.odom_from_base.translation - before.odom_from_base.translation
    assert move == pytest.approx([0.1, -0.1, 0.0], abs=0.01)
    assert after.odom_from_base.rpy - before.odom_from_base.rpy == pytest.approx([0.0, 0.0, 0.1], abs=0.01)
    height, tilt = 2, slice(3, 5)
    for rows in (height, tilt):
        known = before.covariance.pose[rows, rows]
        assert after.covariance.pose[rows, rows] == pytest.approx(known, rel=0.1)
    assert after.covariance.pose[0, 0] < 0.1 * before.covariance.pose[0, 0]


def followed(axes: list[str], x: float = 0.5, yaw: float = 0.1) -> tuple[BaseState, BaseState, int]:
    """The states before and after poses that contradict for three seconds, and how often it followed them."""
    base = new_base(history_s=5.0)
    rested(base, 0, 3500)
    pose = Transform.from_rpy("odom", "base", (x, 0.0, 0.0), (0.0, 0.0, yaw))
    for ms in range(0, 3501, 50):
        base.velocity(START + ms * MS, [0.0] * 3, sigma=[0.01] * 3)
    before = base.state(START + 500 * MS)
    for ms in range(500, 3501, 100):
        base.pose(START + ms * MS, pose, 1e-4 * np.eye(6), axes=axes, source="a")
    (health,) = [one for one in base.health() if one.name == "a"]
    return before, base.follower("world").state(), health.reacquired


@pytest.mark.parametrize("axes", [["yaw"], ["x"], PLANAR, list(POSE_AXES)], ids="+".join)
def test_poses_that_contradict_for_two_seconds_are_followed_in_their_axes_alone(axes: list[str]):
    before, after, reacquired = followed(axes)
    assert reacquired == 1
    x, y, _ = after.odom_from_base.translation.tolist()
    yaw = after.odom_from_base.rpy[2]
    assert (x, yaw) == pytest.approx((0.5 * ("x" in axes), 0.1 * ("yaw" in axes)), abs=0.03)
    assert y == pytest.approx(0.0, abs=0.03)
    for row, name in enumerate(POSE_AXES):
        if name in {"x", "y", "z"} and name not in axes:
            grown = after.covariance.pose[row, row] / before.covariance.pose[row, row]
            assert grown < 10.0, name


@pytest.mark.parametrize("yaw", [0.1, 1.0, 3.0])
def test_a_pose_that_is_followed_at_last_is_where_the_base_is_however_far_it_had_turned(yaw: float):
    _, after, reacquired = followed(list(POSE_AXES), 5.0, yaw)
    assert reacquired == 1
    np.testing.assert_allclose(after.odom_from_base.translation, [5.0, 0.0, 0.0], atol=0.02)
    assert after.odom_from_base.rpy[2] == pytest.approx(yaw, abs=0.02)
