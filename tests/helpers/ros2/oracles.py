"""Other implementations that the tests compare zstate's ros2 wire with, each with its own interpreter.

``python oracles.py NAME FOLDER`` creates the environment of one of them in FOLDER with uv, which the extra
``lint`` installs. It prints the path of the interpreter: the value of the variable that the tests read.

=========  ==========================  ============================================================
NAME       variable                    implementation
=========  ==========================  ============================================================
sdk        ZSTATE_ROS2_SDK_PYTHON      zenoh-ros2-sdk
pyzeros    ZSTATE_PYZEROS_PYTHON       pyzeros; compiles for some seconds, once
kilted     ZSTATE_KILTED_PYTHON        genuine ROS 2 Kilted, on Fast DDS; needs g++
=========  ==========================  ============================================================
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import NamedTuple

from message_texts import write_messages

HERE = Path(__file__).parent


class Oracle(NamedTuple):
    """An environment: the variable with the path of its interpreter, and its packages."""

    variable: str
    packages: tuple[str, ...]


_ZENOH = "eclipse-zenoh>=1.10.2,<1.11"
_KILTED = ("rclpy[fastrtps]", "sensor-msgs", "nav-msgs", "geometry-msgs", "std-msgs", "rosgraph-msgs")
# Generators and build tools for tf2_msgs, which has no wheel.
_AMENT = (
    "ament-package",
    "ament-cmake",
    "ament-cmake-include-directories",
    "ament-cmake-ros-core",
    "rosidl-core-generators",
    "rosidl-default-generators",
)
_TOOLS = ("catkin-pkg", "cmake<4", "ninja", "xxhash")
ORACLES = {
    "sdk": Oracle("ZSTATE_ROS2_SDK_PYTHON", ("zenoh-ros2-sdk==0.1.8", "rosbags>=0.11,<0.12", _ZENOH)),
    "pyzeros": Oracle("ZSTATE_PYZEROS_PYTHON", ("pyzeros==0.1.0", _ZENOH)),
    "kilted": Oracle(
        "ZSTATE_KILTED_PYTHON",
        (*(f"ros-kilted-{name}" for name in _KILTED + _AMENT), *_TOOLS, _ZENOH),
    ),
}

_CMAKE = """\
cmake_minimum_required(VERSION 3.20)
project(tf2_msgs C CXX)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(geometry_msgs REQUIRED)
rosidl_generate_interfaces(tf2_msgs msg/TFMessage.msg DEPENDENCIES geometry_msgs)
ament_package()
"""
_PACKAGE = """\
<package format="3">
  <name>tf2_msgs</name>
  <version>0.0.0</version>
  <description>TFMessage, generated as every ROS 2 message is</description>
  <maintainer email="nobody@example.com">nobody</maintainer>
  <license>Apache-2.0</license>
  <depend>geometry_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""


def make(name: str, folder: Path) -> Path:
    """Creates the environment ``name`` in ``folder``; returns its interpreter."""
    uv, python = [sys.executable, "-m", "uv"], folder / "bin" / "python"
    subprocess.run([*uv, "venv", "-q", "--python", sys.executable, str(folder)], check=True)
    install = [*uv, "pip", "install", "-q", "--python", str(python), *ORACLES[name].packages]
    subprocess.run(install, check=True, stdout=sys.stderr)
    finish = {"kilted": _build_tf2_msgs, "pyzeros": _compile_attachment}.get(name)
    if finish:
        finish(folder, python)
    return python


def _compile_attachment(_folder: Path, python: Path) -> None:
    """Compiles here, once, so that the first test does not have to; optimised it would take twice as long."""
    peer, environment = str(HERE / "pyzeros_peer.py"), {**os.environ, "CFLAGS": "-O0"}
    subprocess.run([str(python), peer], check=True, stdout=sys.stderr, env=environment)


def _build_tf2_msgs(folder: Path, python: Path) -> None:
    """Generates tf2_msgs/msg/TFMessage with the generators of ROS 2, and installs it in ``folder``."""
    _mend_exports(folder, python)
    with tempfile.TemporaryDirectory() as temporary:
        source, build = Path(temporary, "tf2_msgs"), Path(temporary, "build")
        write_messages(source.parent, "tf2_msgs/msg/TFMessage")
        (source / "CMakeLists.txt").write_text(_CMAKE)
        (source / "package.xml").write_text(_PACKAGE)
        prefix = str(folder.resolve())
        path = f"{prefix}/bin{os.pathsep}{os.environ['PATH']}"
        environment = {**os.environ, "PATH": path, "AMENT_PREFIX_PATH": prefix, "CMAKE_PREFIX_PATH": prefix}
        form = [f"-DCMAKE_INSTALL_PREFIX={prefix}", f"-DPython3_EXECUTABLE={prefix}/bin/python"]
        for command in (
            ["cmake", "-G", "Ninja", "-S", str(source), "-B", str(build), "-DBUILD_TESTING=OFF", *form],
            ["cmake", "--build", str(build), "--target", "install"],
        ):
            subprocess.run(command, check=True, stdout=sys.stderr, env=environment)


def _mend_exports(folder: Path, python: Path) -> None:
    """Corrects include folders: the wheels have those of the machine that they were built on."""
    ask = [str(python), "-c", "import numpy; print(numpy.get_include())"]
    numpy = subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip()
    for file in folder.glob("share/*/cmake/*.cmake"):
        text = file.read_text()
        mended = re.sub(r'/opt/python/[^;"]*/numpy/_core/include', numpy, text)
        mended = re.sub(r'/opt/python/[^;"]*/include/python3\.\d+', sysconfig.get_path("include"), mended)
        if mended != text:
            file.unlink()  # it may be one file with that in uv's cache, which others install from
            file.write_text(mended)


if __name__ == "__main__":
    print(make(sys.argv[1], Path(sys.argv[2])))
