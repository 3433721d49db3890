"""Publishers of IMUs, velocities, fixes, magnetic fields and odometry, read back from the network."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import wait_for_stream_readers
from helpers.tokens import current_tokens

from zstate.clock import ManualClock
from zstate.errors import Closed, InvalidInput, LookupFailed, SecondWriter
from zstate.net.discovery import discover
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.nodes.listener import TransformListener
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import (
    FixPublisher,
    ImuPublisher,
    MagneticFieldPublisher,
    OdometryPublisher,
    PosePublisher,
    PressurePublisher,
    VelocityPublisher,
)
from zstate.odometry.messages import Fix, Imu, MagneticField, Odometry, Pose, Pressure, Velocity
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import Message, covariances_of, from_block
from zstate.wire.registry import get_wire

MS = 1_000_000
STILL = ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
POSE_COVARIANCE = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-3
TWIST_COVARIANCE = np.diag([6.0, 5.0, 4.0, 3.0, 2.0, 1.0]) * 1e-3


class Messages(list[Any]):
    """The messages of r1 on one stream, as they arrive."""

    def __init__(self, session: Session, stream: StreamName, wire: str = "native") -> None:
        self.refused: list[str] = []
        self._subscriber = subscribe(
            session,
            get_wire(wire),
            "r1",
            stream,
            self._on_messages,
            on_error=lambda _, text: self.refused.append(text),
        )

    def _on_messages(self, received: list[Received]) -> None:
        self.extend(one.message for one in received)

    def first(self, publish: Any) -> Message:
        """The first message; ``publish`` is repeated until the subscription is known to the publisher."""
        until(lambda: publish() or self or self.refused)
        assert not self.refused
        return self[0]


def base(x: float = 0.0, stamp: int | None = None) -> Transform:
    return Transform("odom", "base_link", (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)


def test_reading_of_an_imu_arrives_as_it_was_published(sessions):
    writer, reader = sessions
    imu = Messages(reader, "imu")
    covariance = np.diag([1.0, 2.0, 3.0])
    with ImuPublisher(writer, "r1", "chest", frame="imu_link", gyro_covariance=covariance) as publisher:
        reading = imu.first(lambda: publisher.publish([1, 2, 3], [0, 0, 9.81], 5, orientation=[0, 0, 1, 0]))
    assert isinstance(reading, Imu)
    assert (reading.stamp, reading.frame) == (5, "imu_link")
    assert from_block(reading.gyro).tolist() == [1.0, 2.0, 3.0]
    assert from_block(reading.accel).tolist() == [0.0, 0.0, 9.81]
    assert reading.orientation is not None
    assert from_block(reading.orientation).tolist() == [0.0, 0.0, 1.0, 0.0]
    assert reading.gyro_covariance is not None
    assert covariance_matrix(reading.gyro_covariance).tolist() == covariance.tolist()
    assert reading.accel_covariance is reading.orientation_covariance is None


def test_velocity_arrives_as_it_was_published(sessions):
    writer, reader = sessions
    velocities = Messages(reader, "velocity")
    with VelocityPublisher(writer, "r1", "flow", clock=ManualClock(7)) as publisher:
        both = velocities.first(lambda: publisher.publish([1, 2, 3], [4, 5, 6], covariance=TWIST_COVARIANCE))
        publisher.publish([1, 2, 3], covariance=np.eye(3))
        until(lambda: velocities[-1].angular is None)
    assert isinstance(both, Velocity)
    assert (both.stamp, both.frame) == (7, "flow")
    assert both.covariance is not None
    assert covariance_matrix(both.covariance).tolist() == TWIST_COVARIANCE.tolist()
    assert covariance_matrix(velocities[-1].covariance).tolist() == np.eye(3).tolist()


def test_pose_arrives_as_it_was_published(sessions):
    writer, reader = sessions
    poses = Messages(reader, "pose")
    with PosePublisher(writer, "r1", "mocap", clock=ManualClock(7)) as publisher:
        known = poses.first(lambda: publisher.publish(base(1.0, 5).with_covariance(POSE_COVARIANCE)))
        publisher.publish(base(2.0))
        until(lambda: poses[-1].covariance is None)
    assert isinstance(known, Pose)
    assert (known.stamp, known.parent, known.child) == (5, "odom", "base_link")
    assert from_block(known.pose).tolist() == base(1.0).pose7.tolist()
    assert known.covariance is not None
    assert covariance_matrix(known.covariance).tolist() == POSE_COVARIANCE.tolist()
    assert (poses[-1].stamp, from_block(poses[-1].pose)[0]) == (7, 2.0)


def test_stamps_are_integers_of_numpy_as_well(sessions):
    writer, reader = sessions
    poses, odometry = Messages(reader, "pose"), Messages(reader, "odometry")
    with PosePublisher(writer, "r1", "mocap") as mocap, OdometryPublisher(writer, "r1") as wheels:
        assert poses.first(lambda: mocap.publish(base(1.0), np.int64(5))).stamp == 5
        assert odometry.first(lambda: wheels.publish(base(1.0), *STILL, np.int64(6))).stamp == 6


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_fix_arrives_as_it_was_published_and_so_does_that_there_is_none(sessions, wire: str):
    writer, reader = sessions
    fixes = Messages(reader, "fix", wire)
    covariance = np.array([[1.0, 0.5, 0.0], [0.5, 2.0, 0.25], [0.0, 0.25, 9.0]])
    with FixPublisher(writer, "r1", "gps", [wire], frame="mast", clock=ManualClock(7)) as publisher:
        known = fixes.first(
            lambda: publisher.publish(
                *(47.5, -8.25, 450.0, 5),
                **{"covariance": covariance, "covariance_type": 1, "status": 2, "service": 9},
            )
        )
        publisher.publish(47.5, -8.25, covariance=covariance)
        publisher.publish(None, None, status=-1)
        until(lambda: fixes[-1].status == -1)
    assert isinstance(known, Fix)
    assert (known.stamp, known.frame) == (5, "mast")
    assert (known.latitude, known.longitude, known.altitude) == (47.5, -8.25, 450.0)
    assert (known.status, known.service, known.covariance_type) == (2, 9, 1)
    assert known.covariance is not None
    assert covariance_matrix(known.covariance).tolist() == covariance.tolist()
    level, none = fixes[-2:]
    assert (level.stamp, level.altitude, level.status, level.covariance_type) == (7, None, 0, 3)
    assert (none.latitude, none.longitude, none.covariance, none.covariance_type) == (None, None, None, 0)


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_pressure_arrives_as_it_was_published(sessions, wire: str):
    writer, reader = sessions
    pressures = Messages(reader, "pressure", wire)
    with PressurePublisher(writer, "r1", "bmp", [wire], frame="mast", clock=ManualClock(7)) as publisher:
        known = pressures.first(lambda: publisher.publish(101325.0, 5, variance=2.25))
        publisher.publish(9e4)
        until(lambda: pressures[-1].variance is None)
        for wrong in (-1.0, float("nan"), [9e4], None):
            with pytest.raises(InvalidInput, match="pressure"):
                publisher.publish(wrong)  # pyright: ignore[reportArgumentType]
        assert publisher.stats.refused == 4
    assert isinstance(known, Pressure)
    assert (known.stamp, known.frame, known.pressure, known.variance) == (5, "mast", 101325.0, 2.25)
    assert (pressures[-1].stamp, pressures[-1].pressure) == (7, 9e4)


@pytest.mark.parametrize(
    ("arguments", "options", "text"),
    [
        ((4730.5, 8.0), {}, "latitudes are within 90 degrees"),
        ((None, None), {}, r"the status is -1 \(no fix\)"),
        (([47.0], 8.0), {}, r"latitude is one number; got shape \(1,\)"),
        (("47", 8.0), {}, "latitude must be real numbers, not text"),
        ((47.0, 8.0), {"covariance": np.ones(3)}, r"covariance has shape \(3, 3\); got \(3,\)"),
        ((47.0, 8.0), {"covariance": np.eye(3), "covariance_type": 0}, "got 0 with one"),
        ((47.0, 8.0), {"status": 4}, "got 4"),
    ],
)
def test_wrong_fix_is_refused_and_counted(
    sessions, arguments: tuple[Any, ...], options: dict[str, Any], text: str
):
    with FixPublisher(sessions[0], "r1") as publisher:
        with pytest.raises(InvalidInput, match=text):
            publisher.publish(*arguments, **options)
        assert (publisher.sensor, publisher.frame) == ("fix", "fix")
        assert (publisher.stats.sent, publisher.stats.refused) == (0, 1)


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_magnetic_field_arrives_as_it_was_published(sessions, wire: str):
    writer, reader = sessions
    fields = Messages(reader, "magnetic_field", wire)
    covariance = 1e-14 * np.array([[1.0, 0.5, 0.0], [0.5, 2.0, 0.25], [0.0, 0.25, 9.0]])
    with MagneticFieldPublisher(
        writer, "r1", "mag", [wire], frame="mast", covariance=covariance, clock=ManualClock(7)
    ) as publisher:
        first = fields.first(lambda: publisher.publish([2e-5, -1e-6, -4e-5], 5))
        publisher.publish([2e-5, 0, 0])
        until(lambda: fields[-1].stamp == 7)
    assert isinstance(first, MagneticField)
    assert (first.stamp, first.frame) == (5, "mast")
    assert from_block(first.field).tolist() == [2e-5, -1e-6, -4e-5]
    assert first.covariance is not None
    assert covariance_matrix(first.covariance).tolist() == covariance.tolist()


@pytest.mark.parametrize(
    ("field", "text"),
    [
        ([21.0, 0.0, -43.0], r"at most 1; got 21.0, 0.0, -43.0, which may be microtesla \(1e-6 T\)"),
        ([2e-5, 0.0], r"field takes 3 numbers, \(x, y, z\); got shape \(2,\)"),
        ([2e-5, 0.0, np.nan], "a magnetic field of finite numbers"),
    ],
)
def test_magnetic_field_of_no_sensor_is_refused_and_counted(sessions, field: list[float], text: str):
    with MagneticFieldPublisher(sessions[0], "r1") as publisher:
        with pytest.raises(InvalidInput, match=text):
            publisher.publish(field)
        assert (publisher.sensor, publisher.frame) == ("magnetic_field", "magnetic_field")
        assert (publisher.stats.sent, publisher.stats.refused) == (0, 1)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"gyro": [1, 2]}, r"gyro takes 3 numbers, \(x, y, z\); got shape \(2,\)"),
        ({"accel": [0, 0, np.nan]}, "finite numbers"),
        ({"orientation": [0, 0, 0, 2]}, "length 1, not 2"),
        (
            {"orientation": [0, 0, 0, 1], "orientation_covariance": -np.eye(3)},
            "orientation_covariance has no negative eigenvalue",
        ),
        ({"orientation_covariance": np.eye(3)}, "needs an orientation"),
    ],
)
def test_wrong_reading_is_refused_and_counted(sessions, options: dict[str, Any], text: str):
    with ImuPublisher(sessions[0], "r1") as publisher:
        with pytest.raises(InvalidInput, match=text):
            publisher.publish(**{"gyro": [0, 0, 0], "accel": [0, 0, 9.81], **options})
        assert (publisher.stats.sent, publisher.stats.refused) == (0, 1)


def test_covariance_of_a_velocity_has_the_size_of_what_is_measured(sessions):
    with (
        VelocityPublisher(sessions[0], "r1") as publisher,
        pytest.raises(InvalidInput, match=r"covariance has shape \(3, 3\); got \(6, 6\)"),
    ):
        publisher.publish([1, 0, 0], covariance=np.eye(6))


def test_a_sensor_has_one_writer(sessions):
    first_session, second_session = sessions
    with ImuPublisher(first_session, "r1", "chest", program="driver.py"):
        until(lambda: current_tokens(second_session, "zstate/r1/@writer/**", 1.0))
        with pytest.raises(SecondWriter, match=r"driver\.py.* imu of 'r1' under the name 'chest'"):
            ImuPublisher(second_session, "r1", "chest")
        with VelocityPublisher(second_session, "r1", "chest"):  # another stream
            (robot,) = discover(second_session)
    assert [name for name, _ in (*robot.named("imu"), *robot.named("velocity"))] == ["chest", "chest"]


def test_odometry_is_a_moving_edge_with_its_covariance(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    stamps = [stamp + step * 20 * MS for step in range(3)]
    with (
        OdometryPublisher(writer, "r1") as odometry,
        TransformListener(reader, "r1", history_on_join=False) as listener,
    ):
        wait_for_stream_readers(writer, "r1", "odometry/odometry")
        for step in range(3):
            pose = base(float(step)).with_covariance((step + 1) * POSE_COVARIANCE)
            odometry.publish(pose, *STILL, stamps[step])
        buffer = listener.buffer
        until(lambda: buffer.can_lookup("odom", "base_link", stamps[-1]))
        exact = [buffer.lookup("odom", "base_link", at) for at in stamps]
        between = buffer.lookup("odom", "base_link", stamp + 30 * MS)
        listener_stats = listener.stats
    assert [(one.kind, one.translation[0]) for one in exact] == [("exact", float(step)) for step in range(3)]
    assert exact[1].covariance == pytest.approx(2 * POSE_COVARIANCE)
    assert (between.kind, between.translation[0]) == ("interpolated", 1.5)
    assert (listener_stats.received, listener_stats.recalled) == (3, 0)


def test_message_of_odometry_has_pose_twist_and_both_covariances(sessions):
    writer, reader = sessions
    samples = Messages(reader, "odometry")
    pose = base(2.0, stamp=5).with_covariance(POSE_COVARIANCE)
    with OdometryPublisher(writer, "r1") as odometry:
        sample = samples.first(
            lambda: odometry.publish(pose, [1, 2, 3], [4, 5, 6], twist_covariance=TWIST_COVARIANCE)
        )
    assert isinstance(sample, Odometry)
    assert (sample.stamp, sample.edges) == (5, (("odom", "base_link"),))
    assert from_block(sample.twist).tolist() == [1, 2, 3, 4, 5, 6]
    assert sample.twist_covariance is not None
    assert covariance_matrix(sample.twist_covariance).tolist() == TWIST_COVARIANCE.tolist()
    covariances = covariances_of(sample)
    assert covariances is not None
    assert covariance_matrix(covariances.tobytes()).tolist() == POSE_COVARIANCE.tolist()


def test_odometry_in_ros_is_a_message_and_an_edge_on_tf(sessions):
    writer, reader = sessions
    samples = Messages(reader, "odometry", "ros2")
    pose = base(2.0, stamp=5).with_covariance(POSE_COVARIANCE)
    with (
        TransformListener(reader, "r1", wire="ros2", follow="tf") as listener,
        OdometryPublisher(writer, "r1", "odom", "ros2") as odometry,
    ):
        sample = samples.first(lambda: odometry.publish(pose, [1, 2, 3], [4, 5, 6]))
        assert listener.buffer.wait("odom", "base_link", 5, timeout_s=DEADLINE_S).translation[0] == 2.0
        (robot,) = discover(reader, wire="ros2")
    assert isinstance(sample, Odometry)
    assert sample.edges == (("odom", "base_link"),)
    assert from_block(sample.twist).tolist() == [1, 2, 3, 4, 5, 6]
    assert (sample.covariances is None, sample.twist_covariance) == (False, None)
    assert {stream for stream, _ in robot.writers} == {"odometry", "tf"}


def test_late_listener_gets_the_odometry_of_the_last_seconds(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    with OdometryPublisher(writer, "r1") as odometry:
        for step in range(300):  # more than a page
            odometry.publish(base(float(step)), *STILL, stamp + step * MS)
        with TransformListener(reader, "r1") as late:
            until(lambda: late.stats.recalled + late.stats.received == 300)
            poses, valid = late.buffer.lookup_many("odom", "base_link", stamp + MS * np.arange(300))
    assert valid.all()
    assert poses[:, 0].tolist() == [float(step) for step in range(300)]


@pytest.mark.parametrize("kinds", [(OdometryPublisher, TransformPublisher), (OdometryPublisher,) * 2])
def test_an_edge_has_one_writer_of_odometry_or_of_transforms(sessions, kinds):
    def publish(publisher: OdometryPublisher | TransformPublisher) -> None:
        if isinstance(publisher, OdometryPublisher):
            publisher.publish(base(), *STILL)
        else:
            publisher.publish([base()])

    for first_kind, second_kind in (kinds, kinds[::-1]):
        with (
            first_kind(sessions[0], "r1", "wheels") as first,
            second_kind(sessions[1], "r1", "visual") as second,
        ):
            publish(first)
            with pytest.raises(
                SecondWriter, match=r"places 'r1/base_link' on 'r1/odom' already, as 'wheels'"
            ):
                # At once, or if the token of the first is still on the way when its next sample has arrived.
                until(lambda first=first, second=second: publish(first) or publish(second))
            publish(first)


def test_closed_publisher_raises_closed(sessions):
    odometry, imu = OdometryPublisher(sessions[0], "r1"), ImuPublisher(sessions[0], "r1")
    odometry.close()
    imu.close()
    with pytest.raises(Closed, match="the odometry publisher 'odometry' is closed"):
        odometry.publish(base(), *STILL)
    with pytest.raises(Closed, match="the imu publisher 'imu' is closed"):
        imu.publish([0, 0, 0], [0, 0, 9.81])


def test_events_and_robots_name_the_writer_of_odometry(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener, OdometryPublisher(writer, "r1", "wheels"):
        until(listener.events)
        (event,) = listener.events()
        (robot,) = discover(reader)
    assert (event.kind, event.stream) == ("joined", "odometry")
    assert [name for name, _ in robot.named("odometry")] == ["wheels"]


def x_of(listener: TransformListener) -> float | None:
    """Where the base is now; None if that is not known."""
    with suppress(LookupFailed):
        return listener.buffer.lookup("odom", "base_link").translation[0]
    return None


def test_restarted_writer_of_odometry_begins_a_new_epoch(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    with TransformListener(reader, "r1") as listener:
        for x, begin in ((1.0, stamp), (2.0, stamp - 60_000 * MS)):  # the restarted one is a minute behind
            with OdometryPublisher(writer, "r1") as odometry:
                odometry.publish(base(x), *STILL, begin)
                until(lambda x=x: x_of(listener) == x)
                assert listener.buffer.lookup("odom", "base_link").stamp == begin
            until(lambda: not current_tokens(reader, "zstate/r1/@writer/**", 1.0))
