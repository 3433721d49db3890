"""RosGraph: the nodes that are there, and who publishes and subscribes what a robot's state consists of."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from zstate.wire.keys import Stream
from zstate.wire.ros2.graph import (
    DdsToken,
    EndpointToken,
    NodeToken,
    parse_dds_token,
    parse_token,
)
from zstate.wire.ros2.topics import type_of

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.wire.ros2.qos import Qos
    from zstate.wire.ros2.wire import Ros2Wire

STREAMS: tuple[Stream, ...] = ("joint_states", "tf", "tf_static", "robot_description", "clock")


@dataclass(frozen=True, order=True, slots=True)
class Endpoint:
    """A publisher or subscriber of a topic: ``node`` with its namespace, or the bridge that tells of it."""

    node: str
    zid: str
    type_hash: str
    qos: Qos = field(compare=False)


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic, with its leading slash, that carries ``stream``."""

    name: str
    stream: Stream
    publishers: tuple[Endpoint, ...]
    subscribers: tuple[Endpoint, ...]

    @property
    def type_name(self) -> str:
        return type_of(self.stream).name

    @property
    def namespace(self) -> str:
        """Without outer slashes; empty for the root."""
        return self.name.rpartition("/")[0].strip("/")


@dataclass(frozen=True, slots=True)
class RosGraph:
    """What is announced, sorted by name. Bridges of ros2dds tell of no nodes."""

    nodes: tuple[NodeToken, ...]
    topics: tuple[Topic, ...]


def heard_graph(session: Session, wire: Ros2Wire) -> RosGraph:
    """The graph as ``session`` hears it, in all namespaces. It may take a second where there is none."""
    from zstate.net.presence import living_tokens

    tokens = living_tokens(session, wire.writers_expression("*"))
    parse = parse_dds_token if wire.name == "ros2dds" else parse_token
    parsed = [one for one in map(parse, sorted(tokens)) if one is not None]
    nodes = [token for token in parsed if isinstance(token, NodeToken)]
    endpoints = [token for token in parsed if not isinstance(token, NodeToken)]
    return RosGraph(tuple(sorted(nodes, key=node_name)), tuple(_topics(endpoints)))


def node_name(node: NodeToken | EndpointToken) -> str:
    """The name of a node with its namespace."""
    name = node.name if isinstance(node, NodeToken) else node.node
    return f"{node.namespace.rstrip('/')}/{name}"


def _topics(tokens: list[EndpointToken | DdsToken]) -> Iterator[Topic]:
    by_topic: dict[tuple[str, Stream], list[EndpointToken | DdsToken]] = {}
    for token in tokens:
        stream = _stream_of(token)
        if stream is not None:
            by_topic.setdefault((f"/{token.topic.strip('/')}", stream), []).append(token)
    for (name, stream), ends in sorted(by_topic.items()):
        publishers = (_endpoint(end) for end in ends if end.kind == "MP")
        subscribers = (_endpoint(end) for end in ends if end.kind == "MS")
        yield Topic(name, stream, tuple(sorted(publishers)), tuple(sorted(subscribers)))


def _stream_of(token: EndpointToken | DdsToken) -> Stream | None:
    """The stream that the topic carries, by its last name and its type."""
    last = token.topic.rpartition("/")[2]
    for stream in STREAMS:
        kind = type_of(stream)
        is_typed = kind.name == token.type_name if isinstance(token, DdsToken) else kind.dds == token.dds_type
        if stream == last and is_typed:
            return stream
    return None


def _endpoint(token: EndpointToken | DdsToken) -> Endpoint:
    name = f"bridge {token.zid[:8]}" if isinstance(token, DdsToken) else node_name(token)
    return Endpoint(name, token.zid, token.hash, token.qos)
