"""zstate init: a commented first file for `zstate up`."""

from __future__ import annotations

import json
import os
import shlex
from pathlib import Path

import click

from zstate.cli import options
from zstate.cli.options import load_robot
from zstate.cli.output.console import fail, print_result, print_status
from zstate.cli.output.text_layout import in_columns


@click.command("init")
@click.argument("robot", type=options.MODEL, default="rrbot", metavar="[ROBOT]")
@options.xacro_arguments
@click.option("-o", "--output", metavar="FILE", help="Default: NAME.toml; - is standard output.")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@options.name_option
def init_command(
    robot: str, xacro_args: dict[str, str], output: str | None, force: bool, name: str | None
) -> None:
    """Write a commented file for ROBOT that `zstate up` runs as it is.

    ROBOT is a name such as panda, or a URDF or xacro file; default: rrbot, which comes with zstate.
    NAME:=VALUE are xacro arguments.

    \b
    zstate init panda
    zstate up panda.toml
    zstate init arm.urdf -o cell.toml
    zstate init arm.urdf.xacro prefix:=left_
    """
    from zstate.model.load import is_path
    from zstate.model.robot import coordinate_names

    model, robot_name = load_robot(robot, name, xacro_args)
    file = Path(output if output not in (None, "-") else f"{robot_name}.toml")
    source = os.path.relpath(robot, file.parent) if is_path(robot) else robot
    joints = {joint.name: joint for joint in model.joints}
    rows: list[tuple[str, ...]] = []
    for coordinate in coordinate_names(model):
        kind = limits = ""
        if (joint := joints.get(coordinate)) is not None:
            kind, unit = joint.type, {"revolute": "rad", "prismatic": "m"}.get(joint.type)
            limits = f"{joint.limits.lower:g} to {joint.limits.upper:g} {unit}" if unit else ""
        rows.append((coordinate, kind, limits))
    args = ", ".join(f"{json.dumps(key)} = {json.dumps(value)}" for key, value in xacro_args.items())
    depths = {model.root: 0}
    for joint in model.joints:
        depths[joint.child] = depths.get(joint.parent, 0) + 1
    text = _TEMPLATE.format(
        file=shlex.quote(file.name),
        model=json.dumps(source),
        name=json.dumps(robot_name),
        robot=robot_name,
        joints="\n".join(f"#   {row}" for row in (in_columns(rows) if rows else ["none"])),
        # The deepest link: a tool or a camera is likely to be mounted there.
        tip=json.dumps(max(depths, key=lambda link: depths[link])),
        xacro_args=f"xacro_args = {{ {args} }}\n" * bool(args),
    )
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


_TEMPLATE = """\
# Processes that `zstate up {file}` starts; Ctrl-C ends all of them. `zstate up --help` explains every key.
# Lines that start with # and no blank are examples: remove the # to use them.

[parameters]                        # `zstate up {file} rate=500` changes one
source = "sine"                     # every joint swings; "joints": the joint_states of your driver
rate = 100.0                        # samples per second

[[robot]]
model = {model}
{xacro_args}name = {name}
source = "${{source}}"
rate = "${{rate}}"
#wires = ["native", "ros2"]          # also for rviz2 and other ROS 2 nodes; needs a [router] with ros2 = true
# xacro_args = {{ NAME = "VALUE" }}  # if the model is a xacro file
#metrics = 9100                      # http://127.0.0.1:9100/metrics for Prometheus
#restart = "on-failure"              # by default a failure ends everything

# Its joints, in the order of their positions:
{joints}

# An edge fixed to the robot: the pose of source in target.
#[[static]]
#robot = {name}
#target = {tip}
#source = "camera"
#xyz = [0.05, 0.0, 0.04]             # [m]
#rpy_deg = [0.0, -90.0, 0.0]

# The same from an easy_handeye calibration.
#[[static]]
#robot = {name}
#file = "handeye.yaml"

# The map of a place, from map_server's files.
#[[map]]
#file = "hall.yaml"

# A laser scanner, simulated in that map: the robot's root frame stands in it.
#[[scan]]
#robot = {name}
#frame = {tip}
#simulate = "hall.yaml"              # or dummy = true
#after = {name}

# A program of your own, such as the driver: any terminal command.
#[[program]]
#run = "python driver.py"
#after = {name}
#restart = "on-failure"

# A router for other machines; without one, everything stays on this host.
#[router]
#listen = ["tcp/0.0.0.0:7447"]
#ros2 = true

# Or a connection to a router on another machine.
#[network]
#mode = "client"
#connect = ["tcp/192.168.1.10:7447"]
"""
