"""zstate graph: writers and readers of each stream, as text, JSON or a drawing."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from zstate._util.format import did_you_mean
from zstate.cli import options
from zstate.cli.output.console import fail, print_json, print_result, print_status, print_wrapped
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.cli.output.drawing import Drawing
    from zstate.net.graph import Graph
    from zstate.net.session import Session
    from zstate.streams import StreamName
    from zstate.wire.identity import WriterId

_MEASURED_WITHIN_S = 0.4
_READERS_WITHIN_S = 0.15
_PROGRAM_FILL = "#eef2ff"


@click.command("graph")
@click.argument("robot", default="*", metavar="[ROBOT]")
@options.form_options("One JSON object: programs and streams.", "A picture, from left to right.")
@options.wire_option
@options.session_options
def graph_command(network: SessionOptions, robot: str, form: str | None, wire: str) -> None:
    """Show the writers and readers of the streams of ROBOT, or of all robots.

    Programs that use zstate announce what they read and write; subscribers to raw keys do not appear. If
    a robot has a driver, joint_commands go from its commander to the driver.
    Streams that are read but have no writer stand out. On a ROS wire: the nodes and the topics of robot
    states, in all namespaces.

    \b
    zstate graph
    zstate graph panda --svg > panda.svg
    zstate graph --json | jq '.streams[] | select(.writers == [])'
    zstate graph --wire ros2
    """
    with open_session(network, (wire,)) as session:
        if is_ros(wire):
            from zstate.net.graph import discover_ros_graph
            from zstate.wire.registry import get_wire
            from zstate.wire.ros2.wire import Ros2Wire

            wire_format = get_wire(wire)
            assert isinstance(wire_format, Ros2Wire)
            graph = discover_ros_graph(session, wire_format).graph
        else:
            graph = _discover_measured_graph(session)
    if robot != "*" and not is_ros(wire):
        streams = tuple(one for one in graph.streams if one.robot in (robot, "*"))
        if not streams:
            hint = did_you_mean(robot, {one.robot for one in graph.streams})
            fail(f"no stream of {robot!r} has a writer or a reader{hint}")
        graph = replace(graph, streams=streams)
    if form == "json":
        print_json(_graph_facts(graph))
    elif not graph.streams:
        print_status(messages_for(wire).announced(()))
    elif form is None:
        print_wrapped(graph_text(graph))
    else:
        from zstate.cli.output.drawing import draw

        title = "Writers and readers" if robot == "*" else f"Writers and readers of {robot}"
        print_result(draw(graph_drawing(graph), form, title))


def _discover_measured_graph(session: Session) -> Graph:
    """The graph of the native wire, with the rates of the streams that move."""
    from zstate.cli.robot_directory import check_found
    from zstate.net.discovery import discover, discover_readers
    from zstate.net.graph import build_graph
    from zstate.net.sites import discover_sites
    from zstate.net.topic_statistics import FLEET_WINDOW, TopicStatistics, WriterKey
    from zstate.stream_registry import edge_streams, measured_streams
    from zstate.wire.keys import ANY
    from zstate.wire.registry import get_wire

    with TopicStatistics(session, get_wire("native"), window=FLEET_WINDOW) as statistics:
        always: tuple[StreamName, ...] = (
            "joint_states",
            "partial_joint_states",
            *edge_streams(),
            *measured_streams(),
            "joint_commands",
        )
        statistics.watch(always)
        robots = discover(session)
        check_found(robots)
        readers, sites = discover_readers(session, _READERS_WITHIN_S), discover_sites(session)
        # tf is published only while it is read: measuring must not make a publisher start.
        read = {one.robot for one in readers if one.stream == "tf"}
        moving: set[tuple[str, StreamName]] = {(robot.name, stream) for robot in robots for stream in always}
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

        def rate_hz(robot: str, stream: StreamName, writer: WriterId) -> float | None:
            return statistics.published_hz(WriterKey(robot, stream, writer.session))

        return build_graph(robots, readers, rate_hz, sites)


def graph_text(graph: Graph) -> str:
    """Each group of streams, with its writers and readers."""
    lines: list[str] = []
    for group in graph.groups:
        names = ", ".join(stream.label for stream in group.streams)
        lines.append(f"{group.robot}: {names}" if group.robot else names)
        for role, programs in (("written by", group.writers), ("read by", group.readers)):
            for number, program in enumerate(programs or ("none",)):
                lines.append(f"  {'' if number else role:<10}  {program}")
    return "\n".join(lines)


def graph_drawing(graph: Graph) -> Drawing:
    """Programs and groups of streams, with edges in the direction of the data.

    The edges of each writer have a colour. A group without a writer has a dashed red box.
    """
    from zstate.cli.output.drawing import ALARM, INK, LINE, PALETTE, Drawing, DrawnEdge, DrawnNode

    nodes: list[DrawnNode] = []
    writes: list[tuple[str, str]] = []
    reads: list[tuple[str, str]] = []
    for number, group in enumerate(graph.groups):
        name, labels = f"streams {number}", [stream.label for stream in group.streams]
        lines, unwritten = [group.robot, *labels] if group.robot else labels, not group.writers
        stroke = ALARM if unwritten else LINE
        nodes.append(DrawnNode(name, lines, stroke=stroke, dashed=unwritten, text_color=INK))
        writes += [(f"program {one}", name) for one in group.writers]
        reads += [(name, f"program {one}") for one in group.readers]
    for program in graph.programs:
        name, at, place = program.partition("@")
        lines = [name, place] if at and name else [program]
        nodes.append(DrawnNode(f"program {program}", lines, rounded=True, fill=_PROGRAM_FILL))
    writers = dict.fromkeys(writer for writer, _ in writes)
    colors = {writer: PALETTE[number % len(PALETTE)] for number, writer in enumerate(writers)}
    edges = [
        DrawnEdge(start, end, stroke=colors.get(start, colors.get(end, LINE)))
        for start, end in (*writes, *reads)
    ]
    return Drawing("zstate", "flow", nodes, edges)


def _graph_facts(graph: Graph) -> dict[str, Any]:
    streams = [
        {
            "robot": stream.robot,
            "stream": stream.name,
            "rate_hz": stream.rate_hz,
            "site": stream.thinning.site if stream.thinning else None,
            "thinned_hz": stream.thinning.rate_hz if stream.thinning else None,
            "writers": list(stream.writers),
            "readers": list(stream.readers),
        }
        for stream in graph.streams
    ]
    return {"programs": graph.programs, "streams": streams}
