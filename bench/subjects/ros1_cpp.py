"""ROS 1 from Debian with a tf2_ros listener in C++, compiled from ros1_listener.cpp."""

from __future__ import annotations

from bench.environments import ROS1_LISTENER, environment_path
from bench.subjects import ros1_master
from bench.subjects.ros1 import BEST, CHAIN
from bench.subjects.subject import Roles, Subject

DEVELOPMENT = ("libtf2-ros-dev", "libroscpp-dev")
LIBRARIES = "-ltf2_ros -ltf2 -lroscpp -lrostime -lroscpp_serialization -lboost_system -lboost_thread"
FOLDER = environment_path("ros1_cpp")
COMPILE = (
    f"mkdir -p {FOLDER} && g++ -O2 -std=c++17 -shared -fPIC bench/subjects/ros1_listener.cpp "
    f"-o {FOLDER}/{ROS1_LISTENER.name} {LIBRARIES}"
)


def _python() -> str | None:
    return ros1_master.python() if ROS1_LISTENER.exists() else None


def _load() -> Roles:
    from bench.subjects import ros1_cpp_roles, ros1_roles  # noqa: PLC0415 - imported late, as the protocol requires

    return ros1_roles.Writer, ros1_cpp_roles.Reader


SUBJECT = Subject(
    name="ros1_cpp",
    title="ROS 1, C++ reader",
    settings=(
        CHAIN,
        *BEST,
        "reader: tf2_ros.Buffer and TransformListener in C++ (g++ -O2), both callbacks served by one thread; "
        "a second subscriber of /tf, called right after the listener's, calls lookupTransform(base, tip, "
        "stamp)",
        "it runs as a library in the worker's Python process and calls Python for each answer; under the "
        "busy load it therefore waits for the GIL, unlike a C++ program",
    ),
    install=(f"{ros1_master.INSTALL[0]} {' '.join(DEVELOPMENT)} g++", COMPILE),
    python=_python,
    versions=lambda: ros1_master.versions("libtf2-ros-dev"),
    load=_load,
    services=ros1_master.services(*ros1_master.BEST),
    environment=ros1_master.environment,
)
