"""A writer and a reader of ROS 2 in Python."""

from __future__ import annotations

import threading
from array import array
from contextlib import suppress
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

from bench.job import Job
from bench.subjects.subject import Answered
from bench.subjects.tf_messages import TfBytes, TfReader

JOINTS = QoSProfile(depth=10)
TF = QoSProfile(depth=100)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Writer:
    """Publishes joint states as messages and transforms as bytes, which rclpy accepts as well."""

    def __init__(self, job: Job) -> None:
        rclpy.init()
        self._node = rclpy.create_node("bench_writer")
        self._joints = self._node.create_publisher(JointState, "/joint_states", JOINTS)
        self._tf = self._node.create_publisher(TFMessage, "/tf", TF)
        static = self._node.create_publisher(TFMessage, "/tf_static", LATCHED)
        self._bytes = TfBytes(job)
        self._rows = [array("d", row) for row in job.rows]
        self._message = JointState(name=list(job.joints))
        static.publish(self._bytes.static)

    def send(self, row: int, stamp: int) -> None:
        """Joint states first, as in a real chain."""
        message = self._message
        at = message.header.stamp
        at.sec, at.nanosec = divmod(stamp, 10**9)
        message.position = self._rows[row]
        self._joints.publish(message)
        self._tf.publish(self._bytes.message(row, stamp))

    def close(self) -> None:
        """Leaves the domain."""
        rclpy.shutdown()


class Reader(TfReader):
    """Receives the messages of one domain."""

    def __init__(self, job: Job, answered: Answered) -> None:
        super().__init__(job, answered)
        rclpy.init()
        node = rclpy.create_node("bench_reader")
        self._subscriptions = [
            node.create_subscription(TFMessage, "/tf", self.on_transforms, TF),
            node.create_subscription(TFMessage, "/tf_static", self.on_statics, LATCHED),
        ]
        self._thread = threading.Thread(target=self._spin, args=(node,), daemon=True)
        self._thread.start()

    def _spin(self, node: Any) -> None:
        with suppress(ExternalShutdownException):
            rclpy.spin(node)

    def close(self) -> None:
        """Leaves the domain."""
        rclpy.shutdown()
        self._thread.join()
