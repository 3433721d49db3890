"""The ROS 2 wires: what ROS nodes say and hear over Zenoh, without ROS."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Literal

from zstate.errors import InvalidInput, MessageError
from zstate.wire.keys import ANY, Stream
from zstate.wire.messages import Message
from zstate.wire.ros2.attachment import session_of, unpack
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.ros2.graph import (
    DDS_GRAPH_EXPRESSION,
    DdsToken,
    EndpointToken,
    NodeToken,
    gid,
    graph_expression,
    parse_dds_token,
    parse_token,
)
from zstate.wire.ros2.hearing import RosHearing
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.outlet import Address, RosOutlet
from zstate.wire.ros2.qos import STREAM_QOS
from zstate.wire.ros2.topics import SHARED, DdsKeys, RmwKeys, TopicKeys, robot_of_topic, type_of
from zstate.wire.sample_names import SampleNames
from zstate.wire.sizes import check_edges, check_size
from zstate.wire.wire import Arrival, Place
from zstate.wire.writer import Announced, Writer

STREAMS: tuple[Stream, ...] = ("joint_states", "tf", "tf_static", "robot_description")


class RosVoice:
    """One ROS node: a writer of one robot."""

    def __init__(self, wire: Ros2Wire, robot: str, node: NodeToken, sample_names: SampleNames) -> None:
        self._wire = wire
        self._robot = robot
        self._sample_names = sample_names
        self._names = FrameNames(wire.options, robot)
        self._node = node
        self.token = wire.node_token(node)

    def outlet(self, stream: Stream, number: int, name: str = "") -> RosOutlet:
        key = self._wire.key(self._robot, stream)
        token = self._wire.endpoint_token(self._node, self._robot, stream, "MP", number)
        return RosOutlet(
            stream, Address(key, token, self._wire.gid_of(token)), self._names, self._sample_names
        )


class Ros2Wire:
    """As ROS 2 nodes on rmw_zenoh_cpp speak: CDR, with an attachment, announced in the ROS graph.

    ROS has topics and no robots. A listener to one robot calls by its name whatever is said in the
    namespace of ``options``; a listener to all calls by the namespace's name what stands in one.
    """

    name = "ros2"
    shared: frozenset[Stream] = frozenset({"tf", "tf_static"})

    def __init__(self, options: Ros2Options | None = None) -> None:
        self.options = options or Ros2Options()
        self._keys = self._key_layout(self.options)
        self._hearing = RosHearing()
        self._frame_names = lru_cache(64)(partial(FrameNames, self.options))

    def _key_layout(self, options: Ros2Options) -> TopicKeys:
        return RmwKeys(options)

    def voice(self, robot: str, writer: Writer, place: Place, sample_names: SampleNames) -> RosVoice:
        return RosVoice(self, robot, self._node(robot, writer.program, place), sample_names)

    def _node(self, robot: str, program: str, place: Place) -> NodeToken:
        namespace = f"/{self.options.namespace_of(robot)}"
        name = self.options.node or re.sub(r"\W|^(?=\d|$)", "_", program, flags=re.ASCII)
        return NodeToken(self.options.domain, place.zid, place.number, "/", namespace, name)

    def reader_tokens(
        self, robot: str, streams: Sequence[Stream], reader: Writer, zid: str, number: Callable[[], int]
    ) -> tuple[str, ...]:
        if robot == ANY:
            if self.options.namespace == ANY:
                return ()  # a subscription in the graph is to one topic, and these are any number
            robot = SHARED
        node = self._node(robot, reader.program, Place(zid, number()))
        endpoints = [self.endpoint_token(node, robot, stream, "MS", number()) for stream in streams]
        return tuple(token for token in (self.node_token(node), *endpoints) if token is not None)

    def key(self, robot: str, stream: Stream) -> str:
        """The key to put ``stream`` of ``robot`` on."""
        return self._keys.key(robot, stream)

    def node_token(self, node: NodeToken) -> str | None:
        """The token of a node of ours."""
        return node.key

    def endpoint_token(
        self, node: NodeToken, robot: str, stream: Stream, kind: Literal["MP", "MS"], number: int
    ) -> str:
        """The token by which ``node`` is known to publish ("MP") or read ("MS") ``stream`` of ``robot``."""
        return EndpointToken(
            domain=node.domain,
            zid=node.zid,
            nid=node.nid,
            eid=number,
            kind=kind,
            enclave=node.enclave,
            namespace=node.namespace,
            node=node.name,
            topic=self._keys.topic(robot, stream),
            dds_type=type_of(stream).dds,
            hash=self.key(robot, stream).rpartition("/")[2],
            qos=STREAM_QOS[stream],
        ).key

    def gid_of(self, token: str) -> bytes | None:
        """By what readers know the writer whose token this is."""
        return gid(token)

    def expression(self, robot: str, stream: Stream) -> str:
        return self._keys.expression(robot, stream)

    def robot_of(self, key: str) -> str:
        return self._keys.robot_of(key)

    def statics_writer(self, key: str) -> None:
        """The key does not tell: all static edges of ROS share one topic."""

    def decode(self, stream: Stream, arrival: Arrival, robot: str) -> Sequence[Message]:
        # CDR repeats the names of all frames with each sample.
        check_size(stream, arrival.size or len(arrival.payload), 4 if stream in ("tf", "joint_states") else 1)
        session, seq = self._origin(arrival)
        try:
            names = self._frame_names(robot)
        except InvalidInput as error:
            raise MessageError(f"a namespace that ROS does not have: {error}", reason="foreign") from None
        messages = self._hearing.messages(stream, arrival.payload, session, seq, names)
        if stream == "tf_static":
            for message in messages:
                check_edges(message)
        return messages

    def _origin(self, arrival: Arrival) -> tuple[int, int]:
        """Which start of a writer, and which of its messages."""
        attachment = unpack(arrival.attachment)
        return session_of(attachment.gid), attachment.seq

    def writers_expression(self, robot: str) -> str:
        return graph_expression(self.options.domain)

    def announced(self, token: str, robot: str) -> Announced | None:
        parsed = parse_token(token)
        if not isinstance(parsed, EndpointToken) or parsed.kind != "MP":
            return None
        writer = Writer(parsed.full_name, host="", pid=0, since=0, session=session_of(gid(token)))
        return self._announced(parsed.topic, parsed.dds_type, robot, writer)

    def _announced(self, topic: str, dds_type: str, robot: str, writer: Writer) -> Announced | None:
        named = robot_of_topic(topic) if robot == ANY else robot
        for stream in STREAMS:
            if dds_type == type_of(stream).dds and self._speaks_of(topic, named, stream):
                return Announced(named, stream, writer)
        return None

    def _speaks_of(self, topic: str, robot: str, stream: Stream) -> bool:
        try:
            return topic == self._keys.topic(robot, stream)
        except InvalidInput:
            return False  # a namespace that ROS does not have


class Ros2DdsWire(Ros2Wire):
    """As zenoh-plugin-ros2dds carries ROS 2 over Zenoh: CDR on plain keys, nothing beside it.

    Who writes a message is not told, so that a restart is seen by its stamps only.
    """

    name = "ros2dds"

    def __init__(self, options: Ros2Options | None = None) -> None:
        super().__init__(options)
        self._heard: Counter[str] = Counter()

    def _key_layout(self, options: Ros2Options) -> TopicKeys:
        return DdsKeys(options)

    def node_token(self, node: NodeToken) -> None:
        """The bridges tell no nodes."""

    def endpoint_token(
        self, node: NodeToken, robot: str, stream: Stream, kind: Literal["MP", "MS"], number: int
    ) -> str:
        ros = type_of(stream)
        return DdsToken(node.zid, kind, self.key(robot, stream), ros.name, STREAM_QOS[stream], ros.hash).key

    def gid_of(self, token: str) -> None:
        """Nothing goes beside their messages."""

    def _origin(self, arrival: Arrival) -> tuple[int, int]:
        self._heard[arrival.key] += 1
        return 0, self._heard[arrival.key]

    def writers_expression(self, robot: str) -> str:
        return DDS_GRAPH_EXPRESSION

    def announced(self, token: str, robot: str) -> Announced | None:
        parsed = parse_dds_token(token)
        if parsed is None or parsed.kind != "MP":
            return None
        writer = Writer(f"ros2dds bridge {parsed.zid[:8]}", host="", pid=0, since=0, session=0)
        return self._announced(f"/{parsed.topic}", parsed.dds_type, robot, writer)
