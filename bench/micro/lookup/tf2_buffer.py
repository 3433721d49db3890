"""tf2 from Debian (``apt-get install python3-tf2-ros``), run by /usr/bin/python3.

``name`` is tf2_ros.Buffer, as in most programs; ``plan`` is its core, the cheapest call from Python.
Stamps are converted to ROS times beforehand and not counted.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import rospy
import tf2_ros
from geometry_msgs.msg import TransformStamped

sys.path.insert(0, str(Path(__file__).parent))

from worker import MotionFile, serve


def time_of(stamp: int) -> Any:
    """A stamp as a ROS time."""
    return rospy.Time(stamp // 10**9, stamp % 10**9)


def message(parent: str, child: str, stamp: int, pose: Any) -> Any:
    """One edge at one instant."""
    transform = TransformStamped()
    transform.header.frame_id, transform.child_frame_id = parent, child
    transform.header.stamp = time_of(stamp)
    position, rotation = transform.transform.translation, transform.transform.rotation
    position.x, position.y, position.z = pose[:3]
    rotation.x, rotation.y, rotation.z, rotation.w = pose[3:]
    return transform


class Robot:
    """A filled buffer."""

    def __init__(self, recorded: MotionFile, poses: Any) -> None:
        self.names = recorded.target, recorded.source
        self.edges, self.poses = recorded.edges, poses
        self.buffer = tf2_ros.Buffer(rospy.Duration(recorded.count * recorded.step * 1e-9), debug=False)
        self.first, self.step = recorded.first, recorded.step
        self.count = 0
        for parent, child, pose in recorded.statics:
            self.buffer.set_transform_static(message(parent, child, recorded.first, pose), "bench")
        for _ in recorded.stamps:
            self.insert(self.next_sample())

    def next_sample(self) -> list[Any]:
        stamp = self.first + self.count * self.step
        start = 7 * len(self.edges) * (self.count % (len(self.poses) // (7 * len(self.edges))))
        self.count += 1
        poses = [self.poses[start + 7 * n : start + 7 * n + 7] for n in range(len(self.edges))]
        return [message(*edge, stamp, pose) for edge, pose in zip(self.edges, poses)]  # noqa: B905

    def insert(self, sample: list[Any]) -> None:
        for transform in sample:
            self.buffer.set_transform(transform, "bench")


class Tf2:
    """The cases of the table."""

    @staticmethod
    def read(recorded: MotionFile) -> Any:
        return recorded.doubles("poses")

    @staticmethod
    def fill(recorded: MotionFile, samples: Any) -> Robot:
        return Robot(recorded, samples)

    @staticmethod
    def name(robot: Robot, stamps: list[int]) -> Any:
        lookup, (target, source) = robot.buffer.lookup_transform, robot.names
        return (lambda time: lookup(target, source, time)), [time_of(stamp) for stamp in stamps]

    @staticmethod
    def plan(robot: Robot, stamps: list[int]) -> Any:
        lookup, (target, source) = robot.buffer.lookup_transform_core, robot.names
        return (lambda time: lookup(target, source, time)), [time_of(stamp) for stamp in stamps]

    @staticmethod
    def future(robot: Robot, stamps: list[int]) -> Any:
        lookup, (target, source) = robot.buffer.lookup_transform, robot.names

        def lookup_error(time: Any) -> object:
            try:
                return lookup(target, source, time)
            except tf2_ros.TransformException as reason:
                return reason

        return lookup_error, [time_of(stamp + 10**12) for stamp in stamps]

    @staticmethod
    def insert(robot: Robot, stamps: list[int]) -> Any:
        return robot.insert, [robot.next_sample() for _ in stamps]


if __name__ == "__main__":
    serve(Tf2())
