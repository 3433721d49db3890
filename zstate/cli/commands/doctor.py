"""zstate doctor: the first broken link between a robot and the readers of its poses."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.output.console import print_json, print_result
from zstate.cli.session import SessionOptions

if TYPE_CHECKING:
    from zstate.cli.doctor.check import Check


@click.command("doctor")
@click.argument("robot", default="*", metavar="[ROBOT]")
@options.timeout_option("How long to wait for streams that are announced but slow [s].", 3.0)
@click.option(
    "--all", "in_full", is_flag=True, help="Print every link of every robot, also those that are ok."
)
@options.json_option("One JSON object.")
@options.wire_option
@options.session_options
def doctor_command(
    *, network: SessionOptions, robot: str, timeout: float, in_full: bool, as_json: bool, wire: str
) -> None:
    """Find what is wrong with ROBOT, or with all robots, and print the next command to run.

    Checks each link of the chain from this installation to the poses: network, announced robots, model,
    samples, clocks and stamps, fixed edges. Each is ok, a warning, or broken. Prints the first broken one
    with a command that helps. Exit code 1 if a link is broken, else 0.

    \b
    zstate doctor
    zstate doctor panda
    zstate doctor panda --connect tcp/192.168.1.10:7447
    zstate doctor --json | jq .first_broken.text
    """
    from zstate.cli.doctor.check import (
        check_text,
        conclusion_text,
        diagnosis_json,
        first_broken,
        robot_lines,
    )
    from zstate.cli.doctor.diagnosis import diagnosis
    from zstate.cli.output.logs import suppress_library_warnings
    from zstate.wire.keys import ANY, check_robot

    if robot != ANY:
        if "/" in robot or robot.endswith((".urdf", ".xacro", ".xml", ".toml")):
            raise click.UsageError(
                f"{robot!r} is a file, and doctor checks running robots by name; to check a model: "
                f"`zstate check {robot}`"
            )
        check_robot(robot)
    suppress_library_warnings()
    checks: list[Check] = []
    found = diagnosis(network, robot, wire, timeout)
    if as_json:
        checks += found
        print_json(diagnosis_json(checks))
        raise SystemExit(1 if first_broken(checks) else 0)
    # Links of the network are printed at once, those of a robot when all of them are checked.
    for name, group in groupby(found, key=lambda check: check.robot):
        if name is None:
            for check in group:
                print_result(check_text(check))
                checks.append(check)
        else:
            of_robot = list(group)
            for line in robot_lines(name, of_robot, in_full=in_full or robot != ANY):
                print_result(line)
            checks += of_robot
    print_result(conclusion_text(checks))
    raise SystemExit(1 if first_broken(checks) else 0)
