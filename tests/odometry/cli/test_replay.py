"""Replayed odometry of a simulated rover's recording: its table, its reference, its report and its figure."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from random import Random
from typing import NamedTuple

import numpy as np
import pytest
from helpers.recording_builder import MS, START, STORE, Bag, RecordingBuilder, S, pose

from zstate import Transform, TransformBuffer, load_model
from zstate.errors import InvalidInput
from zstate.model.kinematics import Kinematics
from zstate.odometry import (
    BarometerNoise,
    BaseEstimator,
    Datum,
    DiffDrive,
    FixNoise,
    HeadingNoise,
    ImuNoise,
    MagnetometerNoise,
    PoseNoise,
    SimulatedRover,
    SourceHealth,
    VelocityNoise,
    WheelNoise,
)
from zstate.odometry.cli.reference import ReferenceName
from zstate.odometry.cli.replay import (
    ReplayedOdometry,
    odometry_figure,
    replay,
    report_lines,
    sigma_factor,
)
from zstate.odometry.cli.settings_file import OdometrySettings
from zstate.odometry.messages import Fix, Imu, MagneticField, Odometry, Pose, Pressure, Velocity
from zstate.odometry.simulated_rover import ImuReading
from zstate.sources.square_drive import WheelPair
from zstate.wire.messages import order_digest, to_block

MODEL = load_model("diffbot")
NOISE = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
SETTINGS = OdometrySettings(
    base="base_footprint",
    imu_noise=NOISE,
    diff_drive=DiffDrive("left_wheel_joint", "right_wheel_joint", radius=0.08, track=0.32),
)
SECONDS = 8
FLOW_SIGMA, MOCAP_SIGMA = 0.04, 0.02
FLOW_DELAY_MS, JOINT_DELAY_MS = 60, 0
MAP_FROM_ODOM = 3.0, -2.0, 2.0
"""x y [m] and yaw [rad]."""
MAGNET_T = 2e-5
"""The level field, towards x at the start."""
DATUM = Datum(48.1, 11.5, 560.0)


Recorded = Callable[..., str]


class Drive(NamedTuple):
    """What the sensors of a rover measured: joints, velocities along x and poses at their stamps [ns]."""

    imu: list[ImuReading]
    joints: list[tuple[int, list[float]]]
    flow: list[tuple[int, float]]
    poses: list[tuple[int, tuple[float, float, float]]]


def drive_mount() -> Transform:
    poses = Kinematics(MODEL).link_poses(MODEL.neutral)
    return Transform.from_pose7("base_footprint", "imu_link", poses[MODEL.links.index("imu_link")])


def at_100_hz(readings: list[ImuReading]) -> Iterator[ImuReading]:
    """The means of two readings each."""
    for one, other in zip(readings[::2], readings[1::2], strict=True):
        yield ImuReading(
            (one.stamp + other.stamp) // 2, 0.5 * (one.gyro + other.gyro), 0.5 * (one.accel + other.accel)
        )


@cache
def drive() -> Drive:
    """A rest of 3 s, then a new speed and turn each second."""
    wheels = WheelPair(0.08, 0.32)
    rover = SimulatedRover(wheels, drive_mount(), NOISE, slip=0.02, gyro_bias=(0.002, -0.001, 0.003), seed=1)
    random, found = Random(1), Drive([], [], [], [])
    rover.advance(START)
    for n in range(1, 50 * SECONDS + 1):
        stamp = START + n * 20 * MS
        if n >= 150 and not n % 50:
            rover.drive(wheels.roll(random.uniform(0.1, 0.8), random.uniform(-1.0, 1.0)))
        before = rover.pose
        found.joints.append((stamp, rover.joints(stamp).positions.tolist()))
        found.imu.extend(at_100_hz(rover.imu(stamp)))
        x, y, yaw = rover.pose
        along = (x - before.x) * math.cos(yaw) + (y - before.y) * math.sin(yaw)
        found.flow.append((stamp - 10 * MS, along / 0.02 + random.gauss(0.0, FLOW_SIGMA)))
        found.poses.append((stamp, (x, y, yaw)))
    return found


def in_map(x: float, y: float, yaw: float) -> tuple[float, float, float]:
    at_x, at_y, turn = MAP_FROM_ODOM
    cosine, sine = math.cos(turn), math.sin(turn)
    return at_x + cosine * x - sine * y, at_y + sine * x + cosine * y, yaw + turn


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """``recorded(covariance=0.0)`` is the path of a recording of the drive, written once per process."""
    folder = tmp_path_factory.mktemp("drive")

    @cache
    def path_of(covariance: float = 0.0) -> str:
        return str(record(folder / f"{covariance}.mcap", covariance))

    return path_of


def record(path: Path, covariance: float) -> Path:
    """The drive with the flow sensor late; both have that variance in their messages."""
    random = Random(2)
    with RecordingBuilder(path) as builder:
        write = builder.encoder.write_message
        builder.describe("r1", MODEL)
        for one in drive().imu:
            orientation = to_block([0.0, 0.0, 0.0, 1.0])  # a compass that always shows the same
            message = Imu(one.stamp, 0, 2, "imu_link", to_block(one.gyro), to_block(one.accel), orientation)
            write("r1", message, one.stamp, "imu")
        for stamp, positions in drive().joints:
            builder.joints("r1", stamp + JOINT_DELAY_MS * MS, positions, model=MODEL)
        upper = to_block(covariance * np.eye(3)[np.triu_indices(3)])
        for stamp, speed in drive().flow:
            late = stamp + FLOW_DELAY_MS * MS
            flow = Velocity(late, 0, 3, "base_footprint", to_block([speed, 0.0, 0.0]), None, upper)
            write("r1", flow, late, "flow")
        upper = to_block(covariance * np.eye(6)[np.triu_indices(6)])
        fix_upper = to_block(MOCAP_SIGMA**2 * np.diag((1.0, 1.0, 4.0))[np.triu_indices(3)])
        for stamp, (x, y, yaw) in drive().poses[::5]:
            map_x, map_y, turn = in_map(
                x + random.gauss(0.0, MOCAP_SIGMA), y + random.gauss(0.0, MOCAP_SIGMA), yaw
            )
            placed = to_block([map_x, map_y, 0.0, 0.0, 0.0, math.sin(0.5 * turn), math.cos(0.5 * turn)])
            write("r1", Pose(stamp, 0, 4, "map", "", placed, upper), stamp, "mocap")
            edges = (("map", "base_footprint"),)
            twist = to_block([0.0] * 6)
            other = Odometry(stamp, 0, 5, order_digest(edges), placed, edges, None, twist)
            write("r1", other, stamp, "laser")
            latitude, longitude, altitude = DATUM.geodetic((map_x, map_y, 0.0))
            fix = Fix(stamp, 0, 6, "base_footprint", latitude, longitude, altitude, 0, 0, fix_upper, 2)
            write("r1", fix, stamp, "gps")
            pressure = 9e4 + random.gauss(0.0, 3.0)
            write("r1", Pressure(stamp, 0, 7, "base_footprint", pressure, 9.0), stamp, "bmp")
            level = MAGNET_T * math.cos(yaw), -MAGNET_T * math.sin(yaw)
            for sensor, unit in (("mag", 1.0), ("gauss", 1e4)):
                field = to_block([unit * level[0], unit * level[1], -unit * 2.0 * MAGNET_T])
                write("r1", MagneticField(stamp, 0, 7, "base_footprint", field), stamp, sensor)
        write("r1", Fix(stamp, 0, 6, "base_footprint", None, None, status=-1), stamp, "gps")
    return path


@pytest.mark.long
def test_table_has_used_rejected_nis_sigma_and_delay_of_each_source(recorded: Recorded):
    settings = replace(SETTINGS, velocity={"flow": VelocityNoise(sigma=0.5 * FLOW_SIGMA, scale=0.0)})
    replayed = replay(recorded(), "r1", settings)
    lines = list(report_lines(replayed))
    assert lines[0].split("  ")[0] == "source"
    assert max(map(len, lines[: 1 + len(replayed.health)])) <= 80
    rows = {line.split()[0]: line for line in lines[1 : 1 + len(replayed.health)]}
    assert {"flow", "wheels", "imu"} <= rows.keys()
    assert "delay [ms]" in lines[0]
    # The stamps of the sensor are 60 ms late, those of the joints are not.
    for source, delay_ms in (("flow", FLOW_DELAY_MS), ("wheels", JOINT_DELAY_MS)):
        found = replayed.delays[source]
        assert found.delay_s * 1e3 == pytest.approx(delay_ms, abs=5.0)
        assert abs(found.delay_s - delay_ms * 1e-3) < 4.0 * max(found.sigma_s, 1e-3)
        assert re.search(r"-?\d+ \+- \d+$", rows[source])
    assert rows["imu"].endswith("-")


@pytest.mark.long
def test_delay_that_would_fit_is_a_setting_and_none_is_left_with_it(recorded: Recorded):
    settings = replace(SETTINGS, velocity={"flow": VelocityNoise(sigma=FLOW_SIGMA)})
    path, key = recorded(), "would fit: [velocity.flow] delay_s = "
    late = replay(path, "r1", settings)
    (line,) = [line for line in report_lines(late) if "delay_s" in line and line.startswith("would fit")]
    assert line.startswith(key)
    delay_s = float(line.removeprefix(key))
    assert delay_s * 1e3 == pytest.approx(FLOW_DELAY_MS, abs=5.0)
    flow = VelocityNoise(sigma=FLOW_SIGMA, delay_s=delay_s)
    in_time = replay(path, "r1", replace(SETTINGS, velocity={"flow": flow}))
    assert in_time.delays["flow"].delay_s == pytest.approx(0.0, abs=1e-3)
    assert not [line for line in report_lines(in_time) if line.startswith("would fit") and "delay_s" in line]

    def factor(replayed: ReplayedOdometry) -> float:
        return next(sigma_factor(replayed, one) or 0.0 for one in replayed.health if one.name == "flow")

    assert factor(in_time) < 0.8 * factor(late)


@pytest.mark.long
def test_delay_of_wheels_is_a_setting_of_their_noise(recorded: Recorded):
    late = DiffDrive(
        "left_wheel_joint", "right_wheel_joint", 0.08, 0.32, noise=WheelNoise(delay_s=-0.05)
    )  # which is not so
    replayed = replay(recorded(), "r1", replace(SETTINGS, diff_drive=late))
    assert replayed.delays["wheels"].delay_s == pytest.approx(0.05, abs=5e-3)
    (delay_s,) = replayed.fitting_delays.values()
    assert delay_s == pytest.approx(0.0, abs=5e-3)
    assert list(replayed.fitting_delays) == ["[diff_drive] noise.delay_s"]


@pytest.mark.long
def test_sigma_that_would_fit_is_that_of_the_sensor(recorded: Recorded):
    """A sensor of x alone, in time: its y and z are exact, so that the mean of three numbers is 1/3 of x."""
    settings = replace(
        SETTINGS, velocity={"flow": VelocityNoise(sigma=(0.2 * FLOW_SIGMA, 1.0, 1.0), scale=0.0)}
    )
    replayed = replay(recorded(), "r1", settings)
    flow = next(one for one in replayed.health if one.name == "flow")
    factor = sigma_factor(replayed, flow)
    assert factor is not None
    assert factor > 1.5
    (line,) = [line for line in report_lines(replayed) if line.startswith("would fit: [velocity.flow] sigma")]
    fitting = [float(number) for number in re.findall(r"[\d.]+", line.split("=")[1])]
    assert fitting == pytest.approx([factor * 0.2 * FLOW_SIGMA, factor, factor], rel=0.05)


@pytest.mark.parametrize("stream", ["pose/mocap", "odometry/laser"])
@pytest.mark.long
def test_reference_gives_ate_error_at_the_end_and_nees(recorded: Recorded, stream: str):
    path = recorded()
    name = ReferenceName(*stream.split("/"), sigma=MOCAP_SIGMA)
    replayed = replay(path, "r1", SETTINGS, name)
    found = replayed.reference
    assert found is not None
    assert found.count == pytest.approx(len(drive().poses) / 5, abs=10)
    # Moved back into the frame of the odometry, it is where the rover was.
    x, y, _ = drive().poses[-5][1]
    assert found.positions[-1] == pytest.approx([x, y], abs=0.2)
    assert 0.7 * MOCAP_SIGMA < found.ate_m < 0.3
    assert found.nees is not None
    assert found.end_sigmas is not None
    assert found.nees < 4.0
    assert found.end_sigmas < 4.0
    text = "\n".join(report_lines(replayed))
    assert re.search(
        rf"against \d+ readings of {stream}: ATE 0.\d+ m, error at the end 0.\d+ m, .* % of", text
    )
    assert re.search(r"error at the end \d.\d sigma .*; NEES of x y \d.\d\d \(2 is right", text)


@pytest.mark.long
def test_compass_that_lies_is_a_source_with_a_sentence_and_does_not_turn_the_odometry(
    recorded: Recorded,
):
    path = recorded()
    without = replay(path, "r1", SETTINGS)
    replayed = replay(path, "r1", replace(SETTINGS, heading={"imu": HeadingNoise(sigma_deg=2.0)}))
    (compass,) = [one for one in replayed.health if one.name == "imu heading"]
    assert "against the gyro" in compass.sentence
    yaws = [one.states[-1].odom_from_base.rpy[2] for one in (without, replayed)]
    assert math.remainder(yaws[1] - yaws[0], math.tau) == pytest.approx(0.0, abs=0.1)


@pytest.mark.long
def test_a_barometer_is_a_row_of_the_table_and_is_no_reason_to_change_its_noise(recorded: Recorded):
    settings = replace(SETTINGS, barometer={"bmp": BarometerNoise()})
    replayed = replay(recorded(MOCAP_SIGMA**2), "r1", settings)
    (bmp,) = [one for one in replayed.health if one.name == "bmp"]
    assert (bmp.accepted > 20, bmp.rejected, bmp.sentence) == (True, 0, "")
    assert replayed.sigmas["bmp"] == pytest.approx([0.28], abs=0.01)  # 3 Pa
    assert not any("bmp" in line for line in report_lines(replayed) if line.startswith("would fit"))


@pytest.mark.long
def test_magnetometer_is_a_source_with_a_row_and_one_in_gauss_is_refused(recorded: Recorded):
    path = recorded()
    replayed = replay(path, "r1", replace(SETTINGS, magnetometer={"mag": MagnetometerNoise()}))
    (field,) = [one for one in replayed.health if one.name == "mag field"]
    assert (field.accepted > 20, field.rejected, field.sentence) == (True, 0, "")
    assert any(line.startswith("mag field ") for line in report_lines(replayed))
    assert not any("would fit" in line for line in report_lines(replayed))
    settings = replace(SETTINGS, magnetometer={"gauss": MagnetometerNoise()})
    with pytest.raises(InvalidInput, match=r"'gauss' is 0.447 T, .* 1 gauss 1e-4 T"):
        replay(path, "r1", settings)


@pytest.mark.long
def test_fixes_of_a_receiver_give_the_end_of_the_drive_in_the_map_and_on_the_earth(
    recorded: Recorded,
):
    datum = (DATUM.latitude, DATUM.longitude, DATUM.altitude)
    settings = replace(SETTINGS, fix={"gps": FixNoise()}, datum=datum)
    replayed = replay(recorded(MOCAP_SIGMA**2), "r1", settings)
    state = replayed.in_map
    assert state is not None
    x, y, yaw = in_map(*drive().poses[-1][1])
    errors = (state.map_from_base.translation - (x, y, 0.0))[:2]
    assert errors @ np.linalg.solve(state.covariance[:2, :2], errors) < 12.0
    assert math.remainder(state.map_from_base.rpy[2] - yaw, math.tau) ** 2 < 12.0 * state.covariance[5, 5]
    lines = list(report_lines(replayed))
    (line,) = [line for line in lines if line.startswith("in 'r1/map', x east and y north of")]
    latitude, longitude, _ = DATUM.geodetic(state.map_from_base.translation)
    assert line.endswith(f"{latitude:.7f} {longitude:.7f}")
    level = replay(recorded(MOCAP_SIGMA**2), "r1", replace(settings, planar=True))
    assert level.in_map is not None
    assert level.in_map.map_from_base.translation[:2].tolist() == state.map_from_base.translation[:2].tolist()
    assert level.in_map.map_from_base.translation[2] == np.abs(level.positions[:, 2]).max() == 0.0
    (gps,) = [one for one in replayed.health if one.name == "gps"]
    assert (gps.accepted > 20, gps.rejected) == (True, 0)
    (jump,) = replayed.refused_jumps.values()
    assert f"gps: at its last fix, one that jumps by more than {jump:.2g} m would be refused" in lines


@pytest.mark.long
def test_bag_of_ros_has_sources_and_references_by_the_names_of_their_topics(tmp_path: Path):
    """/imu/data, /wheels/twist without covariance, and nav_msgs/Odometry of a reference."""
    types = STORE.types

    def vector(x: float, y: float, z: float) -> object:
        return types["geometry_msgs/msg/Vector3"](float(x), float(y), float(z))

    def twist(x: float) -> object:
        moving = types["geometry_msgs/msg/Twist"](vector(x, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        return types["geometry_msgs/msg/TwistWithCovariance"](moving, np.zeros(36))

    def header(stamp: int, frame: str) -> object:
        return types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(stamp, S)), frame)

    mount = Transform.from_pose7("base_link", "imu_link", drive_mount().pose7)
    with Bag(tmp_path / "bag") as bag:
        bag.tf(START, [mount], "/tf_static")
        level, unknown = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), np.zeros(9)
        for one in drive().imu:
            kind = "sensor_msgs/msg/Imu"
            parts = (level, unknown, vector(*one.gyro), unknown, vector(*one.accel), unknown)
            bag.write("/imu/data", one.stamp, types[kind](header(one.stamp, "imu_link"), *parts), kind)
        for stamp, speed in drive().flow:
            kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
            message = types[kind](header(stamp, "base_link"), twist(speed))
            bag.write("/wheels/twist", stamp, message, kind)
        for stamp, (x, y, yaw) in drive().poses[::5]:
            kind = "nav_msgs/msg/Odometry"
            turned = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
            placed = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x, y, 0.0), turned)
            posed = types["geometry_msgs/msg/PoseWithCovariance"](placed, np.zeros(36))
            message = types[kind](header(stamp, "world"), "truth_link", posed, twist(0.0))
            bag.write("/truth/odom", stamp, message, kind)
    stated = {"wheels_twist": VelocityNoise(sigma=FLOW_SIGMA)}
    settings = OdometrySettings(imu="imu_data", base="base_link", imu_noise=NOISE, velocity=stated)
    replayed = replay(str(tmp_path / "bag"), "ros", settings, ReferenceName("odometry", "truth_odom"))
    assert replayed.reference is not None
    assert replayed.reference.ate_m < 0.5
    assert replayed.delays["wheels_twist"].delay_s == pytest.approx(0.0, abs=0.01)


@pytest.mark.long
def test_reference_without_noise_has_no_errors_in_sigmas(recorded: Recorded):
    path = recorded()
    replayed = replay(path, "r1", SETTINGS, ReferenceName("pose", "mocap"))
    assert replayed.reference is not None
    assert replayed.reference.nees is None
    assert any("--reference pose/mocap:sigma=METRES" in line for line in report_lines(replayed))
    stated = replay(
        recorded(MOCAP_SIGMA**2),
        "r1",
        SETTINGS,
        ReferenceName("pose", "mocap"),
    )
    assert stated.reference is not None
    assert stated.reference.nees is not None


@pytest.mark.parametrize(
    ("settings", "reference", "error"),
    [
        (
            replace(SETTINGS, imu="imi"),
            None,
            r"no message on imu/imi of 'r1'; there is 'imu'; did you mean 'imu'\?",
        ),
        (
            replace(SETTINGS, velocity={"flwo": VelocityNoise()}),
            None,
            r"no message on velocity/flwo of 'r1'; there is 'flow'; did you mean 'flow'\?",
        ),
        (
            replace(
                SETTINGS, diff_drive=DiffDrive("left_wheel", "right_wheel_joint", radius=0.08, track=0.32)
            ),
            None,
            r"joint positions lack 'left_wheel' of the wheels; did you mean 'left_wheel_joint'\?",
        ),
        (SETTINGS, ReferenceName("pose", "gps"), r"no message on pose/gps of 'r1'; there is 'mocap'"),
        (
            replace(SETTINGS, velocity={"flow": VelocityNoise()}),
            None,
            r"velocities of 'flow' have no covariance: .* \[velocity.flow\]",
        ),
    ],
)
def test_sensor_without_messages_or_noise_is_refused(
    recorded: Recorded, settings: OdometrySettings, reference: ReferenceName | None, error: str
):
    with pytest.raises(InvalidInput, match=error):
        replay(recorded(), "r1", settings, reference)


def test_source_does_not_judge_itself(tmp_path: Path):
    settings = replace(SETTINGS, pose={"mocap": PoseNoise(sigma=0.02, sigma_deg=1.0)})
    with pytest.raises(InvalidInput, match="pose/mocap is a source: it would judge itself"):
        replay(str(tmp_path / "r.mcap"), "r1", settings, ReferenceName("pose", "mocap"))


@pytest.mark.parametrize(
    ("has_edges", "base", "error"),
    [
        (
            False,
            "base_link",
            "it has no model and no static transforms; record robot_description or tf_static",
        ),
        (True, "base_link", "'r1/imu_link' is unknown among .*; record robot_description or tf_static"),
        (True, None, "has no model of 'r1', whose root would be the base; give --base"),
    ],
)
def test_recording_without_mounts_says_what_it_lacks(
    tmp_path: Path, has_edges: bool, base: str | None, error: str
):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path) as builder:
        at_rest = to_block([0.0, 0.0, 0.0]), to_block([0.0, 0.0, 9.81])
        builder.encoder.write_message("r1", Imu(START, 0, 2, "imu_link", *at_rest), START, "imu")
        upper = to_block(np.eye(3)[np.triu_indices(3)])
        flow = Velocity(START, 0, 3, "base_link", to_block([0.0, 0.0, 0.0]), None, upper)
        builder.encoder.write_message("r1", flow, START, "flow")
        if has_edges:
            builder.edges("r1", START, {("odom", "base_link"): pose()}, writer="other")
    with pytest.raises(InvalidInput, match=error):
        replay(str(path), "r1", OdometrySettings(base=base, velocity={"flow": VelocityNoise()}))


Points = list[tuple[float, float, float, float]]
BAND = 2.67, 3.35


def replayed(nis: dict[str, Points]) -> ReplayedOdometry:
    """20 s at the origin, with the mean NIS of sources."""
    mounts = TransformBuffer()
    mounts.insert_static(Transform("base", "imu", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    noise = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
    base = BaseEstimator(odom="odom", base="base", imu="imu", buffer=mounts, imu_noise=noise)
    for tenth in range(200):
        base.imu(tenth * 100_000_000, [0.0, 0.0, 0.0], [0.0, 0.0, 9.80665])
    return ReplayedOdometry("base", [base.state(19_000_000_000), base.state()], (), nis)


@pytest.mark.parametrize(
    ("standstill", "found"),
    [
        ({}, "no rest at the start: it was never found to stand"),
        (
            {"standstill": [(12.3, 6.0, *BAND)]},
            "no rest at the start: it was first found to stand after 12.3 s",
        ),
        ({"standstill": [(0.5, 6.0, *BAND)]}, None),
    ],
)
def test_report_explains_a_large_sigma_of_the_yaw(standstill: dict[str, Points], found: str | None):
    explanations = [text for text in report_lines(replayed(standstill)) if text.startswith("no rest")]
    assert [text.partition(", so ")[0] for text in explanations] == ([] if found is None else [found])
    assert all("begin a recording with 3 s at rest" in text for text in explanations)


@pytest.mark.parametrize(
    ("factor", "is_far"), [(1.49, False), (1.51, True), (1.0 / 1.49, False), (1.0 / 1.51, True)]
)
def test_sigmas_are_said_to_fit_that_are_wrong_by_more_than_a_factor_of_1_5(factor: float, is_far: bool):
    found = replayed({"flow": [(float(second), 3.0 * factor**2, *BAND) for second in range(20)]})
    nan_band = (math.nan, math.nan)
    found.health = (SourceHealth("flow", 10.0, 0.0, 3.0 * factor**2, nan_band, 3, 200, 0, 0, 0, ""),)
    found.sigmas = {"flow": np.full(3, 0.1)}
    lines = [text for text in report_lines(found) if text.startswith("would fit: [velocity.flow]")]
    assert bool(lines) == is_far


@pytest.mark.parametrize(
    ("least", "labels"), [(0.13, "0.1 0.2 0.5 1 2 5"), (1e-4, "0.0001 0.001 0.01 0.1 1")]
)
def test_labels_of_the_nis_are_plain_numbers_with_room_between_them(least: float, labels: str):
    figure = odometry_figure(replayed({"wheels": [(0.0, least, *BAND), (15.0, 1.0, *BAND)]}), "r1")
    axis = figure.axes[1].yaxis
    low, high = axis.get_view_interval()
    ticks = sorted([*axis.get_majorticklocs(), *axis.get_minorticklocs()])
    shown = {tick: axis.get_major_formatter()(tick) for tick in ticks if low <= tick <= high}
    assert " ".join(shown.values()) == labels
