"""What to write instead of a command line that cannot be used: ROS's words and forms, torn paths, typos."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from contextlib import suppress
from difflib import SequenceMatcher, get_close_matches
from itertools import combinations
from pathlib import Path

import click

# The words of other tools, and the commands that do the same, separated by bars.
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
    "view_frames": "tree --svg",
    "wtf": "doctor",
    "zenohd": "router",
}

# An option is suggested only where most of its letters are the same: click's own limit is 0.6.
_NEAR = 0.75

_XYZ = ("--x", "--y", "--z")
_RPY = ("--roll", "--pitch", "--yaw")
_QUATERNION = ("--qx", "--qy", "--qz", "--qw")
_FRAMES = ("--frame-id", "--child-frame-id")


def command_hint(word: str, commands: Iterable[str]) -> str:
    """The command that was probably meant by ``word``, which is none of ``commands``."""
    same = _SYNONYMS.get(word.lower().replace("-", "_"))
    if same:
        return "use " + " or ".join(f"`zstate {command}`" for command in same.split(" | "))
    near = get_close_matches(word, list(commands), n=1)
    return f"did you mean {near[0]!r}?" if near else "`zstate help` lists the commands"


def usage_hint(arguments: Sequence[str], error: click.UsageError) -> str:
    """The cause of ``error`` and the mend, where they are better known than click knows them; else empty."""
    return _torn_path(arguments) or _ros_static(arguments) or _unknown_option(error)


def _torn_path(arguments: Sequence[str]) -> str:
    """A path with a space in it, which the shell has made several arguments of."""
    for first, end in combinations(range(len(arguments) + 1), 2):
        path = " ".join(arguments[first:end])
        if end - first > 1 and not path.startswith("-") and _exists(path):
            return f"{path!r} is one path with a space in it; write it in quotes: {shlex.quote(path)}"
    return ""


def _exists(path: str) -> bool:
    try:
        return Path(path).exists()
    except (OSError, ValueError):
        return False


def _ros_static(arguments: Sequence[str]) -> str:
    """Both forms of ROS's static_transform_publisher after ``static``, in the form of `zstate static`."""
    if not arguments or arguments[0] != "static":
        return ""
    given = arguments[1:]
    written = _from_options(given) or _from_positions(given)
    if not written:
        return ""
    return f"that is the form of ROS's static_transform_publisher; here it is\n  zstate static {written}"


def _from_positions(given: Sequence[str]) -> str:
    """``x y z yaw pitch roll parent child``, or with ``qx qy qz qw`` for the angles."""
    numbers, frames = given[:-2], given[-2:]
    if len(numbers) not in (6, 7) or not all(map(_is_number, numbers)) or any(map(_is_number, frames)):
        return ""
    if len(numbers) == 7:
        rotation = f"--quat-xyzw {' '.join(numbers[3:])}"
    else:
        rotation = f"--rpy {' '.join(reversed(numbers[3:]))}"
    return f"{shlex.join(frames)} --xyz {' '.join(numbers[:3])} {rotation}"


def _from_options(given: Sequence[str]) -> str:
    """``--x 1 ... --frame-id parent --child-frame-id child``."""
    known = {*_XYZ, *_RPY, *_QUATERNION, *_FRAMES}
    words = [part for word in given for part in word.split("=", 1)]
    values = {name: value for name, value in zip(words[::2], words[1::2], strict=False) if name in known}
    if not values or 2 * len(values) != len(words):
        return ""
    frames = [
        values.get(name, placeholder) for name, placeholder in zip(_FRAMES, ("TARGET", "SOURCE"), strict=True)
    ]
    written = [shlex.join(frames)]
    for option, names, default in (
        ("--xyz", _XYZ, "0 0 0"),
        ("--rpy", _RPY, "0 0 0"),
        ("--quat-xyzw", _QUATERNION, "0 0 0 1"),
    ):
        if any(name in values for name in names):
            numbers = [values.get(name, zero) for name, zero in zip(names, default.split(), strict=True)]
            written.append(f"{option} {' '.join(numbers)}")
    return " ".join(written)


def _is_number(text: str) -> bool:
    with suppress(ValueError):
        float(text)
        return True
    return False


def _unknown_option(error: click.UsageError) -> str:
    """An option that does not exist, with a suggestion only where it is near."""
    if not isinstance(error, click.NoSuchOption) or not error.possibilities:
        return ""
    name = error.option_name
    near = [option for option in error.possibilities if SequenceMatcher(None, name, option).ratio() >= _NEAR]
    return f"{error.message} Did you mean {' or '.join(map(repr, near))}?" if near else error.message
