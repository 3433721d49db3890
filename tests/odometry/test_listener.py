"""SensorListener: readings, velocities and poses of a robot, by callbacks."""

from __future__ import annotations

import pytest
from helpers.processes import until

from zstate.errors import InvalidInput
from zstate.odometry import ImuPublisher, PosePublisher, SensorListener, VelocityPublisher
from zstate.transform import Transform
from zstate.wire.messages import Imu, Pose, Velocity


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_messages_of_all_sensors_of_the_robot_arrive_with_full_names_of_frames(sessions, wire: str):
    writer, reader = sessions
    readings: list[tuple[str, Imu]] = []
    velocities: list[tuple[str, Velocity]] = []
    poses: list[tuple[str, Pose]] = []
    base = Transform("map", "base", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    with (
        SensorListener(
            reader,
            "r1",
            on_imu=lambda sensor, imu: readings.append((sensor, imu)),
            on_velocity=lambda sensor, velocity: velocities.append((sensor, velocity)),
            on_pose=lambda sensor, pose: poses.append((sensor, pose)),
            wire=wire,
        ) as listener,
        ImuPublisher(writer, "r1", "chest", wire, frame="imu_link") as chest,
        ImuPublisher(writer, "r1", "head", wire) as head,
        VelocityPublisher(writer, "r1", "flow", wire) as flow,
        PosePublisher(writer, "r1", "mocap", wire) as mocap,
    ):

        def publish() -> bool:
            chest.publish([1, 0, 0], [0, 0, 9.81])
            head.publish([2, 0, 0], [0, 0, 9.81])
            flow.publish([3, 0, 0])
            mocap.publish(base)
            return len({sensor for sensor, _ in readings}) == 2 and bool(velocities and poses)

        until(publish)
        frames = {sensor: imu.frame for sensor, imu in readings}
        assert frames == {"chest": "r1/imu_link", "head": "r1/head"}
        assert {(sensor, one.frame) for sensor, one in velocities} == {("flow", "r1/flow")}
        child = {"native": "r1/base", "ros2": ""}[wire]  # ROS does not name it
        assert {(sensor, one.parent, one.child) for sensor, one in poses} == {("mocap", "r1/map", child)}
        assert listener.refused == {}


def test_message_that_a_callback_refuses_is_counted(sessions):
    writer, reader = sessions

    def refuse(sensor: str, _: Imu) -> None:
        raise InvalidInput(f"{sensor} is not wanted")

    with SensorListener(reader, "r1", on_imu=refuse) as listener, ImuPublisher(writer, "r1") as imu:
        until(lambda: imu.publish([0, 0, 0], [0, 0, 9.81]) or listener.refused)
        assert set(listener.refused) == {"refused"}
