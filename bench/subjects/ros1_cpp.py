"""ROS 1 from Debian with a tf2_ros listener in C++, compiled from ros1_listener.cpp."""

from __future__ import annotations

from bench.home import HOME, place
from bench.subjects import ros1_world
from bench.subjects.ros1 import BEST, CHAIN
from bench.subjects.subject import Roles, Subject

LIBRARY = HOME / "ros1_cpp" / "libros1_listener.so"
DEVELOPMENT = ("libtf2-ros-dev", "libroscpp-dev")
LIBRARIES = "-ltf2_ros -ltf2 -lroscpp -lrostime -lroscpp_serialization -lboost_system -lboost_thread"
COMPILE = (
    f"mkdir -p {place('ros1_cpp')} && g++ -O2 -std=c++17 -shared -fPIC bench/subjects/ros1_listener.cpp "
    f"-o {place('ros1_cpp')}/{LIBRARY.name} {LIBRARIES}"
)


def _python() -> str | None:
    return ros1_world.python() if LIBRARY.exists() else None


def _load() -> Roles:
    from bench.subjects import ros1_cpp_roles, ros1_roles  # noqa: PLC0415 - as late as the protocol asks

    return ros1_roles.Writer, ros1_cpp_roles.Reader


SUBJECT = Subject(
    name="ros1_cpp",
    title="ROS 1, C++ reader",
    settings=(
        CHAIN,
        *BEST,
        "reader: tf2_ros.Buffer and TransformListener in C++ (g++ -O2), both callbacks served by one thread; "
        "a second subscriber of /tf, called right after the listener's, asks lookupTransform(base, tip, "
        "stamp)",
        "it runs as a library in the harness's Python process, which its answers are handed to: a call into "
        "Python for each; under the busy load it therefore waits for the GIL, as a C++ program would not",
    ),
    install=(f"{ros1_world.INSTALL[0]} {' '.join(DEVELOPMENT)} g++", COMPILE),
    python=_python,
    versions=lambda: ros1_world.versions("libtf2-ros-dev"),
    load=_load,
    services=ros1_world.services(*ros1_world.BEST),
    environment=ros1_world.environment,
)
