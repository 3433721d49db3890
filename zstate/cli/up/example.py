"""A file for `zstate up` to begin with, which says what it is about."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

from zstate.cli.output.text_layout import in_columns
from zstate.model.coordinates import coordinate_names
from zstate.model.robot import RobotModel


def example_text(file: str, source: str, robot: str, model: RobotModel, xacro_args: Mapping[str, str]) -> str:
    """The text of ``file`` for one robot, whose model is found as ``source``."""
    args = ", ".join(f"{json.dumps(name)} = {json.dumps(value)}" for name, value in xacro_args.items())
    return _TEMPLATE.format(
        file=file,
        model=json.dumps(source),
        name=json.dumps(robot),
        robot=robot,
        joints="\n".join(f"#   {row}" for row in _joint_rows(model)),
        tip=json.dumps(_tip(model)),
        xacro_args=f"xacro_args = {{ {args} }}\n" * bool(args),
    )


def _joint_rows(model: RobotModel) -> Iterator[str]:
    joints = {joint.name: joint for joint in model.joints}
    rows: list[tuple[str, ...]] = []
    for name in coordinate_names(model):
        joint = joints.get(name)
        kind = "" if joint is None else joint.type
        unit = {"revolute": "rad", "prismatic": "m"}.get(kind)
        limits = (
            "" if joint is None or not unit else f"{joint.limits.lower:g} to {joint.limits.upper:g} {unit}"
        )
        rows.append((name, kind, limits))
    return iter(in_columns(rows) if rows else ["none"])


def _tip(model: RobotModel) -> str:
    """The link that is furthest from the root, where a tool or a camera is likely to sit."""
    depths = {model.root: 0}
    for joint in model.joints:
        depths[joint.child] = depths.get(joint.parent, 0) + 1
    return max(depths, key=lambda link: depths[link])


_TEMPLATE = """\
# What `zstate up {file}` starts; Ctrl-C ends all of it. `zstate up --help` explains every key.
# Lines that begin with # and no blank are examples: take the # away, and they count.

[parameters]                        # `zstate up {file} rate=500` changes one
source = "sine"                     # every joint swings; "joints": as your driver says on joint_states
rate = 100.0                        # samples a second

[[robot]]
model = {model}
{xacro_args}name = {name}
source = "${{source}}"
rate = "${{rate}}"
#wires = ["native", "ros2"]          # also for rviz2 and other ROS 2 nodes; needs a [router] with ros2 = true
# xacro_args = {{ NAME = "VALUE" }}  # where the model is a xacro file
#metrics = 9100                      # http://127.0.0.1:9100/metrics for Prometheus
#restart = "on-failure"              # else a failure ends everything

# Its joints, in the order of their positions:
{joints}

# Something that is fixed to the robot: the pose of source in target.
#[[static]]
#robot = {name}
#target = {tip}
#source = "camera"
#xyz = [0.05, 0.0, 0.04]             # [m]
#rpy_deg = [0.0, -90.0, 0.0]

# The same from a calibration of easy_handeye.
#[[static]]
#robot = {name}
#file = "handeye.yaml"

# A program of your own, such as the driver; anything that runs in a terminal runs here.
#[[program]]
#run = "python driver.py"
#after = {name}
#restart = "on-failure"

# Other machines come to a router; without one, everything meets on this host.
#[router]
#listen = ["tcp/0.0.0.0:7447"]
#ros2 = true

# Or this machine goes to a router that runs elsewhere.
#[network]
#mode = "client"
#connect = ["tcp/192.168.1.10:7447"]
"""
