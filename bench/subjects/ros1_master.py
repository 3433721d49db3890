"""A ROS 1 master and Debian's robot_state_publisher, on their own ports; standard library only.

``python3 -m bench.subjects.ros1_master describe FILE`` sets the parameter robot_description,
``... publishes`` exits with 0 if robot_state_publisher has started.
"""

from __future__ import annotations

import os
import subprocess
import sys
import xmlrpc.client
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.job import Job
from bench.subjects.subject import Service

PYTHON = "/usr/bin/python3"
MASTER = "/usr/bin/rosmaster"
STATE_PUBLISHER = "/usr/lib/robot_state_publisher/robot_state_publisher"
LISTENER = "/usr/lib/python3/dist-packages/tf2_ros"
MESSAGES = "/usr/lib/python3/dist-packages/sensor_msgs"
PACKAGES = ("ros-robot-state-publisher", "python3-tf2-ros", "python3-roslaunch", "python3-sensor-msgs")
INSTALL = (f"apt-get install -y --no-install-recommends {' '.join(PACKAGES)}",)
BEST = ("_publish_frequency:=1000", "_ignore_timestamp:=true")


def python() -> str | None:
    """Debian's interpreter; None unless all packages are installed."""
    installed = all(Path(path).exists() for path in (MASTER, STATE_PUBLISHER, LISTENER, MESSAGES))
    return PYTHON if installed else None


def versions(*more: str) -> dict[str, str]:
    """Versions of Debian's packages."""
    form = "-f=${Package} ${Version}\n"
    command = [
        "dpkg-query",
        "-W",
        form,
        "ros-robot-state-publisher",
        "python3-rospy",
        "python3-tf2-ros",
        *more,
    ]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return dict(line.split(" ", 1) for line in output.splitlines())


def environment(job: Job) -> Mapping[str, str]:
    """The master's address; logs go to the job's folder."""
    return {
        "ROS_MASTER_URI": f"http://127.0.0.1:{job.ports[0]}",
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": f"{job.folder}/ros",
        "ROS_LOG_DIR": f"{job.folder}/log",
    }


def services(*parameters: str) -> Callable[[Job], Sequence[Service]]:
    """The master with the description, and robot_state_publisher with ``parameters``."""

    def build(job: Job) -> Sequence[Service]:
        port = job.ports[0]
        this = (PYTHON, "-m", "bench.subjects.ros1_master")
        master = (PYTHON, MASTER, "--core", "-p", str(port))
        return (
            Service("master", master, port=port, probe=(*this, "describe", job.urdf)),
            Service("state publisher", (STATE_PUBLISHER, *parameters), probe=(*this, "publishes")),
        )

    return build


def _master() -> Any:
    return xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"])


def _describe(file: str) -> bool:
    code, *_ = _master().setParam("/bench", "/robot_description", Path(file).read_text(encoding="utf-8"))
    return bool(code == 1)


def _publishes() -> bool:
    """Whether both topics are advertised and joint states subscribed, which comes last."""
    _, _, (publishers, subscribers, _) = _master().getSystemState("/bench")
    published = {topic for topic, nodes in publishers if nodes}
    return {"/tf", "/tf_static"} <= published and any(topic == "/joint_states" for topic, _ in subscribers)


if __name__ == "__main__":
    sys.exit(not {"describe": _describe, "publishes": _publishes}[sys.argv[1]](*sys.argv[2:]))
