"""zstate monitor: rate, latency, jitter and losses of edges or robots."""

from __future__ import annotations

import time
from contextlib import ExitStack
from threading import Event
from typing import TYPE_CHECKING

import click

from zstate.cli.metrics import listener_collector, serve_metrics, writer_collector
from zstate.cli.options import (
    json_option,
    metrics_option,
    open_clock,
    reading_clock_option,
    robot_filter_option,
    session_options,
    timeout_option,
    wire_option,
)
from zstate.cli.output.console import fail, is_terminal
from zstate.cli.output.wire_text import default_stream
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.cli.monitor import MonitorView, RobotMonitor
    from zstate.metrics.endpoint import BindAddress

_FIRST_AFTER_S = 1.0
# Discovery takes less.
_DISCOVERY_S = 0.3


@click.command("monitor")
@click.argument("target", metavar="[A]", required=False)
@click.argument("source", metavar="B", required=False)
@click.option("--robots", is_flag=True, help="Monitor robots rather than edges: one line for each.")
@click.option("--once", is_flag=True, help="Print one report, of the first second; give up after --timeout.")
@timeout_option("How long --once waits for the pose, or for a robot.")
@robot_filter_option
@json_option()
@wire_option
@reading_clock_option
@metrics_option
@session_options
def monitor_command(
    *,
    network: SessionOptions,
    target: str | None,
    source: str | None,
    robots: bool,
    once: bool,
    timeout: float,
    robot: str,
    wire: str,
    clock: str | None,
    metrics: BindAddress | None,
    as_json: bool,
) -> None:
    """Monitor each edge between the frames A and B, or all edges, until Ctrl-C.

    The table goes from A to B; each line is the edge from the frame of the line above. Without A and B,
    edges whose samples arrive together share a line, such as the joints of a robot. Figures of the last 5 s:
    rate; latency, from a sample's stamp to its arrival (median and maximum); jitter, the standard deviation
    of the time between arrivals. "missed" counts gaps in the writer's sequence numbers. "clock" is how far
    the writer's clock is ahead of this one, measured over the network.

    With --robots each robot has a line per second: rate, age of its newest sample, latency until a sample can
    be looked up, and counts since the start: received, dropped here, missed on the way, late (older than the
    history), refused, and off the clock (stamped more than a minute away from the time here). On a ROS wire
    this is /tf, all nodes together; with --robot, the joint states of a robot that has a description.

    \b
    zstate monitor
    zstate monitor panda_link0 panda_hand
    zstate monitor map r1/base_link --once --json | jq '.edges[] | {child, rate_hz}'
    zstate monitor odom base_link --wire ros2
    zstate monitor --robots
    zstate monitor --robots --robot panda --json --metrics 9100
    """
    from zstate.cli.monitor import (
        AllEdgesView,
        EdgeStatistics,
        PathView,
        RobotMonitor,
    )
    from zstate.nodes.listener import TransformListener

    if robots and target is not None:
        raise click.UsageError("--robots takes no frames; --robot NAME selects a robot")
    if metrics is not None and not robots:
        raise click.UsageError("--metrics needs --robots")
    if target is not None and source is None:
        raise click.UsageError(f"{target!r} is one frame; give two frames, or none for all edges")
    follow, once_s = default_stream(wire), timeout if once else None
    with (
        open_session(network, (wire,)) as session,
        RobotDirectory(session, robot, wire) as directory,
        open_clock(session, clock, wire, timeout_s=once_s) as selected_clock,
        ExitStack() as opened,
    ):
        if robots:
            monitor = opened.enter_context(RobotMonitor(session, directory, robot, wire, selected_clock))
            opened.enter_context(
                serve_metrics(metrics, listener_collector(monitor.robots), writer_collector(directory))
            )
            _report_robots(monitor, once_s, as_json=as_json)
            return
        listener = opened.enter_context(
            TransformListener(
                session, robot, wire=wire, follow=follow, clock=selected_clock, history_on_join=False
            )
        )
        statistics = opened.enter_context(EdgeStatistics(session, robot, wire, follow, listener.buffer.clock))
        if target is None or source is None:
            _report_edges(AllEdgesView(listener, statistics, directory), once_s, as_json=as_json)
        else:
            frames = (target, source)
            _report_edges(PathView(listener, statistics, directory, frames), once_s, as_json=as_json)


def _report_edges(monitored: MonitorView, once_s: float | None, *, as_json: bool) -> None:
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    monitored.wait(once_s)
    Event().wait(_FIRST_AFTER_S)
    if once_s is not None:
        monitored.print_report(as_json=as_json)
    elif as_json or not is_terminal():
        for _ in Rate(1.0, SystemClock(), Event()):
            monitored.print_report(as_json=as_json)
    else:
        monitored.show()


def _report_robots(monitor: RobotMonitor, once_s: float | None, *, as_json: bool) -> None:
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    forever = Event()
    forever.wait(_DISCOVERY_S)
    if once_s is None:
        for _ in Rate(1.0, SystemClock(), forever):
            monitor.report(as_json=as_json)
            monitor.update()
        return
    deadline = time.monotonic() + once_s
    while reason := monitor.update():
        if time.monotonic() > deadline:
            fail(f"gave up after {once_s:g} s: {reason}")
        forever.wait(_DISCOVERY_S)
    forever.wait(_FIRST_AFTER_S)
    monitor.report(as_json=as_json)
