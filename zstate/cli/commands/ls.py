"""zstate ls: announced robots with their streams, or the nodes and topics of a ROS graph."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from zstate.cli import options
from zstate.cli.output.console import (
    count_text,
    is_terminal,
    keep_showing,
    output_width,
    print_json,
    print_result,
    print_status,
    print_wrapped,
    rate_text,
)
from zstate.cli.output.text_layout import Table, first_fitting, in_columns
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import format_duration

if TYPE_CHECKING:
    from zstate.net.discovery import RobotInfo
    from zstate.net.graph import RosEndpoint, RosGraph
    from zstate.net.session import Session
    from zstate.net.sites import Sites
    from zstate.net.topic_statistics import TopicStatistics
    from zstate.streams import StreamName
    from zstate.wire.identity import WriterId
    from zstate.wire.ros2.wire import Ros2Wire

T = TypeVar("T")

_MEASURED_WITHIN_S = 0.3
_REFRESH_S, _JSON_PERIOD_S = 0.5, 1.0
# Discovery takes less.
_DISCOVERY_S = 0.5
_HEADINGS = ("robot, stream", "rate", "age", "writer", "since")
_OPTIONAL = ("since", "age")


@click.command("ls")
@click.option("--watch", is_flag=True, help="Keep the list up to date until Ctrl-C.")
@options.json_option("One JSON array; on a ROS wire one object.")
@options.wire_option
@options.session_options
def ls_command(network: SessionOptions, *, watch: bool, as_json: bool, wire: str) -> None:
    """List the announced robots and, for each stream, its writer and since when it writes.

    Joint states, transforms, odometry and sensors also have their rate, from their stamps, and the age of the
    newest sample. On a ROS wire: the nodes, and the publishers and subscribers of the topics of robot states,
    with QoS. A terminal gets headings. With --watch a pipe gets the list after each change; with --json, once
    a second. If no robot is announced the list is empty and the exit code is 0.

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
    from zstate.net.graph import discover_ros_graph
    from zstate.wire.registry import get_wire
    from zstate.wire.ros2.wire import Ros2Wire

    wire_format = get_wire(wire)
    assert isinstance(wire_format, Ros2Wire)
    discover = partial(discover_ros_graph, session, wire_format)
    text, facts = partial(_ros_graph_text, wire=wire_format), partial(_ros_graph_facts, wire=wire_format)
    if watch:
        _watch(discover, text, facts, as_json=as_json)
    graph = discover()
    if as_json:
        print_json(facts(graph))
    elif graph.nodes or graph.topics:
        print_wrapped(text(graph))
        if hint := _namespaces_hint(graph, wire_format):
            print_status(hint)
    else:
        print_status(text(graph))


def _list_robots(session: Session, *, watch: bool, as_json: bool) -> None:
    from zstate.cli.robot_directory import RobotDirectory, check_found
    from zstate.net.discovery import discover
    from zstate.net.sites import discover_sites
    from zstate.net.topic_statistics import FLEET_WINDOW, TopicStatistics, WriterKey
    from zstate.stream_registry import streams_where
    from zstate.wire.registry import get_wire

    def text(robots: tuple[RobotInfo, ...]) -> str:
        if not robots:
            return messages_for("native").announced(robots)
        return robots_text(robots, statistics, sites, width=output_width())

    with TopicStatistics(session, get_wire("native"), window=FLEET_WINDOW) as statistics:
        measured_streams = streams_where(lambda row: row.is_measured or row.group in ("joints", "edges"))
        statistics.watch(measured_streams)
        sites = discover_sites(session)
        facts = partial(_robots_facts, statistics=statistics, sites=sites)
        if watch:
            with RobotDirectory(session) as directory:
                time.sleep(_DISCOVERY_S)
                _watch(directory.robots, text, facts, as_json=as_json)
        robots = discover(session)
        check_found(robots)
        # A reader of tf would make a publisher send more.
        measured = [
            WriterKey(robot.name, stream, writer.session)
            for robot in robots
            for stream, writer in robot.writers
            if stream in measured_streams and _arrives(sites, robot.name, stream)
        ]
        statistics.wait(measured, _MEASURED_WITHIN_S)
        if as_json:
            print_json(facts(robots))
        elif robots:
            print_wrapped(text(robots))
        else:
            print_status(text(robots))


def _arrives(sites: Sites, robot: str, stream: StreamName) -> bool:
    """Whether samples leave the site of the robot; they arrive as well where this process is in that site."""
    thinning = sites.thinning(robot, stream)
    return thinning is None or thinning.rate_hz > 0.0


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
        time.sleep(_JSON_PERIOD_S if as_json else _REFRESH_S)


def robots_text(
    robots: Sequence[RobotInfo],
    statistics: TopicStatistics,
    sites: Sites | None = None,
    *,
    width: int | None = None,
) -> str:
    """Each robot, and below it each stream: rate, age of the newest sample, writer, start of the writer.

    A robot of a site has a line for that, and "held back" in place of the rates of what does not leave it.

    If that is wider than ``width``, first the date is left out, then the columns "since" and "age", then the
    headings; at last writers become letters. Without ``width`` there are no headings.
    """
    from zstate.net.topic_statistics import WriterKey
    from zstate.wire.keys import MODEL_WRITER

    full: list[tuple[str, ...]] = []
    undated: list[tuple[str, ...]] = []
    for robot in robots:
        full.append((robot.name, "", "", "", ""))
        undated.append(full[-1])
        if sites is not None and (place := sites.text_of(robot.name)):
            full.append(("  site", "", "", place, ""))
            undated.append(full[-1])
        for stream, writer in robot.writers:
            names = [one for one in robot.names_of(writer, stream) if one != MODEL_WRITER]
            shown = f"  {stream}/{','.join(names)}" if names else f"  {stream}"
            key = WriterKey(robot.name, stream, writer.session)
            source, published_hz, age = statistics.get(key), statistics.published_hz(key), ""
            rate = "" if published_hz is None else rate_text(published_hz)
            if source is not None:
                rate = "silent" if source.is_stale() else rate_text(published_hz)
                age = format_duration(round(source.silent_s() * 1e9))
            elif sites is not None and (thinning := sites.thinning(robot.name, stream)):
                rate = rate or ("" if thinning.rate_hz else "held back")
            start = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
            lasting = _lasting_text(time.time_ns() - writer.since)
            full.append((shown, rate, age, str(writer), f"since {start:%Y-%m-%d %H:%M:%S}, {lasting}"))
            undated.append((*full[-1][:-1], lasting))
    headed = width is not None
    tables = (
        Table(_HEADINGS, full, headed=headed),
        Table(_HEADINGS, undated, _OPTIONAL, headed=headed),
        Table(_HEADINGS, undated, _OPTIONAL, headed=False),
        Table(_HEADINGS, undated, _OPTIONAL, abbreviate="writer", headed=False),
    )
    return "\n".join(first_fitting(tables, width))


def _lasting_text(nanoseconds: int) -> str:
    minutes, seconds = divmod(nanoseconds // 1_000_000_000, 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds:02d} s" if minutes else format_duration(nanoseconds)


def _robots_facts(
    robots: Sequence[RobotInfo], statistics: TopicStatistics, sites: Sites
) -> list[dict[str, Any]]:
    from zstate.net.topic_statistics import WriterKey

    def writer_facts(robot: RobotInfo, stream: StreamName, writer: WriterId) -> dict[str, Any]:
        key = WriterKey(robot.name, stream, writer.session)
        source, thinning = statistics.get(key), sites.thinning(robot.name, stream)
        return {
            "stream": stream,
            **asdict(writer),
            "names": robot.names_of(writer, stream),
            "rate_hz": statistics.published_hz(key),
            "silent_s": None if source is None else source.silent_s(),
            "thinned_hz": None if thinning is None else thinning.rate_hz,
        }

    return [
        {
            "robot": robot.name,
            "site": sites.site_of(robot.name),
            "writers": [writer_facts(robot, *pair) for pair in robot.writers],
        }
        for robot in robots
    ]


def _ros_graph_text(graph: RosGraph, wire: Ros2Wire) -> str:
    """Nodes, then topics with their publishers and subscribers; a hint if there are none."""
    from zstate.wire.ros2.streams import ros_type
    from zstate.wire.ros2.topics import HUMBLE_HASH

    if not graph.nodes and not graph.topics:
        if wire.name == "ros2dds":
            return "no ros2dds bridge carries the state of a robot; check the router (--connect)"
        return (
            f"no ROS 2 node in domain {wire.options.domain}; check that nodes run with "
            "RMW_IMPLEMENTATION=rmw_zenoh_cpp and this ROS_DOMAIN_ID, and that this is their router"
        )
    lines: list[str] = []
    if wire.name == "ros2":
        lines += [f"{count_text(len(graph.nodes), 'node')} in domain {wire.options.domain}"]
        lines += [f"  {node.full_name}" for node in graph.nodes]
    for topic in graph.topics:
        topic_type = ros_type(topic.stream)
        rows: list[tuple[str, ...]] = []
        for role, ends in (("  publisher", topic.publishers), ("  subscriber", topic.subscribers)):
            for end in ends:
                qos, is_usual = end.qos, end.hash in ("", topic_type.hash)
                depth = f"keep last {qos.depth}" if qos.history == "keep_last" else "keep all"
                policies = f"{qos.reliability}, {qos.durability}, {depth}".replace("_", " ")
                version = "" if is_usual else "another version of the type"
                version = "humble" if end.hash == HUMBLE_HASH else version
                rows.append((role, end.full_name, policies, version))
        lines += [f"{topic.name}  {topic_type.name}", *in_columns(rows)]
    return "\n".join(lines)


def _namespaces_hint(graph: RosGraph, wire: Ros2Wire) -> str:
    """The ``--wire`` options for robots in other namespaces; empty if there are none."""
    others = sorted({topic.namespace for topic in graph.topics} - {"", wire.options.namespace})
    if not others or wire.options.namespace == "*":
        return ""
    domain = f"domain={wire.options.domain}," if wire.options.domain else ""
    spec = f"{wire.name}:{domain}namespace="
    # Quoted, because shells expand the star to file names.
    every = f", or for each by its name `--wire '{spec}*'`" if any("/" not in name for name in others) else ""
    return f"in namespaces: {', '.join(others)}; to use one of them: `--wire {spec}{others[0]}`{every}"


def _ros_graph_facts(graph: RosGraph, wire: Ros2Wire) -> dict[str, Any]:
    from zstate.wire.ros2.streams import ros_type

    def ends_facts(ends: Sequence[RosEndpoint]) -> list[dict[str, Any]]:
        return [
            {"node": end.full_name, "zid": end.zid, "type_hash": end.hash, **asdict(end.qos)} for end in ends
        ]

    return {
        "wire": wire.name,
        "domain": wire.options.domain if wire.name == "ros2" else None,
        "nodes": [{"node": node.full_name, "zid": node.zid, "enclave": node.enclave} for node in graph.nodes],
        "topics": [
            {
                "topic": topic.name,
                "type": ros_type(topic.stream).name,
                "publishers": ends_facts(topic.publishers),
                "subscribers": ends_facts(topic.subscribers),
            }
            for topic in graph.topics
        ],
    }
