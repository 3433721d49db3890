"""zstate graph: who writes and reads what."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import click

from zstate._util.suggestions import did_you_mean
from zstate.cli.console import fail, note, say, say_fitted, say_json
from zstate.cli.network import Network, open_session
from zstate.cli.options import form_options, session_options, wire_option
from zstate.cli.words import is_ros, words_of

if TYPE_CHECKING:
    from zstate.cli.graph.graph import Graph


@click.command("graph")
@click.argument("robot", default="*", metavar="[ROBOT]")
@form_options("One JSON object: programs and streams.", "A picture, from left to right.")
@wire_option
@session_options
def graph_command(network: Network, robot: str, form: str | None, wire: str) -> None:
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
    from zstate.cli.graph.heard import native_graph, ros_graph

    with open_session(network, (wire,)) as session:
        graph = ros_graph(session, wire) if is_ros(wire) else native_graph(session)
    if robot != "*" and not is_ros(wire):
        graph = _of_robot(graph, robot)
    if form == "json":
        say_json(graph.facts())
    elif graph.streams:
        title = "Who writes and reads what" if robot == "*" else f"Who writes and reads what of {robot}"
        say_fitted(_drawn(graph, form, title)) if form is None else say(_drawn(graph, form, title))
    else:
        note(words_of(wire).announced(()))


def _of_robot(graph: Graph, robot: str) -> Graph:
    streams = tuple(one for one in graph.streams if one.robot in (robot, "*"))
    if not streams:
        hint = did_you_mean(robot, {one.robot for one in graph.streams})
        fail(f"nobody writes or reads anything of {robot!r}{hint}")
    return replace(graph, streams=streams)


def _drawn(graph: Graph, form: str | None, title: str) -> str:
    from zstate.cli.graph.graph import graph_text
    from zstate.cli.graph.picture import dot, mermaid, svg

    if form == "svg":
        return svg(graph, title=title)
    if form is not None:
        return dot(graph) if form == "dot" else mermaid(graph)
    return graph_text(graph)
