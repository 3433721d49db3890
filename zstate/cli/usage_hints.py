"""Hints for invalid command lines: names and forms of ROS tools, unquoted paths, misspelled options."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from contextlib import suppress
from difflib import SequenceMatcher, get_close_matches
from itertools import combinations
from pathlib import Path

import click

# Commands of other tools, and the equivalent ones of zstate, separated by bars.
_SYNONYMS = {
    "bag": "record | replay | info",
    "ros2_bag": "record | replay | info",
    "check_urdf": "check",
    "dummy_joint_states": "joints",
    "foxglove": "view",
    "info_urdf": "check",
    "joint_state_publisher": "joints",
    "joint_state_publisher_gui": "view ROBOT --sliders",
    "launch": "up FILE.toml",
    "list": "ls",
    "models": "robots",
    "node": "ls",
    "node_list": "ls",
    "nodes": "ls",
    "param": "config",
    "play": "replay",
    "pub": "joints | publish | static",
    "rate": "hz",
    "rmw_zenohd": "router --ros2",
    "robot_state_publisher": "publish",
    "ros1_bridge": "ros1",
    "rosbag": "record | replay | info",
    "roslaunch": "up FILE.toml",
    "rostopic": "ls | echo | hz",
    "rqt": "view | graph | plot",
    "rqt_graph": "graph",
    "rqt_plot": "plot",
    "rqt_tf_tree": "tree",
    "run": "up FILE.toml",
    "rviz": "view",
    "rviz2": "view",
    "start": "up FILE.toml | publish | demo",
    "state_publisher": "publish",
    "static_transform_publisher": "static",
    "status": "doctor",
    "tf2": "tf",
    "tf2_echo": "tf",
    "tf2_monitor": "monitor",
    "tf2_tools": "tree",
    "tf_echo": "tf",
    "topic": "ls | echo | hz",
    "topics": "ls",
    "transform_broadcaster": "transform",
    "view_frames": "tree --svg",
    "wtf": "doctor",
    "zenohd": "router",
}

# The least similarity of a suggested option; click's own limit is 0.6.
_NEAR = 0.75

_XYZ = ("--x", "--y", "--z")
_RPY = ("--roll", "--pitch", "--yaw")
_QUATERNION = ("--qx", "--qy", "--qz", "--qw")


def command_hint(name: str, commands: Iterable[str]) -> str:
    """A suggestion for ``name``, which is none of ``commands``."""
    same = _SYNONYMS.get(name.lower().replace("-", "_"))
    if same:
        return "use " + " or ".join(f"`zstate {command}`" for command in same.split(" | "))
    near = get_close_matches(name, list(commands), n=1)
    return f"did you mean {near[0]!r}?" if near else "`zstate help` lists the commands"


def usage_hint(arguments: Sequence[str], error: click.UsageError) -> str:
    """The cause of ``error`` and the correction; empty if click's own message is as good."""
    hint = _unquoted_path(arguments) or _ros_static_hint(arguments)
    if hint or not isinstance(error, click.NoSuchOption) or not error.possibilities:
        return hint
    # An unknown option, with suggestions only if they are similar.
    name = error.option_name
    near = [option for option in error.possibilities if SequenceMatcher(None, name, option).ratio() >= _NEAR]
    return f"{error.message} Did you mean {' or '.join(map(repr, near))}?" if near else error.message


def _unquoted_path(arguments: Sequence[str]) -> str:
    """A hint for a path with a space, which the shell has split into several arguments."""
    for first, end in combinations(range(len(arguments) + 1), 2):
        path = " ".join(arguments[first:end])
        with suppress(OSError, ValueError):  # no path
            if end - first > 1 and not path.startswith("-") and Path(path).exists():
                return f"{path!r} is one path with a space in it; write it in quotes: {shlex.quote(path)}"
    return ""


def _ros_static_hint(arguments: Sequence[str]) -> str:
    """Arguments of ROS's static_transform_publisher, in either form, as arguments of `zstate static`."""
    if not arguments or arguments[0] != "static":
        return ""
    static = _from_options(arguments[1:]) or _from_positions(arguments[1:])
    form = "that is the form of ROS's static_transform_publisher; here it is"
    return f"{form}\n  zstate static {static}" if static else ""


def _from_positions(arguments: Sequence[str]) -> str:
    """``x y z yaw pitch roll parent child``, or with ``qx qy qz qw`` for the angles."""
    numbers, frames = arguments[:-2], arguments[-2:]
    if len(numbers) not in (6, 7) or not all(map(_is_number, numbers)) or any(map(_is_number, frames)):
        return ""
    rotation = ("--quat-xyzw", *numbers[3:]) if len(numbers) == 7 else ("--rpy", *numbers[:2:-1])
    return f"{shlex.join(frames)} --xyz {' '.join((*numbers[:3], *rotation))}"


def _from_options(arguments: Sequence[str]) -> str:
    """``--x 1 ... --frame-id parent --child-frame-id child``."""
    options = {*_XYZ, *_RPY, *_QUATERNION, "--frame-id", "--child-frame-id"}
    parts = [part for argument in arguments for part in argument.split("=", 1)]
    values = {name: value for name, value in zip(parts[::2], parts[1::2], strict=False) if name in options}
    if not values or 2 * len(values) != len(parts):
        return ""
    frames = values.get("--frame-id", "TARGET"), values.get("--child-frame-id", "SOURCE")
    static = [shlex.join(frames)]
    for option, names, default in (
        ("--xyz", _XYZ, "0 0 0"),
        ("--rpy", _RPY, "0 0 0"),
        ("--quat-xyzw", _QUATERNION, "0 0 0 1"),
    ):
        if any(name in values for name in names):
            numbers = [values.get(name, zero) for name, zero in zip(names, default.split(), strict=True)]
            static.append(f"{option} {' '.join(numbers)}")
    return " ".join(static)


def _is_number(text: str) -> bool:
    with suppress(ValueError):
        float(text)
        return True
    return False
