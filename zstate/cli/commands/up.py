"""zstate up: supervisor of the processes in one file."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import click

from zstate.cli.output import logs
from zstate.cli.output.console import fail, print_result
from zstate.cli.output.text_layout import in_columns

_COLORS = ("cyan", "green", "magenta", "yellow", "blue", "bright_cyan", "bright_green", "bright_magenta")


@click.command("up")
@click.argument("file", type=click.Path(exists=True, dir_okay=False))
@click.argument("parameters", nargs=-1, metavar="[KEY=VALUE]...")
@click.option("--check", "only_check", is_flag=True, help="Print the commands without starting them.")
def up_command(file: str, parameters: tuple[str, ...], only_check: bool) -> None:
    """Start the processes in FILE. Ctrl-C ends all of them, and so does the failure of one.

    Each output line starts with the name of its process. `zstate init panda` writes a first file. KEY=VALUE
    sets one of its [parameters].

    \b
    zstate up cell.toml
    zstate up cell.toml rate=500 robots="left right third"
    zstate up cell.toml --check

    With a [router] the other processes start once it is ready. They connect to it unless [network] says
    otherwise, and so does zstate.connect() without arguments in a program. Paths are relative to FILE (TOML).
    [[COMMAND]] starts `zstate COMMAND`: its keys are the options and arguments of that command, those of
    other packages as well.

    \b
    include = ["network.toml"]        # more such files
    [parameters]                      # "${rate}" below; "${HOME}": environment
    rate = 100.0
    robots = "${ROBOTS:-left right}"  # left right if ROBOTS is not set
    [router]                          # options of `zstate router`
    listen = ["tcp/0.0.0.0:7447"]
    ros2 = true                       # replaces rmw_zenohd
    [network]                         # session options of all processes
    mode = "client"
    connect = ["tcp/127.0.0.1:7447"]
    certs = "fleet"                   # with identity = here, or for each robot
    [[robot]]                         # options of `zstate publish`
    model = "panda"                   # a name, or a file
    names = "${robots}"               # one robot for each name, "${name}" below
    identity = "${name}"
    source = "sine"                   # default: "joints"; or a recording
    rate = "${rate}"
    wires = ["native", "ros2"]        # default: "native"
    metrics = 9100                    # 9101 for the second robot of a loop
    restart = "on-failure"            # or "always"; default: a failure ends all
    [[robot]]
    model = "panda"                   # xacro_args = {NAME = "VALUE"} for xacro
    count = 3                         # three robots, "${number}" is 1, 2, 3
    name = "arm${number}"
    when = "${SITE:-lab} != lab"      # or "${SITE} == lab", true, false
    identity = "${name}"
    [[static]]                        # options of `zstate static`
    robot = "l*"                      # a name, a pattern, or a list of them
    target = "panda_hand"
    source = "camera"
    xyz = [0.05, 0.0, 0.04]           # [m]
    rpy_deg = [0.0, -90.0, 0.0]       # or rpy, or quat_xyzw
    wires = ["native", "ros2"]
    [[static]]
    robot = "right"
    file = "handeye.yaml"             # of easy_handeye, or a TransformStamped
    [[map]]                           # any command: its options and arguments
    file = "hall.yaml"                # its process is hall/map
    identity = "hall"
    [[scan]]                          # ROBOT/SENSOR: left/scan
    robot = "left"
    frame = "laser"
    simulate = "hall.yaml"            # or dummy = true
    map_frame = "hall/map"
    identity = "left"
    after = "left"
    [[drive]]                         # ROBOT/COMMAND: panda/drive
    driver = "sim"                    # or FILE.py:CLASS
    robot = "panda"
    velocities = {panda_joint1 = 0.5} # --velocity panda_joint1=0.5; or a list
    identity = "left"
    [[program]]                       # any other program
    run = "python driver.py ${rate}"
    identity = "left"
    after = ["left", "static"]        # starts when these are ready
    ready = "driver runs"             # text it prints when it is ready itself
    """
    from zstate.cli.up.cell import read_cell
    from zstate.cli.up.processes import plan_processes
    from zstate.cli.up.supervisor import Supervisor
    from zstate.cli.up.template import parse_settings

    settings = parse_settings(parameters)
    specs = plan_processes(read_cell(file, settings), Path(file), settings)
    if only_check:
        commands = [(one.arguments if one.is_program else ("zstate", *one.arguments)) for one in specs]
        rows = [(spec.name, shlex.join(command)) for spec, command in zip(specs, commands, strict=True)]
        print_result("\n".join(in_columns(rows)))
        return
    width = max(len(spec.name) for spec in specs)
    prefixes = {spec.name: f"{spec.name:<{width}} | " for spec in specs}
    if not os.environ.get("NO_COLOR"):
        for number, (name, prefix) in enumerate(prefixes.items()):
            prefixes[name] = click.style(prefix, fg=_COLORS[number % len(_COLORS)])

    def show(name: str, line: str, is_error: bool) -> None:
        if logs.is_json():
            logs.forward_line(line, is_error=is_error, part=name)
        else:
            print_result(prefixes[name] + line)

    failure = Supervisor(specs, show).run()
    if failure:
        fail(failure)
