"""OdometryNode: a simulated rover in this process, and its odometry over Zenoh; SensorListener."""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager

import msgspec
import numpy as np
import pytest
from helpers.drives import new_estimator
from helpers.processes import DEADLINE_S, until
from helpers.robots import STAMP

from zstate import SecondWriter, StatePublisher, TransformBuffer, TransformListener, connect, load_model
from zstate.checks import Floats
from zstate.clock import ManualClock, SystemClock
from zstate.errors import InvalidInput, Unreachable
from zstate.model.kinematics import Kinematics
from zstate.net.session import Session
from zstate.net.status_monitor import StatusMonitor
from zstate.net.subscription import Received, subscribe
from zstate.odometry import (
    BaseEstimator,
    Datum,
    DiffDrive,
    FixNoise,
    FixPublisher,
    HeadingNoise,
    ImuNoise,
    ImuPublisher,
    MagneticFieldPublisher,
    MagnetometerNoise,
    MapEstimator,
    OdometryNode,
    OdometryPublisher,
    PoseNoise,
    PosePublisher,
    PressurePublisher,
    RelativeNoise,
    SensorListener,
    VelocityNoise,
    VelocityPublisher,
)
from zstate.odometry.magnetism import EarthField
from zstate.odometry.messages import Fix, Imu, MagneticField, Odometry, Pose, Pressure, Velocity
from zstate.odometry.requests import request_odometry
from zstate.odometry.sensors import (
    Estimators,
    add_heading,
    add_magnetic_field,
    heading_covariance,
    magnetometer_covariance,
    pose_covariance,
    velocity_covariance,
)
from zstate.odometry.simulated_rover import SimulatedRover
from zstate.odometry.source_noise import SensorNoise
from zstate.rate import Rate
from zstate.sources.square_drive import WheelPair
from zstate.transform import Transform
from zstate.wire.messages import to_block
from zstate.wire.registry import get_wire

MODEL = load_model("diffbot")
NOISE = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3)
ODOM, BASE, IMU = "r1/odom", "r1/base_footprint", "r1/imu_link"


class Rover:
    """A rover that publishes its joints at 50 Hz and its IMU at 200 Hz, each while its event is set."""

    def __init__(self, session: Session) -> None:
        poses = dict(zip(MODEL.links, Kinematics(MODEL).link_poses(MODEL.neutral), strict=True))
        mount = Transform.from_pose7(BASE, IMU, poses["imu_link"])
        self.truth = SimulatedRover(WheelPair(0.08, 0.32), mount, NOISE, seed=1)
        self.has_imu, self.has_joints = threading.Event(), threading.Event()
        self.has_imu.set()
        self.has_joints.set()
        self.stop = threading.Event()
        self.ticks = 0
        self._joints = StatePublisher(session, MODEL, "r1")
        self._imu = ImuPublisher(session, "r1", "imu", frame="imu_link")
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        with self._joints, self._imu:
            for tick, stamp in enumerate(Rate(200.0, SystemClock(), self.stop)):
                for reading in self.truth.imu(stamp):
                    if self.has_imu.is_set():
                        self._imu.publish(reading.gyro, reading.accel, reading.stamp)
                if tick % 4 == 0 and self.has_joints.is_set():
                    joints = self.truth.joints(stamp)
                    self._joints.publish(joints.positions, joints.velocities, stamp=joints.stamp)
                self.ticks += 1

    def close(self) -> None:
        self.stop.set()
        self._thread.join()


@contextmanager
def rover_with_odometry(
    datum: Datum | None = None,
    **options: object,
) -> Generator[tuple[Rover, OdometryNode, TransformListener, Session]]:
    """A rover, its node in another session, and a listener in a third one."""
    with ExitStack() as opened:
        robot, estimating, reading = (opened.enter_context(connect()) for _ in range(3))
        rover = Rover(robot)
        opened.callback(rover.close)
        mounts = opened.enter_context(TransformListener(estimating, "r1")).buffer
        mounts.wait(BASE, IMU, timeout_s=DEADLINE_S)
        base = BaseEstimator(
            odom=ODOM,
            base=BASE,
            imu=IMU,
            buffer=mounts,
            imu_noise=NOISE,
            wheels=DiffDrive("left_wheel_joint", "right_wheel_joint", 0.08, 0.32),
        )
        if datum is not None:
            options["in_map"] = MapEstimator(base, map="r1/map", buffer=mounts, datum=datum)
        node = opened.enter_context(OdometryNode(estimating, "r1", base, has_joints=True, **options))  # pyright: ignore[reportArgumentType]
        listener = opened.enter_context(TransformListener(reading, "r1"))
        listener.buffer.wait(ODOM, BASE, timeout_s=DEADLINE_S)
        yield rover, node, listener, reading


@pytest.mark.long
def test_fixes_place_the_odometry_in_the_map_and_the_pose_there_has_a_covariance():
    """The rover starts 3 m east and 2 m north of the datum, and heads north."""
    datum = Datum(48.1, 11.5, 560.0)
    received: list[Pose] = []
    with rover_with_odometry(sensors=[("gps", FixNoise())], datum=datum) as (rover, node, listener, session):
        with (
            FixPublisher(session, "r1", "gps", frame="base_footprint") as gps,
            SensorListener(session, "r1", {"pose": lambda _, message: received.append(message)}),
        ):
            rover.truth.drive((4.0, 5.0))
            due = 0

            def is_in_map() -> bool:
                nonlocal due
                if rover.ticks >= due:
                    due = rover.ticks + 20
                    x, y, _ = rover.truth.pose
                    place = datum.geodetic((3.0 - y, 2.0 + x, 0.0))
                    gps.publish(*place, covariance=np.diag((0.02, 0.02, 0.05)) ** 2)
                return bool(received)

            until(is_in_map)
            rover.truth.drive((0.0, 0.0))
        at_rest = time.time_ns() + 1_000_000_000  # 20 time constants of the wheels
        listener.buffer.wait("r1/map", BASE, timeout_s=DEADLINE_S)  # the pose is a stream of its own
        until(lambda: listener.buffer.latest("r1/map", BASE) >= at_rest)
        map_from_base, pose = listener.buffer.lookup("r1/map", BASE), received[-1]
        x, y, yaw = rover.truth.pose
        assert map_from_base.translation[:2] == pytest.approx([3.0 - y, 2.0 + x], abs=0.5)
        assert math.remainder(map_from_base.rpy[2] - yaw - math.pi / 2, math.tau) == pytest.approx(
            0.0, abs=0.6
        )
        assert (pose.parent, pose.child) == ("r1/map", BASE)
        assert pose.covariance is not None
        (health,) = [one for one in node.health() if one.name == "gps"]
        assert (health.sentence, health.rejected) == ("", 0)


@pytest.mark.long
def test_odometry_follows_the_truth_and_is_a_moving_edge_with_a_covariance():
    with rover_with_odometry() as (rover, node, listener, _):
        rover.truth.drive((5.0, 8.0))
        until(lambda: rover.truth.pose.yaw > math.pi / 2)
        rover.truth.drive((0.0, 0.0))
        at_rest = time.time_ns() + 1_000_000_000  # 20 time constants of the wheels
        until(lambda: listener.buffer.latest(ODOM, BASE) >= at_rest)
        odom_from_base = listener.buffer.lookup(ODOM, BASE)
        assert _distance(rover, listener) < 0.05
        assert odom_from_base.rpy[2] == pytest.approx(rover.truth.pose.yaw, abs=0.05)
        assert odom_from_base.covariance is not None
        x_variance = odom_from_base.covariance[0, 0]
        assert 0.0 < x_variance < 0.1**2
        assert node.published > 10


def test_planar_odometry_is_level_and_has_the_height_that_it_leaves_out_in_its_covariance():
    with rover_with_odometry(planar=True) as (_, node, listener, _):
        odom_from_base = listener.buffer.lookup(ODOM, BASE)
        assert odom_from_base.translation[2] == 0.0
        assert odom_from_base.pose7[3:5].tolist() == [0.0, 0.0]
        assert odom_from_base.covariance is not None
        assert odom_from_base.covariance[2, 2] > 0.0
        state = node.state()
        assert state.odom_from_base.translation[2] == state.twist.linear[2] == 0.0
        assert node.base.state().odom_from_base.pose7[3:5].tolist() != [0.0, 0.0]


def _distance(rover: Rover, listener: TransformListener) -> float:
    x, y, _ = listener.buffer.lookup(ODOM, BASE).translation.tolist()
    return math.hypot(x - rover.truth.pose.x, y - rover.truth.pose.y)


def test_heading_of_an_imu_is_the_yaw_of_its_frame_and_needs_a_stated_noise():
    base = Recorder()
    half = 0.5 * 0.7
    orientation = to_block([0.0, 0.0, math.sin(half), math.cos(half)])
    message = Imu(STAMP, 0, 1, IMU, to_block([0.0] * 3), to_block([0.0] * 3), orientation)
    add_heading(Estimators(base), "imu", HeadingNoise(sigma_deg=2.0, gate=0.99), message)  # pyright: ignore[reportArgumentType]
    ((stamp, yaw, sigma, options),) = base.headings
    assert (stamp, options) == (STAMP, {"source": "imu heading", "frame": IMU, "gate": 0.99})
    assert (yaw, sigma) == pytest.approx((0.7, math.radians(2.0)))
    covariance = to_block(np.diag((1.0, 1.0, 0.04))[np.triu_indices(3)])
    stated = msgspec.structs.replace(message, orientation_covariance=covariance)
    assert heading_covariance("imu", HeadingNoise(), stated) == pytest.approx(0.04)
    with pytest.raises(
        InvalidInput, match="have no covariance: state their noise by `--heading imu:sigma_deg=5`"
    ):
        heading_covariance("imu", HeadingNoise(), message)
    with pytest.raises(InvalidInput, match="the IMU 'imu' sends no orientation"):
        heading_covariance("imu", HeadingNoise(), msgspec.structs.replace(message, orientation=None))


FIELD = MagneticField(1_750_000_000_000_000_000, 0, 1, "r1/mag", to_block([21e-6, 0.0, -40e-6]))
"""In June 2025."""


def test_field_of_a_magnetometer_is_calibrated_and_expected_to_be_that_of_the_earth_at_its_place():
    base = Recorder()
    noise = MagnetometerNoise(bias=(1e-6, 0.0, 0.0), place=(48.1, 11.5))
    for one in (MagnetometerNoise(), noise):
        add_magnetic_field(Estimators(base), "mag", one, FIELD)  # pyright: ignore[reportArgumentType]
    (_, raw, sigma, options), (stamp, field, _, placed) = base.fields
    assert options == {"source": "mag field", "frame": "r1/mag", "expected": None, "gate": 0.999}
    assert raw.tolist() == [21e-6, 0.0, -40e-6]
    assert sigma == pytest.approx(math.radians(5.0))
    assert (stamp, field) == (FIELD.stamp, pytest.approx([20e-6, 0.0, -40e-6]))
    expected = placed["expected"]
    assert isinstance(expected, EarthField)
    assert expected.strength == pytest.approx(48.7e-6, rel=0.02)  # of Munich


def test_noise_of_a_magnetometer_is_stated_and_a_field_in_gauss_refused():
    assert magnetometer_covariance("mag", MagnetometerNoise(sigma_deg=8.0), FIELD) == pytest.approx(
        math.radians(8.0) ** 2
    )
    in_gauss = msgspec.structs.replace(FIELD, field=to_block([0.21, 0.0, -0.4]))
    with pytest.raises(InvalidInput, match=r"'mag' is 0.452 T, and that of the Earth 2e-5 to 7e-5 T"):
        magnetometer_covariance("mag", MagnetometerNoise(), in_gauss)
    of_1970 = msgspec.structs.replace(FIELD, stamp=STAMP % 1_000_000_000)
    with pytest.raises(InvalidInput, match=r"stamps are of the year 1970.0"):
        magnetometer_covariance("mag", MagnetometerNoise(place=(48.1, 11.5)), of_1970)


@pytest.mark.long
def test_magnetometer_is_a_source_of_the_live_odometry():
    with rover_with_odometry(sensors=[("mag", MagnetometerNoise())]) as (rover, node, _, session):
        with MagneticFieldPublisher(session, "r1", "mag", frame="base_footprint") as mag:
            rover.truth.drive((-4.0, 4.0))
            published = rover.ticks

            def has_turned() -> bool:
                nonlocal published
                yaw = rover.truth.pose.yaw
                if rover.ticks >= published + 10:  # 20 Hz
                    published = rover.ticks
                    mag.publish([2e-5 * math.cos(yaw), -2e-5 * math.sin(yaw), -4e-5])
                return yaw > math.tau

            until(has_turned)
        (health,) = [one for one in node.health() if one.name == "mag field"]
        assert (health.accepted > 10, health.rejected, health.sentence) == (True, 0, "")
        assert node.refused == {}


class Recorder:
    """In place of an estimator: its calls of ``heading`` and of ``magnetic_field``."""

    def __init__(self) -> None:
        self.headings: list[tuple[int, float, float, dict[str, object]]] = []
        self.fields: list[tuple[int, Floats, float, dict[str, object]]] = []

    def magnetic_field(self, stamp: int, field: Floats, sigma: float, **options: object) -> None:
        self.fields.append((stamp, field, sigma, options))

    def heading(self, stamp: int, yaw: float, sigma: float, **options: object) -> None:
        self.headings.append((stamp, yaw, sigma, options))


def test_wheels_ahead_of_the_imu_do_not_move_the_state_beyond_its_last_reading(sessions):
    """What the base does after the last reading of its IMU is not known, and has no place in a covariance."""
    robot, estimating = sessions
    mounts = TransformBuffer()
    mounts.insert_static(Transform(BASE, IMU, (0.1, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    wheels = DiffDrive("left_wheel_joint", "right_wheel_joint", 0.08, 0.32)
    base = BaseEstimator(odom=ODOM, base=BASE, imu=IMU, buffer=mounts, imu_noise=NOISE, wheels=wheels)
    stamps: list[int] = []
    with (
        subscribe(robot, get_wire("native"), "r1", "odometry", _stamps_into(stamps)),
        StatePublisher(robot, MODEL, "r1") as joints,
        OdometryNode(estimating, "r1", base, has_joints=True) as node,
        ImuPublisher(robot, "r1", "imu", frame="imu_link") as imu,
    ):
        ticks = iter(range(STAMP, STAMP + 1_000_000_000_000, 5_000_000))
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.80665], next(ticks)) or stamps)
        last = next(ticks)
        until(lambda: stamps[-1] == last - 5_000_000)  # the node has taken all readings before

        def has_wheels() -> bool:
            for ahead in (40_000_000, 60_000_000):
                joints.publish([0.0, 0.0], [0.0, 0.0], stamp=last + ahead)
            return any(source.name == "wheels" for source in node.health())

        until(has_wheels)
        imu.publish([0, 0, 0], [0, 0, 9.80665], last)
        until(lambda: stamps[-1] >= last)
        assert stamps[-1] == last


def _stamps_into(stamps: list[int]) -> Callable[[list[Received]], None]:
    """A callback that adds the stamps of odometry that is received."""
    return lambda received: stamps.extend(
        one.message.stamp for one in received if isinstance(one.message, Odometry)
    )


def test_without_its_imu_it_goes_on_with_the_wheels_and_without_all_it_ends():
    with rover_with_odometry() as (rover, node, _, _):
        rover.has_imu.clear()
        before = node.published
        until(lambda: node.published > before + 20)
        rover.has_joints.clear()
        until(lambda: _is_silent(rover, node))


def _is_silent(rover: Rover, node: OdometryNode) -> bool:
    """Whether nothing is published during 40 ticks of the rover, in which it publishes 10 joint states."""
    before, tick = node.published, rover.ticks
    until(lambda: rover.ticks >= tick + 40)
    return node.published == before


def test_rate_limits_the_samples_of_a_faster_imu(sessions):
    robot, estimating = sessions
    mounts = TransformBuffer()
    mounts.insert_static(Transform(BASE, IMU, (0.1, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    base = BaseEstimator(odom=ODOM, base=BASE, imu=IMU, buffer=mounts, imu_noise=NOISE)
    stamps: list[int] = []
    with (
        subscribe(robot, get_wire("native"), "r1", "odometry", _stamps_into(stamps)),
        OdometryNode(estimating, "r1", base, rate_hz=20.0),
        ImuPublisher(robot, "r1", "imu", frame="imu_link") as imu,
    ):
        ticks = itertools.count(STAMP, 5_000_000)
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.80665], next(ticks)) or stamps)
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.80665], next(ticks)) or len(stamps) > 20)
    assert set(np.diff(stamps)) == {50_000_000}


@pytest.mark.long
def test_sentences_on_the_sources_are_in_the_status_of_the_writer_and_logged_once(caplog):
    with (
        rover_with_odometry(sensors=[("flow", VelocityNoise())]) as (_, _, _, session),
        StatusMonitor(session, "r1") as statuses,
        VelocityPublisher(session, "r1", "flow", frame="base_footprint") as flow,
    ):
        # A standing rover that a sensor reports to move at 1 m/s, with a sigma of 1 mm/s.
        def warned() -> bool:
            flow.publish([1.0, 0.0, 0.0], covariance=1e-6 * np.eye(3))
            texts = [one.text for one in statuses.recent("r1") if one.level == "warn"]
            return any("flow: " in text for text in texts)

        until(warned)
    logged = [record.message for record in caplog.records]
    assert sum(text.startswith("odometry of 'r1': flow: ") for text in logged) == 1


def test_velocities_without_covariance_are_refused_and_counted():
    with (
        rover_with_odometry(sensors=[("flow", VelocityNoise())]) as (_, node, _, session),
        VelocityPublisher(session, "r1", "flow", frame="base_footprint") as flow,
    ):

        def refused() -> int:
            flow.publish([1.0, 0.0, 0.0])
            return node.refused.get("refused", 0)

        until(refused)


def test_a_listener_to_a_stream_of_no_sensor_is_told_those_that_there_are(sessions):
    with pytest.raises(InvalidInput, match=r"'velocities' is no stream of sensors: .*velocity"):
        SensorListener(sessions[1], "r1", {"velocities": print})


@pytest.mark.parametrize("covariance", [None, np.zeros((3, 3)), np.diag([0.01, 0.0, 0.0])])
def test_noise_that_is_stated_is_in_place_of_that_of_messages(covariance: np.ndarray | None):
    triangle = None if covariance is None else to_block(covariance[np.triu_indices(3)])
    message = Velocity(1, 0, 1, "base", to_block([1.0, 0.0, 0.0]), None, triangle)
    stated = velocity_covariance("flow", VelocityNoise(sigma=(0.1, 0.2, 0.3)), message)
    assert np.diag(stated) == pytest.approx([0.01, 0.04, 0.09])
    why = r"velocities of 'flow' have .*: state their noise by `--velocity flow:sigma=0.05`, or sigma = 0.05"
    with pytest.raises(InvalidInput, match=why):
        velocity_covariance("flow", VelocityNoise(), message)


def test_poses_have_the_noise_of_their_messages_or_the_stated_one():
    placed = to_block([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    known = Pose(1, 0, 1, "odom", "", placed, to_block(np.eye(6)[np.triu_indices(6)]))
    assert np.array_equal(pose_covariance("mocap", PoseNoise(), known), np.eye(6))
    stated = PoseNoise(sigma=0.1, sigma_deg=(1.0, 1.0, 2.0))
    assert np.sqrt(np.diag(pose_covariance("mocap", stated, known))) == pytest.approx(
        [0.1, 0.1, 0.1, math.radians(1.0), math.radians(1.0), math.radians(2.0)]
    )
    with pytest.raises(InvalidInput, match=r"poses of 'mocap' have no covariance: .* in \[pose.mocap\]"):
        pose_covariance("mocap", PoseNoise(), Pose(1, 0, 1, "odom", "", placed))


@pytest.mark.long
def test_measured_poses_place_the_base():
    with (
        rover_with_odometry(sensors=[("mocap", PoseNoise())]) as (rover, node, listener, session),
        PosePublisher(session, "r1", "mocap") as mocap,
    ):
        measured = Transform(ODOM, BASE, [0.02, 0.0, 0.0], [0, 0, 0, 1]).with_covariance(1e-6 * np.eye(6))
        published = rover.ticks

        def is_there() -> bool:
            nonlocal published
            if rover.ticks >= published + 10:  # 20 Hz
                published = rover.ticks
                mocap.publish(measured, time.time_ns())
            x = listener.buffer.lookup(ODOM, BASE).translation[0]
            return bool(x == pytest.approx(0.02, abs=0.005))

        until(is_there)
        assert "mocap" in {source.name for source in node.health()}


def test_an_odometry_of_the_network_is_no_source_and_the_error_says_how_its_poses_are_one(sessions):
    """Both would place the base."""
    mounts = TransformBuffer()
    mounts.insert_static(Transform(BASE, IMU, (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    base = BaseEstimator(odom=ODOM, base=BASE, imu=IMU, buffer=mounts, imu_noise=NOISE)
    sensors = [("odometry/camera", RelativeNoise())]
    with pytest.raises(InvalidInput, match=r"publish its poses by PosePublisher, and name pose/camera"):
        OdometryNode(sessions[1], "r1", base, sensors=sensors)


@pytest.mark.parametrize("kind", ["pose", "odometry"])
def test_sensors_of_ros_and_another_odometry_there_are_sources_of_odometry_for_ros(sessions, kind: str):
    robot, estimating = sessions
    mounts = TransformBuffer()
    mounts.insert_static(Transform(BASE, IMU, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    start = Transform(ODOM, BASE, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    base = BaseEstimator(odom=ODOM, base=BASE, imu=IMU, buffer=mounts, imu_noise=NOISE, initial_pose=start)
    camera = [(f"{kind}/camera", RelativeNoise())]
    received: list[tuple[str, Odometry]] = []
    there = Transform("camera_odom", "base_footprint", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with (
        OdometryNode(estimating, "r1", base, sensors=camera, wires="ros2") as node,
        SensorListener(
            robot, "r1", {"odometry": lambda name, one: received.append((name, one))}, wire="ros2"
        ),
        ImuPublisher(robot, "r1", "imu", "ros2", frame="imu_link") as imu,
        PosePublisher(robot, "r1", "camera", "ros2") as poses,
        OdometryPublisher(robot, "r1", "camera", "ros2") as odometry,
    ):

        def publish() -> bool:
            imu.publish([0, 0, 0], [0, 0, 9.80665])
            if kind == "pose":
                poses.publish(there)
            else:
                odometry.publish(there, [0.0] * 3, [0.0] * 3)
            accepted = {one.name: one.accepted for one in node.health()}
            return accepted.get(f"{kind}/camera", 0) > 2 and "odometry" in {name for name, _ in received}

        until(publish)


def test_second_node_of_a_name_is_refused_with_the_first():
    with (
        rover_with_odometry() as (_, node, _, session),
        pytest.raises(SecondWriter, match=f"pid {os.getpid()}"),
    ):
        OdometryNode(session, "r1", node.base)


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_messages_of_all_sensors_of_the_robot_arrive_with_full_names_of_frames(sessions, wire: str):
    writer, reader = sessions
    readings: list[tuple[str, Imu]] = []
    velocities: list[tuple[str, Velocity]] = []
    poses: list[tuple[str, Pose]] = []
    fixes: list[tuple[str, Fix]] = []
    pressures: list[tuple[str, Pressure]] = []
    fields: list[tuple[str, MagneticField]] = []
    base = Transform("map", "base", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with (
        SensorListener(
            reader,
            "r1",
            {
                "imu": lambda sensor, imu: readings.append((sensor, imu)),
                "velocity": lambda sensor, velocity: velocities.append((sensor, velocity)),
                "pose": lambda sensor, pose: poses.append((sensor, pose)),
                "fix": lambda sensor, fix: fixes.append((sensor, fix)),
                "pressure": lambda sensor, pressure: pressures.append((sensor, pressure)),
                "magnetic_field": lambda sensor, field: fields.append((sensor, field)),
            },
            wire=wire,
        ) as listener,
        ImuPublisher(writer, "r1", "chest", wire, frame="imu_link") as chest,
        ImuPublisher(writer, "r1", "head", wire) as head,
        VelocityPublisher(writer, "r1", "flow", wire) as flow,
        PosePublisher(writer, "r1", "mocap", wire) as mocap,
        FixPublisher(writer, "r1", "gps", wire) as gps,
        PressurePublisher(writer, "r1", "bmp", wire) as barometer,
        MagneticFieldPublisher(writer, "r1", "mag", wire, frame="mast") as mag,
    ):

        def publish() -> bool:
            chest.publish([1, 0, 0], [0, 0, 9.81])
            head.publish([2, 0, 0], [0, 0, 9.81])
            flow.publish([3, 0, 0])
            mocap.publish(base)
            gps.publish(47.5, 8.25)
            barometer.publish(101325.0)
            mag.publish([2e-5, 0, -4e-5])
            others = (velocities, poses, fixes, fields, pressures)
            return len({sensor for sensor, _ in readings}) == 2 and all(others)

        until(publish)
        frames = {sensor: imu.frame for sensor, imu in readings}
        assert frames == {"chest": "r1/imu_link", "head": "r1/head"}
        assert {(sensor, one.frame) for sensor, one in velocities} == {("flow", "r1/flow")}
        assert {(sensor, one.frame, one.pressure) for sensor, one in pressures} == {
            ("bmp", "r1/bmp", 101325.0)
        }
        assert {(sensor, one.frame) for sensor, one in fields} == {("mag", "r1/mast")}
        assert {(sensor, one.frame, one.latitude) for sensor, one in fixes} == {("gps", "r1/gps", 47.5)}
        child = {"native": "r1/base", "ros2": ""}[wire]  # ROS does not name it
        assert {(sensor, one.parent, one.child) for sensor, one in poses} == {("mocap", "r1/map", child)}
        assert listener.refused == {}


def test_message_that_a_callback_refuses_is_counted(sessions):
    writer, reader = sessions

    def refuse(sensor: str, _: Imu) -> None:
        raise InvalidInput(f"{sensor} is not wanted")

    with SensorListener(reader, "r1", {"imu": refuse}) as listener, ImuPublisher(writer, "r1") as imu:
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.81]) or listener.refused)
        assert set(listener.refused) == {"refused"}


@contextmanager
def imu_to_node(
    sessions: tuple[Session, Session], **options: object
) -> Generator[tuple[ImuPublisher, OdometryNode]]:
    """A publisher of an IMU, and the node of an estimator that starts at a pose, with a manual clock."""
    robot, estimating = sessions
    mounts = TransformBuffer()
    mounts.insert_static(Transform(BASE, IMU, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    start = Transform(ODOM, BASE, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    base = BaseEstimator(odom=ODOM, base=BASE, imu=IMU, buffer=mounts, imu_noise=NOISE, initial_pose=start)
    with (
        OdometryNode(estimating, "r1", base, **options) as node,  # pyright: ignore[reportArgumentType]
        ImuPublisher(robot, "r1", "imu", frame="imu_link") as imu,
    ):
        yield imu, node


def test_stamps_of_the_future_are_refused_and_the_odometry_goes_on(sessions):
    clock = ManualClock(STAMP)
    with imu_to_node(sessions, clock=clock) as (imu, node):
        ticks = iter(range(STAMP, STAMP + 400_000_000, 10_000))

        def publish(extra: int = 0) -> None:
            imu.publish([0, 0, 0], [0, 0, 9.80665], next(ticks) + extra)

        until(lambda: publish() or node.published)
        until(lambda: publish(3_600_000_000_000) or node.refused)
        assert set(node.refused) == {"refused"}
        published = node.published
        until(lambda: publish() or node.published > published + 3)
        assert node.state().stamp < STAMP + 500_000_000


def test_a_stamp_is_of_the_future_from_half_a_second_after_the_time_of_the_clock_on(sessions):
    with imu_to_node(sessions, clock=ManualClock(STAMP)) as (imu, node):

        def publish(stamp: int) -> None:
            imu.publish([0, 0, 0], [0, 0, 9.80665], stamp)

        until(lambda: publish(STAMP + 500_000_000) or node.base.newest == STAMP + 500_000_000)
        assert node.refused == {}
        until(lambda: publish(STAMP + 500_000_001) or node.refused)
        assert node.base.newest == STAMP + 500_000_000


@pytest.mark.parametrize(("silent_ns", "count"), [(100_000_000, 1), (100_000_001, 2)])
def test_readings_of_other_sources_are_published_once_the_imu_is_silent_for_more_than_a_tenth_of_a_second(
    sessions, silent_ns: int, count: int
):
    flow = [("flow", VelocityNoise(sigma=(0.1, 0.1, 0.1)))]
    with (
        imu_to_node(sessions, clock=ManualClock(STAMP), sensors=flow) as (imu, node),
        VelocityPublisher(sessions[0], "r1", "flow", frame="base_footprint") as publisher,
    ):
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.80665], STAMP) or node.published)
        until(lambda: publisher.publish([0, 0, 0], stamp=STAMP + silent_ns) or node.base.newest > STAMP)
        node.health()  # after that reading
        assert node.published == count


@pytest.mark.long
def test_time_that_goes_back_is_published_from_there_on(sessions):
    stamps: list[int] = []
    first = STAMP - 10**11
    with (
        imu_to_node(sessions, clock=ManualClock(STAMP)) as (imu, node),
        subscribe(sessions[0], get_wire("native"), "r1", "odometry", _stamps_into(stamps)),
    ):
        for _ in range(2):
            ticks = iter(range(first, STAMP, 10_000_000))
            count = len(stamps)

            def publish() -> None:
                imu.publish([0, 0, 0], [0, 0, 9.80665], next(ticks))  # noqa: B023

            until(lambda: publish() or len(stamps) > count + 300)  # noqa: B023
        assert node.base.epoch == 1
        assert node.state().stamp < first + 99 * 10**9
    (back,) = [later for earlier, later in itertools.pairwise(stamps) if later < earlier]
    assert first < back < first + 10**10  # half a second of readings confirms it


def test_exceptions_of_a_callback_are_counted_and_the_next_messages_arrive(sessions):
    writer, reader = sessions
    calls: list[int] = []

    def fail(sensor: str, message: Imu) -> None:
        calls.append(message.stamp)
        raise ZeroDivisionError(sensor)

    with SensorListener(reader, "r1", {"imu": fail}) as listener, ImuPublisher(writer, "r1") as imu:
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.81]) or len(calls) > 2)
        until(lambda: listener.refused.get("failed with ZeroDivisionError", 0) > 2)


def test_absurd_numbers_of_an_imu_are_not_published(sessions):
    writer, _ = sessions
    with ImuPublisher(writer, "r1") as imu:
        with pytest.raises(InvalidInput, match="angular velocities"):
            imu.publish([1e154, 0, 0], [0, 0, 9.81])
        with pytest.raises(InvalidInput, match="accelerations"):
            imu.publish([0, 0, 0], [0, 0, 1e308])


def test_a_request_places_the_base_or_starts_anew_and_what_is_refused_has_its_reason(sessions):
    with imu_to_node(sessions, clock=ManualClock(STAMP)) as (imu, node):
        robot, _ = sessions
        place = Transform(ODOM, BASE, (3.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        with pytest.raises(InvalidInput, match="not aligned"):
            request_odometry(robot, "r1", "set_pose", place, timeout_s=DEADLINE_S)
        with pytest.raises(InvalidInput, match="with a pose"):
            request_odometry(robot, "r1", "set_pose", timeout_s=DEADLINE_S)
        ticks = iter(range(STAMP - 10**11, STAMP, 10_000_000))
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.80665], next(ticks)) or node.published)
        request_odometry(robot, "r1", "set_pose", place, timeout_s=DEADLINE_S)
        assert node.state().odom_from_base.translation.tolist() == pytest.approx([3.0, 1.0, 0.0], abs=0.1)
        every = [*robot.zenoh.get("zstate/*/@odometry/*?do=reset", timeout=DEADLINE_S)]
        assert [reply.err and "is for one key" in reply.err.payload.to_string() for reply in every] == [True]
        assert node.base.epoch == 0
        request_odometry(robot, "r1", "reset", timeout_s=DEADLINE_S)
        assert node.base.epoch == 1
        with pytest.raises(Unreachable, match="is `zstate odometry r1` running"):
            request_odometry(robot, "r1", "reset", writer="other", timeout_s=0.2)


@pytest.mark.parametrize(
    ("sensors", "why"),
    [
        ([("w", ImuNoise(gyro=1e-3, accel=1e-2, gyro_bias=0.0, accel_bias=0.0))], "is one of VelocityNoise,"),
        ([("w", VelocityNoise()), ("w", VelocityNoise(sigma=0.1))], "the velocity 'w' is given twice"),
        ([("camera", RelativeNoise())], "pose/NAME or odometry/NAME; got 'camera'"),
        ([("a/b", VelocityNoise())], "the writer name 'a/b' contains '/'"),
        ([("odometry/odometry", RelativeNoise())], "'odometry' is no source of itself"),
    ],
)
def test_sensors_that_cannot_be_are_refused_at_once(
    sessions, sensors: list[tuple[str, SensorNoise]], why: str
):
    with pytest.raises(InvalidInput, match=why):
        OdometryNode(sessions[0], "r1", new_estimator(), sensors=sensors)
