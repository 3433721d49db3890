"""zstate init: writes a commented first file for `zstate up`."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli.options import load_robot, name_option, xacro_arguments
from zstate.cli.output.console import fail, print_result, print_status
from zstate.cli.output.text_layout import in_columns

if TYPE_CHECKING:
    from zstate.model.robot import RobotModel


@click.command("init")
@click.argument("robot", default="rrbot", metavar="[ROBOT]")
@xacro_arguments
@click.option("-o", "--output", metavar="FILE", help="Where to; default: NAME.toml, - for standard output.")
@click.option("--force", is_flag=True, help="Also where there is such a file already.")
@name_option
def init_command(
    robot: str, xacro_args: dict[str, str], output: str | None, force: bool, name: str | None
) -> None:
    """Write a commented file for ROBOT, which `zstate up` runs as it is.

    ROBOT is a name such as panda, or a URDF or xacro file; rrbot, which comes with zstate, unless given.
    NAME:=VALUE are xacro arguments.

    \b
    zstate init panda
    zstate up panda.toml
    zstate init arm.urdf -o cell.toml
    zstate init arm.urdf.xacro prefix:=left_
    """
    from zstate.model.load import is_path

    model, called = load_robot(robot, name, xacro_args)
    file = Path(output if output not in (None, "-") else f"{called}.toml")
    source = os.path.relpath(robot, file.parent) if is_path(robot) else robot
    text = _cell_file_text(shlex.quote(file.name), source, called, model, xacro_args)
    if output == "-":
        print_result(text.rstrip("\n"))
        return
    try:
        with file.open("w" if force else "x", encoding="utf-8") as written:
            written.write(text)
    except FileExistsError:
        fail(f"{str(file)!r} exists; --force replaces it, -o FILE writes another")
    except OSError as error:
        fail(f"{str(file)!r} cannot be written: {error.strerror}")
    print_status(f"wrote {file}; start it with `zstate up {shlex.quote(str(file))}`")


def _cell_file_text(
    file: str, source: str, robot: str, model: RobotModel, xacro_args: Mapping[str, str]
) -> str:
    """The text of ``file`` for one robot; ``source`` is its model as a child process finds it."""
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


def _joint_rows(model: RobotModel) -> Sequence[str]:
    from zstate.model.robot import coordinate_names

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
    return list(in_columns(rows)) if rows else ["none"]


def _tip(model: RobotModel) -> str:
    """The link furthest from the root, where a tool or a camera is likely to be mounted."""
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
