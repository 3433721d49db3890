"""ROS 1 from Debian: master, robot_state_publisher, tf2_ros in Python or C++; standard library only.

``python3 -m bench.subjects.ros1 describe FILE`` sets the parameter robot_description, ``... publishes`` exits
with 0 if robot_state_publisher has started.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from bench.job import Job
from bench.subjects.subject import ENVIRONMENTS, Roles, Service, Subject, environment_path

PYTHON = "/usr/bin/python3"
MASTER = "/usr/bin/rosmaster"
STATE_PUBLISHER = "/usr/lib/robot_state_publisher/robot_state_publisher"
MODULES = Path("/usr/lib/python3/dist-packages")
NEEDED = (Path(MASTER), Path(STATE_PUBLISHER), MODULES / "tf2_ros", MODULES / "sensor_msgs")
PACKAGES = "ros-robot-state-publisher python3-tf2-ros python3-roslaunch python3-sensor-msgs"
INSTALL = f"apt-get install -y --no-install-recommends {PACKAGES}"
BEST = ("_publish_frequency:=1000", "_ignore_timestamp:=true")

LISTENER = ENVIRONMENTS / "ros1_cpp" / "libros1_listener.so"
"""The compiled ``ros1_listener.cpp``."""
LIBRARIES = "-ltf2_ros -ltf2 -lroscpp -lrostime -lroscpp_serialization -lboost_system -lboost_thread"
COMPILE = (
    f"mkdir -p {environment_path('ros1_cpp')} && g++ -O2 -std=c++17 -shared -fPIC "
    f"bench/subjects/ros1_listener.cpp -o {environment_path('ros1_cpp')}/{LISTENER.name} {LIBRARIES}"
)

CHAIN = (
    "Debian's ROS 1 (Noetic): a rospy node publishes sensor_msgs/JointState, robot_state_publisher (C++) "
    "turns it into /tf; rosmaster alone, without rosout. That state publisher asks the master for tf_prefix "
    "at each joint state: the master's CPU belongs to the chain"
)
BEST_SETTINGS = (
    "robot_state_publisher: publish_frequency 1000, ignore_timestamp true; it keeps one joint state waiting",
    "tcpNoDelay everywhere; the writer publishes in its own thread (queue_size None), with one message "
    "object for all samples",
)
PYTHON_READER = (
    "reader: tf2_ros.Buffer and TransformListener, which queues without limit; a second subscriber of /tf, "
    "called right after the listener's, calls lookup_transform_core(base, tip, stamp): no polling"
)


def python() -> str | None:
    """Debian's interpreter; None unless all packages are installed."""
    return PYTHON if all(path.exists() for path in NEEDED) else None


def versions(*more: str) -> dict[str, str]:
    """Versions of Debian's packages."""
    command = ["dpkg-query", "-W", "-f=${Package} ${Version}\n", "ros-robot-state-publisher"]
    command += ["python3-rospy", "python3-tf2-ros", *more]
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


def services(parameters: Sequence[str], job: Job) -> Sequence[Service]:
    """The master with the description, and robot_state_publisher with ``parameters``."""
    this = (PYTHON, "-m", "bench.subjects.ros1")
    master = (PYTHON, MASTER, "--core", "-p", str(job.ports[0]))
    return (
        Service("master", master, port=job.ports[0], probe=(*this, "describe", job.urdf)),
        Service("state publisher", (STATE_PUBLISHER, *parameters), probe=(*this, "publishes")),
    )


def _load() -> Roles:
    from bench.subjects import ros1_roles as roles  # noqa: PLC0415 - imported late, as the protocol requires

    return roles.Writer, roles.Reader


def _load_cpp() -> Roles:
    from bench.subjects import ros1_roles as roles  # noqa: PLC0415 - as above

    return roles.Writer, roles.CppReader


def _load_default() -> Roles:
    from bench.subjects import ros1_roles as roles  # noqa: PLC0415 - as above

    return partial(roles.Writer, nodelay=False, queue_size=10), partial(roles.Reader, nodelay=False)


def _subject(
    name: str,
    title: str,
    settings: Sequence[str],
    load: Callable[[], Roles],
    parameters: Sequence[str] = BEST,
    **others: Any,
) -> Subject:
    usual = {"install": (INSTALL,), "python": python, "versions": versions, "environment": environment}
    chosen = {**usual, "services": partial(services, parameters), **others}
    return Subject(name, title, (CHAIN, *settings), load=load, **chosen)


SUBJECTS = (
    _subject("ros1", "ROS 1, Python reader", (*BEST_SETTINGS, PYTHON_READER), _load),
    _subject(
        "ros1_cpp",
        "ROS 1, C++ reader",
        (
            *BEST_SETTINGS,
            "reader: tf2_ros.Buffer and TransformListener in C++ (g++ -O2), both callbacks served by one "
            "thread; a second subscriber of /tf, called right after the listener's, calls "
            "lookupTransform(base, tip, stamp)",
            "it runs as a library in the worker's Python process, whose memory counts, and calls Python for "
            "each answer",
        ),
        _load_cpp,
        install=(f"{INSTALL} libtf2-ros-dev libroscpp-dev g++", COMPILE),
        python=lambda: python() if LISTENER.exists() else None,
        versions=lambda: versions("libtf2-ros-dev"),
    ),
    _subject(
        "ros1_default",
        "ROS 1, Python reader, default settings",
        (
            "robot_state_publisher: publish_frequency 50, ignore_timestamp false: it drops joint states "
            "above that rate, by design; they count as lost here",
            "without tcpNoDelay, except in robot_state_publisher's subscription, which requests it; the "
            "writer publishes with queue_size=10, as the tutorials do",
            PYTHON_READER,
        ),
        _load_default,
        parameters=(),
    ),
)


def _master() -> Any:
    import xmlrpc.client  # noqa: PLC0415 - 5 MB, and each worker imports this module

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
