"""ROS 2 wire formats: messages and graph of ROS nodes over Zenoh, without ROS."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from typing import Literal

from zstate.errors import InvalidInput, MessageError
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY
from zstate.wire.messages import Message, check_edges, check_size
from zstate.wire.protocol import Envelope, GraphNode, SerializedSample
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.graph import (
    ATTACHMENT_BYTES,
    DDS_GRAPH_EXPRESSION,
    DdsToken,
    EndpointToken,
    NodeToken,
    gid,
    graph_expression,
    parse_dds_token,
    parse_token,
    session_from_gid,
    unpack_attachment,
)
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.streams import has_named_topics, ros_stream, ros_streams, ros_type, topic_stream
from zstate.wire.ros2.topics import (
    SHARED,
    DdsKeys,
    FrameNames,
    RmwKeys,
    name_from_topic,
    robot_from_topic,
)


class Ros2Wire:
    """The wire format of rmw_zenoh_cpp: CDR with an attachment, and tokens of the ROS graph.

    ROS has topics and no robots. A listener to one robot reads the topics in the namespace of ``options``
    under that robot's name; a listener to all robots names them after their namespaces.
    """

    name = "ros2"
    shared: frozenset[StreamName] = frozenset({"tf", "tf_static"})
    transforms: StreamName = "tf"
    edges: tuple[StreamName, ...] = ("tf",)
    partial_joint_states: StreamName = "joint_states"
    _topic_keys = RmwKeys
    _has_gids = True

    def __init__(self, options: Ros2Options | None = None) -> None:
        self.options = options or Ros2Options()
        self._keys = self._topic_keys(self.options)
        self._decoder = RosDecoder()
        self._frame_names = lru_cache(64)(partial(FrameNames, self.options))

    def carries(self, stream: StreamName) -> bool:
        return stream in ros_streams()

    def node_token(self, node: GraphNode) -> str | None:
        self._frame_names(node.robot)  # raises InvalidInput before anything is declared
        return self._node(node).key

    def stream_encoder(
        self, node: GraphNode, stream: StreamName, number: int, name: str = ""
    ) -> RosStreamEncoder:
        token = self._endpoint_token(node, stream, "MP", number, name)
        names, key = self._frame_names(node.robot), self._keys.key(node.robot, stream, name)
        return RosStreamEncoder(names, node.sample_names, key, token, gid(token) if self._has_gids else None)

    def _node(self, node: GraphNode) -> NodeToken:
        namespace = f"/{self.options.robot_namespace(node.robot)}"
        name = self.options.node or re.sub(r"\W|^(?=\d|$)", "_", node.identity.program, flags=re.ASCII)
        return NodeToken(self.options.domain, node.zid, node.number, "/", namespace, name)

    def reader_tokens(
        self, node: GraphNode, streams: Sequence[StreamName], number: Callable[[], int]
    ) -> tuple[str, ...]:
        if node.robot == ANY:
            if self.options.namespace == ANY:
                return ()  # a subscription in the graph has one topic; these are any number of topics
            node = node._replace(robot=SHARED)
        endpoints = [self._endpoint_token(node, stream, "MS", number()) for stream in streams]
        return tuple(token for token in (self.node_token(node), *endpoints) if token is not None)

    def _endpoint_token(
        self, node: GraphNode, stream: StreamName, kind: Literal["MP", "MS"], number: int, name: str = ""
    ) -> str:
        """The token of ``node`` as publisher ("MP") or subscriber ("MS") of ``stream``."""
        topic, dds_type = self._keys.topic(node.robot, stream, name), ros_type(stream).dds
        type_hash = self._keys.key(node.robot, stream).rpartition("/")[2]
        qos = ros_stream(stream).qos
        return EndpointToken(self._node(node), number, kind, topic, dds_type, type_hash, qos).key

    def expression(self, robot: str, stream: StreamName, name: str = ANY) -> str:
        return self._keys.expression(robot, stream, name)

    def robot_from_key(self, key: str) -> str:
        return self._keys.robot_from_key(key)

    def usual_envelope(self, stream: StreamName) -> Envelope | None:
        is_known = self._has_gids and stream == "joint_states"
        return Envelope(RosStreamEncoder.encoding, ATTACHMENT_BYTES) if is_known else None

    def edge_writer_name(self, key: str) -> str | None:
        """The name of a scan's sensor, or of a map; None for edges, whose writers share the topics."""
        return self._keys.writer_name(key)

    def decode(self, stream: StreamName, arrival: SerializedSample, robot: str) -> Sequence[Message]:
        # CDR repeats all frame names in each sample.
        check_size(stream, arrival.size or len(arrival.payload), 4 if stream in ("tf", "joint_states") else 1)
        session, seq = self._origin(arrival)
        try:
            names = self._frame_names(robot)
        except InvalidInput as error:
            raise MessageError(f"a namespace that ROS does not allow: {error}", reason="foreign") from None
        messages = self._decoder.messages(stream, arrival.payload, session, seq, names)
        if stream == "tf_static":
            for message in messages:
                check_edges(message)
        return messages

    def _origin(self, arrival: SerializedSample) -> tuple[int, int]:
        """The writer's session and the sequence number."""
        attachment = unpack_attachment(arrival.attachment)
        return session_from_gid(attachment.gid), attachment.seq

    def writers_expression(self, robot: str) -> str:
        return graph_expression(self.options.domain)

    def joined_tokens(self, tokens: Sequence[str]) -> Sequence[str]:
        return tokens

    def parse_token(self, token: str, robot: str) -> tuple[Announcement, ...]:
        parsed = parse_token(token)
        if not isinstance(parsed, EndpointToken) or parsed.kind != "MP":
            return ()
        writer = WriterId(parsed.full_name, host="", pid=0, since=0, session=session_from_gid(gid(token)))
        node = f"{parsed.zid}/{parsed.node.nid}"
        return self._announcement(parsed.topic, parsed.dds_type, robot, writer, node)

    def _announcement(
        self, topic: str, dds_type: str, robot: str, writer: WriterId, node: str = ""
    ) -> tuple[Announcement, ...]:
        stream = topic_stream(topic, dds_type)
        if stream is None or stream == "clock":
            return ()
        named = robot_from_topic(topic) if robot == ANY else robot
        name = name_from_topic(topic) if has_named_topics(stream) else ""
        # a namespace or a name that ROS does not allow matches no topic
        with suppress(InvalidInput):
            if topic == self._keys.topic(named, stream, name):
                return (Announcement(named, stream, writer, name, node),)
        return ()


class Ros2DdsWire(Ros2Wire):
    """The wire format of zenoh-plugin-ros2dds: CDR on plain keys, without an attachment.

    Messages do not identify their writer, so a restart is detected by stamps only.
    """

    name = "ros2dds"
    _topic_keys = DdsKeys
    _has_gids = False  # its messages have no attachment

    def __init__(self, options: Ros2Options | None = None) -> None:
        super().__init__(options)
        self._received: Counter[str] = Counter()

    def node_token(self, node: GraphNode) -> None:
        """None, because the bridges announce no nodes. Raises InvalidInput as above."""
        super().node_token(node)

    def _endpoint_token(
        self, node: GraphNode, stream: StreamName, kind: Literal["MP", "MS"], number: int, name: str = ""
    ) -> str:
        ros, topic = ros_type(stream), self._keys.key(node.robot, stream, name)
        return DdsToken(node.zid, kind, topic, ros.name, ros_stream(stream).qos, ros.hash).key

    def _origin(self, arrival: SerializedSample) -> tuple[int, int]:
        self._received[arrival.key] += 1
        return 0, self._received[arrival.key]

    def writers_expression(self, robot: str) -> str:
        return DDS_GRAPH_EXPRESSION

    def parse_token(self, token: str, robot: str) -> tuple[Announcement, ...]:
        parsed = parse_dds_token(token)
        if parsed is None or parsed.kind != "MP":
            return ()
        writer = WriterId(f"ros2dds bridge {parsed.zid[:8]}", host="", pid=0, since=0, session=0)
        return self._announcement(f"/{parsed.topic}", parsed.dds_type, robot, writer)
