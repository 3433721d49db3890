"""zstate joints: test publisher of joint states."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.metrics import publisher_rows, serve_metrics
from zstate.cli.options import load_robot
from zstate.cli.output.console import count_text, print_wrapped
from zstate.cli.output.wire_text import messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress


@click.command("joints")
@click.argument("robot", type=options.MODEL)
@options.xacro_arguments
@click.option(
    "--only",
    multiple=True,
    metavar="NAME",
    help="Publish this joint only, as the driver of a part of the robot. Repeatable.",
)
@options.rate_option
@options.seconds_option
@options.name_option
@options.wire_option
@options.clock_option
@options.takeover_option
@options.metrics_option
@options.session_options
def joints_command(
    *,
    robot: str,
    xacro_args: dict[str, str],
    only: tuple[str, ...],
    rate: float,
    seconds: float | None,
    name: str | None,
    wire: str,
    clock: str,
    takeover: bool,
    metrics: BindAddress | None,
    network: SessionOptions,
) -> None:
    """Publish a sine on every joint of ROBOT, within its limits, and nothing else.

    ROBOT is a name such as panda, or a URDF or xacro file; NAME:=VALUE are xacro arguments. `zstate publish
    ROBOT` publishes the transforms.

    \b
    zstate joints panda
    zstate joints arm.urdf --rate 500 --seconds 10
    zstate joints panda --wire ros2                    # /joint_states, for a robot_state_publisher
    zstate joints panda --only panda_finger_joint1     # a gripper's driver; another one publishes the rest
    """
    from zstate.cli.commands.publish import run_publisher
    from zstate.cli.options import open_clock
    from zstate.nodes.partial_publisher import PartialStatePublisher
    from zstate.nodes.publisher import StatePublisher
    from zstate.sources import SineSource
    from zstate.wire.registry import get_wire

    model, robot_name = load_robot(robot, name, xacro_args)
    if only and takeover:
        raise click.UsageError("--takeover is for all joints; with --only a joint has one writer")
    with open_session(network, (wire,)) as session, open_clock(session, clock, wire) as time:
        if only:
            publisher = PartialStatePublisher(session, model, only, robot_name, (wire,), clock=time)
            shown = f"on {', '.join(only)}"
            place = messages_for(wire).topics(robot_name, (get_wire(wire).partial_joint_states,))
            place += f"/{publisher.writer}" if wire == "native" else ""
        else:
            publisher = StatePublisher(
                session, model, robot_name, (wire,), streams=("joint_states",), clock=time, takeover=takeover
            )
            shown = f"on {count_text(len(model.joint_names), 'joint')}"
            place = messages_for(wire).topics(robot_name, ("joint_states",))
        with publisher, serve_metrics(metrics, publisher_rows(publisher)):
            print_wrapped(f"{robot_name}: a sine {shown}, {rate:g} Hz, on {place}")
            run_publisher(publisher, SineSource(publisher.model), rate, seconds)
