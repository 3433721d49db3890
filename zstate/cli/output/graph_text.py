"""The graph of programs and streams, and the ROS graph: as text, as a drawing and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from zstate.cli.output.console import count_text
from zstate.cli.output.text_layout import in_columns

if TYPE_CHECKING:
    from zstate.cli.output.drawing import Drawing
    from zstate.net.graph import Graph, RosEndpoint, RosGraph, Topic
    from zstate.wire.ros2.wire import Ros2Wire

_PROGRAM_FILL = "#eef2ff"


def graph_text(graph: Graph) -> str:
    """Each group of streams, with its writers and readers."""
    lines: list[str] = []
    for group in graph.groups:
        names = ", ".join(stream.label for stream in group.streams)
        lines.append(f"{group.robot}: {names}" if group.robot else names)
        for role, programs in (("written by", group.writers), ("read by", group.readers)):
            shown = programs or ("nobody",)
            heads = (role, *[""] * (len(shown) - 1))
            lines += [f"  {head:<10}  {program}" for head, program in zip(heads, shown, strict=True)]
    return "\n".join(lines)


def graph_drawing(graph: Graph) -> Drawing:
    """Programs and groups of streams, with edges in the direction of the data.

    The edges of each program that writes have a colour. A group without a writer has a dashed red box.
    """
    from zstate.cli.output.drawing import ALARM, INK, LINE, PALETTE, Drawing, Edge, Node

    nodes: list[Node] = []
    writes: list[tuple[str, str]] = []
    reads: list[tuple[str, str]] = []
    for number, group in enumerate(graph.groups):
        name, labels = f"streams {number}", [stream.label for stream in group.streams]
        lines, unwritten = [group.robot, *labels] if group.robot else labels, not group.writers
        stroke = ALARM if unwritten else LINE
        nodes.append(Node(name, lines, stroke=stroke, dashed=unwritten, text_color=INK))
        writes += [(f"program {one}", name) for one in group.writers]
        reads += [(name, f"program {one}") for one in group.readers]
    for program in graph.programs:
        name, at, place = program.partition("@")
        lines = [name, place] if at and name else [program]
        nodes.append(Node(f"program {program}", lines, rounded=True, fill=_PROGRAM_FILL))
    writers = dict.fromkeys(writer for writer, _ in writes)
    colors = {writer: PALETTE[number % len(PALETTE)] for number, writer in enumerate(writers)}
    edges = [
        Edge(begin, end, stroke=colors.get(begin, colors.get(end, LINE))) for begin, end in (*writes, *reads)
    ]
    return Drawing("zstate", "flow", nodes, edges)


def graph_facts(graph: Graph) -> dict[str, Any]:
    """The graph as JSON."""
    streams = [
        {
            "robot": stream.robot,
            "stream": stream.name,
            "rate_hz": stream.rate_hz,
            "writers": list(stream.writers),
            "readers": list(stream.readers),
        }
        for stream in graph.streams
    ]
    return {"programs": graph.programs, "streams": streams}


def ros_graph_text(graph: RosGraph, wire: Ros2Wire) -> str:
    """Nodes, then topics with their publishers and subscribers."""
    from zstate.wire.ros2.topics import ros_type

    lines: list[str] = []
    if wire.name == "ros2":
        lines += [f"{count_text(len(graph.nodes), 'node')} in domain {wire.options.domain}"]
        lines += [f"  {node.full_name}" for node in graph.nodes]
    for topic in graph.topics:
        ends = [("  publisher", end) for end in topic.publishers]
        ends += [("  subscriber", end) for end in topic.subscribers]
        rows = [(role, end.full_name, _qos_text(end), _hash_text(end, topic)) for role, end in ends]
        lines += [f"{topic.name}  {ros_type(topic.stream).name}", *in_columns(rows)]
    return "\n".join(lines)


def _qos_text(end: RosEndpoint) -> str:
    qos = end.qos
    depth = f"keep last {qos.depth}" if qos.history == "keep_last" else "keep all"
    return f"{qos.reliability}, {qos.durability}, {depth}".replace("_", " ")


def _hash_text(end: RosEndpoint, topic: Topic) -> str:
    """A type hash other than the usual one."""
    from zstate.wire.ros2.topics import HUMBLE_HASH, ros_type

    if end.hash == HUMBLE_HASH:
        return "humble"
    return "" if end.hash in ("", ros_type(topic.stream).hash) else "another version of the type"


def namespaces_hint(graph: RosGraph, wire: Ros2Wire) -> str:
    """The ``--wire`` options for robots in other namespaces; empty if there are none."""
    others = sorted({topic.namespace for topic in graph.topics} - {"", wire.options.namespace})
    if not others or wire.options.namespace == "*":
        return ""
    kept = f"domain={wire.options.domain}," if wire.options.domain else ""
    spec = f"{wire.name}:{kept}namespace="
    # Quoted, because shells expand the star to file names.
    every = f", or `--wire '{spec}*'` for each by its name" if any("/" not in name for name in others) else ""
    return f"in namespaces: {', '.join(others)}; for one of them say `--wire {spec}{others[0]}`{every}"


def empty_ros_graph_text(wire: Ros2Wire) -> str:
    """What an empty ROS graph may mean."""
    if wire.name == "ros2dds":
        return "no bridge of ros2dds tells of the state of a robot; is this the right router?"
    return (
        f"no ROS 2 node in domain {wire.options.domain}; do they run with RMW_IMPLEMENTATION=rmw_zenoh_cpp "
        "and this ROS_DOMAIN_ID, and is this their router?"
    )


def ros_graph_facts(graph: RosGraph, wire: Ros2Wire) -> dict[str, Any]:
    """The ROS graph as JSON."""
    from zstate.wire.ros2.topics import ros_type

    return {
        "wire": wire.name,
        "domain": wire.options.domain if wire.name == "ros2" else None,
        "nodes": [{"node": node.full_name, "zid": node.zid, "enclave": node.enclave} for node in graph.nodes],
        "topics": [
            {
                "topic": topic.name,
                "type": ros_type(topic.stream).name,
                "publishers": _ends_facts(topic.publishers),
                "subscribers": _ends_facts(topic.subscribers),
            }
            for topic in graph.topics
        ],
    }


def _ends_facts(ends: Sequence[RosEndpoint]) -> list[dict[str, Any]]:
    return [
        {
            "node": end.full_name,
            "zid": end.zid,
            "type_hash": end.hash,
            "reliability": end.qos.reliability,
            "durability": end.qos.durability,
            "history": end.qos.history,
            "depth": end.qos.depth,
        }
        for end in ends
    ]
