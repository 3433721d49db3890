"""rclpy on Fast DDS that hears this host only, and is spun by a thread of its own."""

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
    """What ROS 2 uses for /tf_static and /robot_description, and by default."""
    if not latched:
        return QoSProfile(depth=10)
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def _spin(node: Any) -> None:
    with suppress(ExternalShutdownException):
        rclpy.spin(node)
