"""An rclpy node on Fast DDS that discovers this host only, spun by its own thread."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["RMW_IMPLEMENTATION"] = "rmw_fastrtps_cpp"
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile


@contextmanager
def spinning_node(name: str, domain: int) -> Iterator[Any]:
    rclpy.init(domain_id=domain)
    node = rclpy.create_node(name)
    thread = threading.Thread(target=_spin, args=(node,))
    thread.start()
    try:
        yield node
    finally:
        rclpy.shutdown()
        thread.join()


def qos(latched: bool) -> QoSProfile:
    """The QoS of /tf_static and /robot_description if ``latched``, otherwise ROS 2's default."""
    if not latched:
        return QoSProfile(depth=10)
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def _spin(node: Any) -> None:
    with suppress(ExternalShutdownException):
        rclpy.spin(node)
