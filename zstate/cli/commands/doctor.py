"""zstate doctor: what is wrong between a robot and whoever wants its poses."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import TYPE_CHECKING

import click

from zstate.cli.options import json_option, session_options, timeout_option, wire_option
from zstate.cli.output.console import print_json, print_result
from zstate.cli.session import SessionOptions

if TYPE_CHECKING:
    from zstate.cli.doctor.check import Check


@click.command("doctor")
@click.argument("robot", default="*", metavar="[ROBOT]")
@timeout_option("How long to wait for what is announced and slow.", 3.0)
@click.option(
    "--all", "in_full", is_flag=True, help="Every link of every robot, also of those that are sound."
)
@json_option("One JSON object.")
@wire_option
@session_options
def doctor_command(
    *, network: SessionOptions, robot: str, timeout: float, in_full: bool, as_json: bool, wire: str
) -> None:
    """Say what is wrong with ROBOT, or with all robots, and what to do next.

    Walks the chain from this installation to the poses: the network, who is announced, the model, the
    samples, the clocks and stamps, the fixed edges. Each link is ok, a warning, or broken; the first broken
    one is named, with the command to go on with. Exit code 1 when a link is broken, 0 otherwise.

    \b
    zstate doctor
    zstate doctor panda
    zstate doctor panda --connect tcp/192.168.1.10:7447
    zstate doctor --json | jq .first_broken.text
    """
    from zstate.cli.doctor.check import first_broken
    from zstate.cli.doctor.diagnosis import conclusion_text, diagnosis, diagnosis_json
    from zstate.cli.output.logs import keep_warnings_back
    from zstate.wire.keys import ANY, check_robot

    if robot != ANY:
        _refuse_file(robot)
        check_robot(robot)
    keep_warnings_back()
    checks: list[Check] = []
    found = diagnosis(network, robot, wire, timeout)
    if as_json:
        checks += found
        print_json(diagnosis_json(checks))
    else:
        checks += _said(found, in_full=in_full or robot != ANY)
        print_result(conclusion_text(checks))
    raise SystemExit(1 if first_broken(checks) else 0)


def _said(found: Iterable[Check], *, in_full: bool) -> list[Check]:
    """Say each link as soon as it is known, or all of one robot as soon as they are."""
    from zstate.cli.doctor.diagnosis import check_text, robot_lines

    said: list[Check] = []
    for robot, checks in groupby(found, key=lambda check: check.robot):
        if robot is None:
            for check in checks:
                print_result(check_text(check))
                said.append(check)
        else:
            of_robot = list(checks)
            for line in robot_lines(robot, of_robot, in_full=in_full):
                print_result(line)
            said += of_robot
    return said


def _refuse_file(robot: str) -> None:
    if "/" in robot or robot.endswith((".urdf", ".xacro", ".xml", ".toml")):
        raise click.UsageError(
            f"{robot!r} is a file, and doctor looks at running robots by their names; `zstate check {robot}` "
            "looks at a model"
        )
