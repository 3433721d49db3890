"""What some tests need beside pip's packages: a marker, a probe, and how to install it."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from oracles import ORACLES

DEBIAN_PYTHON = "/usr/bin/python3"
CHROMIUM = "/usr/bin/chromium-headless-shell"


class Requirement(NamedTuple):
    """``is_met()`` is asked once in a run, and only if a selected test has the marker."""

    is_met: Callable[[], bool]
    install: str


def has_programs(*names: str) -> bool:
    return all(shutil.which(name) for name in names)


def is_permitted(*command: str) -> bool:
    return (
        has_programs(command[0]) and not subprocess.run(command, capture_output=True, check=False).returncode
    )


def can_create_namespaces() -> bool:
    name = f"zstate-probe-{os.getpid()}"
    if not is_permitted("ip", "netns", "add", name):
        return False
    return is_permitted("ip", "netns", "delete", name)


def debian_imports(modules: str) -> bool:
    """Whether Debian's Python, in the version of this one, imports ``modules``."""
    return is_permitted(
        DEBIAN_PYTHON, "-c", f"import {modules}, sys; assert sys.version_info[:2] == {sys.version_info[:2]}"
    )


def has_oracle(name: str) -> bool:
    return Path(os.environ.get(ORACLES[name].variable, "")).is_file()


REQUIREMENTS = {
    "browser": Requirement(
        lambda: Path(CHROMIUM).exists() and importlib.util.find_spec("playwright") is not None,
        "apt-get install chromium-headless-shell fonts-dejavu-core",
    ),
    "gcc": Requirement(
        lambda: has_programs("gcc") and Path("/usr/include/linux/videodev2.h").exists(),
        "apt-get install gcc libc6-dev",
    ),
    "shells": Requirement(lambda: has_programs("zsh", "fish"), "apt-get install zsh fish"),
    "netns": Requirement(
        lambda: has_programs("nft") and can_create_namespaces(),
        "apt-get install iproute2 nftables; run as root, where network namespaces are permitted",
    ),
    "realtime": Requirement(
        lambda: is_permitted("chrt", "--fifo", "50", "true"),
        "run as root, where real-time scheduling is permitted",
    ),
    "disk": Requirement(
        lambda: is_permitted("unshare", "--mount", "mount", "-t", "tmpfs", "zstate-probe", "/mnt"),
        "run as root, where file systems may be mounted",
    ),
    "systemd": Requirement(lambda: has_programs("systemd-analyze"), "apt-get install systemd"),
    "booted": Requirement(
        lambda: (
            has_programs("systemctl")
            and debian_imports("venv")
            and is_permitted("unshare", "--mount", "--pid", "--fork", "--mount-proc", "true")
        ),
        "apt-get install systemd; run as root, where PID namespaces are permitted, on Debian 12",
    ),
    "tf2": Requirement(
        lambda: is_permitted(DEBIAN_PYTHON, "-c", "import tf2_py"), "apt-get install python3-tf2"
    ),
    "ros1": Requirement(
        lambda: has_programs("roscore") and debian_imports("rospy, sensor_msgs, tf2_ros"),
        "apt-get install python3-roslaunch ros-robot-state-publisher python3-tf2-ros python3-sensor-msgs "
        "on Debian 12, for its version of Python",
    ),
    "npm": Requirement(
        lambda: Path(os.environ.get("ZSTATE_FOXGLOVE_CLIENT", "")).is_dir() and "ZSTATE_NODE" in os.environ,
        "as .ci/run installs Foxglove's client with npm",
    ),
    "lerobot": Requirement(
        lambda: Path(os.environ.get("ZSTATE_LEROBOT_PYTHON", "")).is_file(),
        "as .ci/nightly makes an environment of lerobot, 5 GB",
    ),
    "cluster": Requirement(
        lambda: Path(os.environ.get("ZSTATE_CLUSTER_PYTHON", "")).is_file(),
        "as .ci/nightly makes an environment of Ray and moto",
    ),
} | {
    name: Requirement(
        lambda name=name: has_oracle(name),
        f"export {oracle.variable}=$(python tests/helpers/ros2/oracles.py {name} FOLDER)",
    )
    for name, oracle in ORACLES.items()
}
"""By marker."""
