"""zstate ls: the announced robots and who writes for them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zstate.cli.console import is_terminal, note, output_width, say, say_fitted, say_json
from zstate.cli.network import Network, open_session
from zstate.cli.options import json_option, session_options, wire_option
from zstate.cli.words import is_ros, words_of

if TYPE_CHECKING:
    from zstate.cli.sampling import Sampler
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session

_MEASURED_WITHIN_S = 0.3
_AGAIN_S = 0.5
# Meeting everybody takes less.
_MEETING_S = 0.5


@click.command("ls")
@click.option("--watch", is_flag=True, help="Keep the list up to date, until Ctrl-C.")
@json_option("One JSON array; on ROS's side one object.")
@wire_option
@session_options
def ls_command(network: Network, *, watch: bool, as_json: bool, wire: str) -> None:
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
    from zstate.net.wires import wire_named
    from zstate.wire.ros2.wire import Ros2Wire

    spoken = wire_named(wire)
    assert isinstance(spoken, Ros2Wire)

    def text(graph: RosGraph) -> str:
        return ros_graph_text(graph, spoken) if graph.nodes or graph.topics else empty_ros_graph_text(spoken)

    if watch and as_json:
        _repeat_json(lambda: ros_graph_facts(discover_ros_graph(session, spoken), spoken))
    if watch:
        _show(lambda: text(discover_ros_graph(session, spoken)), lambda: discover_ros_graph(session, spoken))
    graph = discover_ros_graph(session, spoken)
    if as_json:
        say_json(ros_graph_facts(graph, spoken))
    elif graph.nodes or graph.topics:
        say_fitted(text(graph))
        hint = namespaces_hint(graph, spoken)
        if hint:
            note(hint)
    else:
        note(text(graph))


def _list_robots(session: Session, *, watch: bool, as_json: bool) -> None:
    from zstate.cli.output.robot_table import robots_facts, robots_text, sources
    from zstate.cli.sampling import Sampler
    from zstate.net.presence import discover

    with Sampler(session) as sampler:
        sampler.hear("joint_states")
        if watch:
            _watch_robots(session, sampler, as_json=as_json)
        robots = discover(session)
        sampler.wait(sources(robots), _MEASURED_WITHIN_S)
        if as_json:
            say_json(robots_facts(robots, sampler))
        elif robots:
            say_fitted(robots_text(robots, sampler, width=output_width()))
        else:
            note(words_of("native").announced(robots))


def _watch_robots(session: Session, sampler: Sampler, *, as_json: bool) -> NoReturn:
    from zstate.cli.output.robot_table import robots_facts, robots_text
    from zstate.cli.roster import Roster

    def text(robots: tuple[RobotInfo, ...], width: int | None) -> str:
        return robots_text(robots, sampler, width=width) if robots else roster.words.announced(robots)

    with Roster(session) as roster:
        time.sleep(_MEETING_S)
        if as_json:
            _repeat_json(lambda: robots_facts(roster.robots(), sampler))
        _show(lambda: text(roster.robots(), output_width()), roster.robots)


def _repeat_json(facts: Callable[[], Any]) -> NoReturn:
    while True:
        say_json(facts())
        time.sleep(1.0)


def _show(text: Callable[[], str], state: Callable[[], object]) -> NoReturn:
    """Keep ``text`` on the screen up to date; in a pipe say it whenever ``state`` is another one."""
    if is_terminal():
        from zstate.cli.live_text import keep_showing

        keep_showing(text)
    said: object = None
    while True:
        now = state()
        if now != said:
            say(f"{text()}\n")
        said = now
        time.sleep(_AGAIN_S)
