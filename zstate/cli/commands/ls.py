"""zstate ls: the announced robots and who writes for them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from zstate.cli.options import json_option, session_options, wire_option
from zstate.cli.output.console import (
    is_terminal,
    keep_showing,
    output_width,
    print_json,
    print_result,
    print_status,
    print_wrapped,
)
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session

T = TypeVar("T")

_MEASURED_WITHIN_S = 0.3
_AGAIN_S, _JSON_PERIOD_S = 0.5, 1.0
# Meeting everybody takes less.
_MEETING_S = 0.5


@click.command("ls")
@click.option("--watch", is_flag=True, help="Keep the list up to date, until Ctrl-C.")
@json_option("One JSON array; on ROS's side one object.")
@wire_option
@session_options
def ls_command(network: SessionOptions, *, watch: bool, as_json: bool, wire: str) -> None:
    """List the announced robots and, for each stream, who writes it since when.

    Of joint states also the rate, by their own stamps, and how long ago the last one came. On ROS's side:
    the nodes, and who publishes and subscribes the topics of robots' states, with QoS. With --watch a
    pipe gets the list anew whenever somebody comes or goes; with --json, one document a second. With nobody
    announced the list is empty, and the exit code 0. A terminal gets headings.

    \b
    zstate ls
    zstate ls --watch
    zstate ls --json --connect tcp/192.168.1.10:7447
    zstate ls --wire ros2:domain=5
    """
    with open_session(network, (wire,)) as session:
        if is_ros(wire):
            _list_graph(session, wire, watch=watch, as_json=as_json)
        else:
            _list_robots(session, watch=watch, as_json=as_json)


def _list_graph(session: Session, wire: str, *, watch: bool, as_json: bool) -> None:
    from zstate.cli.output.graph_text import (
        empty_ros_graph_text,
        namespaces_hint,
        ros_graph_facts,
        ros_graph_text,
    )
    from zstate.net.graph import RosGraph, discover_ros_graph
    from zstate.wire.registry import get_wire
    from zstate.wire.ros2.wire import Ros2Wire

    wire_format = get_wire(wire)
    assert isinstance(wire_format, Ros2Wire)

    def discover() -> RosGraph:
        return discover_ros_graph(session, wire_format)

    def text(graph: RosGraph) -> str:
        is_empty = not graph.nodes and not graph.topics
        return empty_ros_graph_text(wire_format) if is_empty else ros_graph_text(graph, wire_format)

    if watch:
        _watch(discover, text, lambda graph: ros_graph_facts(graph, wire_format), as_json=as_json)
    graph = discover()
    if as_json:
        print_json(ros_graph_facts(graph, wire_format))
    elif graph.nodes or graph.topics:
        print_wrapped(text(graph))
        hint = namespaces_hint(graph, wire_format)
        if hint:
            print_status(hint)
    else:
        print_status(text(graph))


def _list_robots(session: Session, *, watch: bool, as_json: bool) -> None:
    from zstate.cli.output.robot_table import robots_facts, robots_text, sources
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.net.presence import discover
    from zstate.net.topic_statistics import FLEET_WINDOW, TopicStatistics
    from zstate.wire.registry import get_wire

    def text(robots: tuple[RobotInfo, ...]) -> str:
        if not robots:
            return messages_for("native").announced(robots)
        return robots_text(robots, statistics, width=output_width())

    with TopicStatistics(session, get_wire("native"), window=FLEET_WINDOW) as statistics:
        statistics.subscribe("joint_states")
        if watch:
            with RobotDirectory(session) as roster:
                time.sleep(_MEETING_S)
                _watch(roster.robots, text, lambda robots: robots_facts(robots, statistics), as_json=as_json)
        robots = discover(session)
        statistics.wait(sources(robots), _MEASURED_WITHIN_S)
        if as_json:
            print_json(robots_facts(robots, statistics))
        elif robots:
            print_wrapped(text(robots))
        else:
            print_status(text(robots))


def _watch(
    state: Callable[[], T], text: Callable[[T], str], facts: Callable[[T], Any], *, as_json: bool
) -> NoReturn:
    """Show ``state`` until Ctrl-C: refresh a terminal, print changes to a pipe, JSON every second."""
    if is_terminal() and not as_json:
        keep_showing(lambda: text(state()))
    shown: T | None = None
    while True:
        now = state()
        if as_json:
            print_json(facts(now))
        elif now != shown:
            print_result(f"{text(now)}\n")
        shown = now
        time.sleep(_JSON_PERIOD_S if as_json else _AGAIN_S)
