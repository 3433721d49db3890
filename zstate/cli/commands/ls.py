"""zstate ls: the announced robots and who writes for them."""

from __future__ import annotations

import time
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import note, say, say_json
from zstate.cli.layout import in_columns
from zstate.cli.network import Network, open_session
from zstate.cli.options import session_options, wire_option
from zstate.cli.words import is_ros, words_of
from zstate.errors import duration_text

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session
    from zstate.wire.keys import Stream
    from zstate.wire.writer import Writer


@click.command("ls")
@click.option("--json", "as_json", is_flag=True, help="One JSON array; on ROS's side one object.")
@wire_option
@session_options
def ls_command(network: Network, as_json: bool, wire: str) -> None:
    """List the announced robots and, for each stream, who writes it since when.

    On ROS's side: the nodes, and who publishes and subscribes the topics of robots' states, with QoS.

    \b
    zstate ls
    zstate ls --json --connect tcp/192.168.1.10:7447
    zstate ls --wire ros2:domain=5
    """
    with open_session(network, (wire,)) as session:
        if is_ros(wire):
            _list_graph(session, wire, as_json=as_json)
        else:
            _list_robots(session, as_json=as_json)


def _list_graph(session: Session, wire: str, *, as_json: bool) -> None:
    from zstate.cli.ros_graph import heard_graph
    from zstate.cli.ros_graph_text import graph_facts, graph_text, namespaces_hint, nobody_text
    from zstate.net.wires import wire_named
    from zstate.wire.ros2.wire import Ros2Wire

    spoken = wire_named(wire)
    assert isinstance(spoken, Ros2Wire)
    graph = heard_graph(session, spoken)
    if as_json:
        say_json(graph_facts(graph, spoken))
    elif graph.nodes or graph.topics:
        say(graph_text(graph, spoken))
        hint = namespaces_hint(graph, spoken)
        if hint:
            note(hint)
    else:
        note(nobody_text(spoken))


def _list_robots(session: Session, *, as_json: bool) -> None:
    from zstate.net.presence import discover

    robots = discover(session)
    if as_json:
        say_json([_facts(robot) for robot in robots])
    elif robots:
        say("\n".join(_lines(robots)))
    else:
        note(words_of("native").announced(robots))


def _lines(robots: tuple[RobotInfo, ...]) -> list[str]:
    rows = in_columns(
        [
            (f"  {_said(robot, stream, writer)}", str(writer), _since(writer))
            for robot in robots
            for stream, writer in robot.writers
        ]
    )
    lines: list[str] = []
    for robot in robots:
        count = len(robot.writers)
        lines += [robot.name, *rows[:count]]
        rows = rows[count:]
    return lines


def _said(robot: RobotInfo, stream: Stream, writer: Writer) -> str:
    from zstate.wire.keys import MODEL_WRITER

    names = [name for name in robot.names_of(writer) if stream == "tf_static" and name != MODEL_WRITER]
    return f"{stream}/{','.join(names)}" if names else stream


def _since(writer: Writer) -> str:
    began = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    return f"since {began:%Y-%m-%d %H:%M:%S}, {_lasting(time.time_ns() - writer.since)}"


def _lasting(nanoseconds: int) -> str:
    minutes, seconds = divmod(nanoseconds // 1_000_000_000, 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds:02d} s" if minutes else duration_text(nanoseconds)


def _facts(robot: RobotInfo) -> dict[str, Any]:
    writers = [
        {"stream": stream, **asdict(writer), "names": robot.names_of(writer) if stream == "tf_static" else ()}
        for stream, writer in robot.writers
    ]
    return {"robot": robot.name, "writers": writers}
