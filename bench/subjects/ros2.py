"""ROS 2 Kilted itself: rclpy on Fast DDS, from its wheels."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping

from bench.job import Job
from bench.subjects.subject import Roles, Subject, environment_path, venv_python, versions_there
from bench.subjects.tf_messages import NO_STATE_PUBLISHER, free_domain


def _python() -> str | None:
    """The benchmark's environment, or that of the tests with ROS 2."""
    return venv_python("ros2") or os.environ.get("ZSTATE_KILTED_PYTHON")


@functools.cache
def _versions() -> dict[str, str]:
    return versions_there(_python(), "ros-kilted-rclpy", "ros-rmw-fastrtps-cpp", "ros-fastdds")


def _environment(job: Job) -> Mapping[str, str]:
    return {
        "ROS_DOMAIN_ID": str(free_domain(job.ports)),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_LOG_DIR": f"{job.folder}/log",
    }


def _load() -> Roles:
    from bench.subjects import ros2_roles as roles  # noqa: PLC0415 - imported late, as the protocol requires

    return roles.Writer, roles.Reader


SUBJECTS = (
    Subject(
        "ros2",
        "ROS 2 messages, rclpy on Fast DDS",
        (
            "ROS 2 Kilted's own rclpy and Fast DDS, discovery LOCALHOST, Fast DDS's default transports: "
            "shared memory on, so that most bytes do not appear on loopback",
            "the writer publishes sensor_msgs/JointState (rclpy, one message object for all samples, "
            "reliable, depth 10) and tf2_msgs/TFMessage on /tf (reliable, depth 100) and /tf_static "
            "(transient local)",
            *NO_STATE_PUBLISHER,
            "reader: rclpy.spin of the default single-threaded executor; /tf reliable, depth 100, as in "
            "tf2_ros; it does not subscribe to the joint states. Kilted's experimental EventsExecutor is not "
            "used: spun outside the main thread, it blocked the process",
        ),
        (
            "apt-get install -y --no-install-recommends g++",
            f"python tests/helpers/ros2/oracles.py kilted {environment_path('ros2')}",
        ),
        python=_python,
        versions=_versions,
        load=_load,
        environment=_environment,
    ),
)
