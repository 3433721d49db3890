"""The ROS graph as lines for a person, and as facts for a program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from zstate.cli.console import count_text
from zstate.cli.layout import in_columns
from zstate.cli.ros_graph import Endpoint, RosGraph, Topic, node_name
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.topics import HUMBLE_HASH, type_of
from zstate.wire.ros2.wire import Ros2Wire


def graph_text(graph: RosGraph, wire: Ros2Wire) -> str:
    """Nodes, then topics with who publishes and subscribes them."""
    lines: list[str] = []
    if wire.name == "ros2":
        lines += [f"{count_text(len(graph.nodes), 'node')} in domain {wire.options.domain}"]
        lines += [f"  {node_name(node)}" for node in graph.nodes]
    for topic in graph.topics:
        lines += [f"{topic.name}  {topic.type_name}", *in_columns(_rows(topic))]
    return "\n".join(lines)


def _rows(topic: Topic) -> list[tuple[str, ...]]:
    ends = [("publisher", end) for end in topic.publishers]
    ends += [("subscriber", end) for end in topic.subscribers]
    return [(f"  {role}", end.node, _qos_text(end.qos), _hash_text(end, topic)) for role, end in ends]


def _qos_text(qos: Qos) -> str:
    depth = f"keep last {qos.depth}" if qos.history == "keep_last" else "keep all"
    return f"{qos.reliability}, {qos.durability}, {depth}".replace("_", " ")


def _hash_text(end: Endpoint, topic: Topic) -> str:
    """What is particular about the type at this end; usually nothing."""
    if end.type_hash == HUMBLE_HASH:
        return "humble"
    return "" if end.type_hash in ("", type_of(topic.stream).hash) else "another version of the type"


def namespaces_hint(graph: RosGraph, wire: Ros2Wire) -> str:
    """How to call for the robots that stand in namespaces; empty if that is what ``wire`` does."""
    others = sorted({topic.namespace for topic in graph.topics} - {"", wire.options.namespace})
    if not others or wire.options.namespace == "*":
        return ""
    kept = f"domain={wire.options.domain}," if wire.options.domain else ""
    spec = f"{wire.name}:{kept}namespace="
    # quoted, for shells would take the star for files
    every = f", or `--wire '{spec}*'` for each by its name" if any("/" not in name for name in others) else ""
    return f"in namespaces: {', '.join(others)}; for one of them say `--wire {spec}{others[0]}`{every}"


def nobody_text(wire: Ros2Wire) -> str:
    """What it may mean that nobody is there."""
    if wire.name == "ros2dds":
        return "no bridge of ros2dds tells of the state of a robot; is this the right router?"
    return (
        f"no ROS 2 node in domain {wire.options.domain}; do they run with RMW_IMPLEMENTATION=rmw_zenoh_cpp "
        "and this ROS_DOMAIN_ID, and is this their router?"
    )


def graph_facts(graph: RosGraph, wire: Ros2Wire) -> dict[str, Any]:
    """The same for a program."""
    nodes = [{"node": node_name(node), "zid": node.zid, "enclave": node.enclave} for node in graph.nodes]
    return {
        "wire": wire.name,
        "domain": wire.options.domain if wire.name == "ros2" else None,
        "nodes": nodes,
        "topics": [_topic_facts(topic) for topic in graph.topics],
    }


def _topic_facts(topic: Topic) -> dict[str, Any]:
    return {
        "topic": topic.name,
        "type": topic.type_name,
        "publishers": _ends_facts(topic.publishers),
        "subscribers": _ends_facts(topic.subscribers),
    }


def _ends_facts(ends: Sequence[Endpoint]) -> list[dict[str, Any]]:
    return [
        {
            "node": end.node,
            "zid": end.zid,
            "type_hash": end.type_hash,
            "reliability": end.qos.reliability,
            "durability": end.qos.durability,
            "history": end.qos.history,
            "depth": end.qos.depth,
        }
        for end in ends
    ]
