"""zstate monitor: how the samples behind one pose come in, edge by edge."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING

import click

from zstate.cli.network import Network, open_session
from zstate.cli.options import (
    heard_robot_option,
    json_option,
    reading_clock_option,
    session_options,
    timeout_option,
    wire_option,
)
from zstate.cli.output.console import is_terminal
from zstate.cli.roster import Roster
from zstate.cli.words import followed

if TYPE_CHECKING:
    from zstate.cli.monitor.monitored import Monitored

_FIRST_AFTER_S = 1.0


@click.command("monitor")
@click.argument("target", metavar="[A]", required=False)
@click.argument("source", metavar="B", required=False)
@click.option("--once", is_flag=True, help="Print one report, of the first second; give up after --timeout.")
@timeout_option("How long --once waits for the pose.")
@heard_robot_option
@json_option()
@wire_option
@reading_clock_option
@session_options
def monitor_command(
    *,
    network: Network,
    target: str | None,
    source: str | None,
    once: bool,
    timeout: float,
    robot: str,
    wire: str,
    clock: str | None,
    as_json: bool,
) -> None:
    """Watch each edge between the frames A and B, or all that are heard, until Ctrl-C.

    The table goes from A to B: each line tells of the edge from the line above. Of all edges those whose
    samples come together have one line, such as the joints of a robot. Rate, latency (from a
    sample's stamp until it is here: the median and the longest) and jitter (the standard deviation of the
    time between arrivals) are those of the last five seconds; missed are gaps in the writer's numbers;
    clock is how far the writer's clock is ahead of the one here, measured over the network.

    \b
    zstate monitor
    zstate monitor panda_link0 panda_hand
    zstate monitor map r1/base_link --once --json | jq '.edges[] | {child, rate_hz}'
    zstate monitor odom base_link --wire ros2
    """
    from zstate.cli.clocks import open_clock
    from zstate.cli.monitor.meter import PathMeter
    from zstate.cli.monitor.monitored import MonitoredEdges, MonitoredPose
    from zstate.clock import SystemClock
    from zstate.listener import TransformListener
    from zstate.rate import Rate

    if target is not None and source is None:
        raise click.UsageError(f"{target!r} is one frame; give two of them, or none for all that are heard")
    follow = followed(wire)
    with (
        open_session(network, (wire,)) as session,
        Roster(session, robot, wire) as roster,
        open_clock(session, clock, wire, timeout_s=timeout if once else None) as kept,
        TransformListener(
            session, robot, wire=wire, follow=follow, clock=kept, history_on_join=False
        ) as listener,
        PathMeter(session, robot, wire, follow, listener.buffer.clock) as meter,
    ):
        monitored: Monitored
        if target is None or source is None:
            monitored = MonitoredEdges(listener, meter, roster)
        else:
            monitored = MonitoredPose(listener, meter, roster, (target, source))
        monitored.wait(timeout if once else None)
        Event().wait(_FIRST_AFTER_S)
        if once:
            monitored.say(as_json=as_json)
        elif as_json or not is_terminal():
            for _ in Rate(1.0, SystemClock(), Event()):
                monitored.say(as_json=as_json)
        else:
            monitored.show()
