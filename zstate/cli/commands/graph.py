"""zstate graph: who writes and reads what."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import click

from zstate._util.suggestions import did_you_mean
from zstate.cli.options import form_options, session_options, wire_option
from zstate.cli.output.console import fail, print_json, print_result, print_status, print_wrapped
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.net.graph import Graph
    from zstate.net.session import Session
    from zstate.wire.identity import WriterId
    from zstate.wire.keys import Stream

_MEASURED_WITHIN_S = 0.4
_READERS_WITHIN_S = 0.15


@click.command("graph")
@click.argument("robot", default="*", metavar="[ROBOT]")
@form_options("One JSON object: programs and streams.", "A picture, from left to right.")
@wire_option
@session_options
def graph_command(network: SessionOptions, robot: str, form: str | None, wire: str) -> None:
    """Show who writes and who reads the streams of ROBOT, or of all robots.

    Programs that use zstate announce themselves; whoever subscribes to keys on its own does not. What is
    read but written by nobody stands out. On ROS's side: the nodes and the topics that carry robots'
    states, in all namespaces.

    \b
    zstate graph
    zstate graph panda --svg > panda.svg
    zstate graph --json | jq '.streams[] | select(.writers == [])'
    zstate graph --wire ros2
    """
    from zstate.cli.output.graph_text import graph_facts

    with open_session(network, (wire,)) as session:
        graph = _ros_graph(session, wire) if is_ros(wire) else _measured_graph(session)
    if robot != "*" and not is_ros(wire):
        graph = _of_robot(graph, robot)
    if form == "json":
        print_json(graph_facts(graph))
    elif graph.streams:
        title = "Who writes and reads what" if robot == "*" else f"Who writes and reads what of {robot}"
        _print(graph, form, title)
    else:
        print_status(messages_for(wire).announced(()))


def _measured_graph(session: Session) -> Graph:
    """The graph of the native wire, with the rates of the streams that move."""
    from zstate.net.graph import build_graph
    from zstate.net.presence import discover, discover_readers
    from zstate.net.topic_statistics import FLEET_WINDOW, TopicStatistics, WriterKey
    from zstate.wire.keys import ANY
    from zstate.wire.registry import get_wire

    with TopicStatistics(session, get_wire("native"), window=FLEET_WINDOW) as statistics:
        statistics.subscribe("joint_states")
        robots = discover(session)
        readers = discover_readers(session, _READERS_WITHIN_S)
        # Transforms are published only while they are read: measuring must not make a publisher start.
        read = {one.robot for one in readers if one.stream == "tf"}
        moving: set[tuple[str, Stream]] = {(robot.name, "joint_states") for robot in robots}
        for robot in robots:
            if read & {robot.name, ANY}:
                statistics.subscribe("tf", robot.name)
                moving.add((robot.name, "tf"))
        expected = [
            WriterKey(robot.name, stream, writer.session)
            for robot in robots
            for stream, writer in robot.writers
            if (robot.name, stream) in moving
        ]
        statistics.wait(expected, _MEASURED_WITHIN_S)

        def rate_of(robot: str, stream: Stream, writer: WriterId) -> float | None:
            source = statistics.get(WriterKey(robot, stream, writer.session))
            return None if source is None else source.published_hz()

        return build_graph(robots, readers, rate_of)


def _ros_graph(session: Session, wire: str) -> Graph:
    from zstate.net.graph import discover_ros_graph
    from zstate.wire.registry import get_wire
    from zstate.wire.ros2.wire import Ros2Wire

    wire_format = get_wire(wire)
    assert isinstance(wire_format, Ros2Wire)
    return discover_ros_graph(session, wire_format).graph


def _of_robot(graph: Graph, robot: str) -> Graph:
    streams = tuple(one for one in graph.streams if one.robot in (robot, "*"))
    if not streams:
        hint = did_you_mean(robot, {one.robot for one in graph.streams})
        fail(f"nobody writes or reads anything of {robot!r}{hint}")
    return replace(graph, streams=streams)


def _print(graph: Graph, form: str | None, title: str) -> None:
    from zstate.cli.output.graph_text import graph_drawing, graph_text

    if form is None:
        print_wrapped(graph_text(graph))
        return
    from zstate.cli.output.drawing import draw

    print_result(draw(graph_drawing(graph), form, title))
