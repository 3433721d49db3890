"""Protocols that a wire format implements: encoding, keys, liveliness tokens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

from msgspec import Struct

from zstate.errors import InvalidInput
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.joint_order import SampleLayout
from zstate.wire.keys import ANY, check_robot
from zstate.wire.messages import Message

if TYPE_CHECKING:
    from zstate._kernel import RosJointStateEncoder


class SerializedSample(Struct, frozen=True, gc=False):
    """One payload as received from the network, with its key, encoding and attachment.

    If the payload exceeds the limit of its stream, ``size`` is its length and ``payload`` a single byte,
    because an empty payload would mean a withdrawn value. Decoding such a sample raises MessageError.
    """

    key: str
    payload: bytes
    encoding: str
    attachment: bytes | None = None
    size: int = 0


class Envelope(NamedTuple):
    """What surrounds the payloads of a stream: Zenoh encoding, and the size of the attachment, 0 for none."""

    encoding: str
    attachment_bytes: int = 0


NO_ENVELOPE = Envelope("")


class GraphNode(NamedTuple):
    """A writer or reader of ``robot``, a node in a ROS graph: its Zenoh session, and its number in that.

    ``sample_names`` are the names behind the numbers of a writer's samples.
    """

    robot: str
    identity: WriterId
    zid: str
    number: int
    sample_names: SampleLayout = SampleLayout()


class StreamEncoder(Protocol):
    """Encodes one stream of one writer: key, Zenoh encoding, liveliness token, payloads, attachments."""

    key: str
    """The key of the stream."""

    encoding: str
    """The Zenoh encoding of the payloads; empty for none."""

    token: str | None
    """The liveliness token of this writer of this stream, if the wire format has one."""

    can_withdraw: bool
    """Whether readers of this wire format accept that a latched value is withdrawn."""

    def encode(self, message: Message) -> bytes:
        """The payload of ``message``. Raises InvalidInput if the wire format cannot represent it."""
        ...

    def compile_joint_states(self) -> RosJointStateEncoder | None:
        """The extension's encoder of usual joint states in this wire format.

        None if its payloads are those of the native wire. ``attachment`` continues the numbers of the
        attachments that the encoder makes.
        """
        ...

    @property
    def attachment(self) -> Callable[[int], bytes | None] | None:
        """Returns the attachment of the next payload for the time of sending [ns]; None if there are none."""
        ...


def carrier(wire: Wire, stream: StreamName) -> StreamName:
    """The stream that carries ``stream`` on ``wire``: in ROS transforms are on /tf."""
    if stream == "transforms":
        return wire.transforms
    return wire.partial_joint_states if stream == "partial_joint_states" else stream


class WriterTokens(Protocol):
    """The liveliness tokens of writers on the network."""

    def writers_expression(self, robot: str) -> str:
        """The key expression of the tokens of all writers of ``robot``, or of all robots for ``"*"``."""
        ...

    def parse_token(self, token: str, robot: str) -> tuple[Announcement, ...]:
        """The writer with each of its streams in a token under that expression; empty for any other token."""
        ...


class Wire(WriterTokens, Protocol):
    """One wire format for the streams of a robot: keys, encodings and bytes.

    A stream carries the same messages in each, those of the type in its row (``zstate.streams``).
    Decoding may keep state, so each reader has an instance of its own.
    """

    name: str
    """Its name for users: "native", ..."""

    shared: frozenset[StreamName]
    """The streams of a robot that several writers publish, each a part."""

    transforms: StreamName
    """The stream that carries the edges of a ``TransformPublisher``."""

    @property
    def edges(self) -> tuple[StreamName, ...]:
        """The streams of all moving edges that are not a model's."""
        ...

    partial_joint_states: StreamName
    """The stream that carries the joints of a ``PartialStatePublisher``."""

    def carries(self, stream: StreamName) -> bool:
        """Whether the wire format has this stream."""
        ...

    def node_token(self, node: GraphNode) -> str | None:
        """The liveliness token of a writer as a node of the ROS graph; None if there is no such graph."""
        ...

    def stream_encoder(
        self, node: GraphNode, stream: StreamName, number: int, name: str = ""
    ) -> StreamEncoder:
        """The encoder of ``stream`` for the writer ``node``.

        ``number`` identifies the stream within the session; ``name`` is the one under which the writer
        publishes edges, joints, scans or a map. Raises InvalidInput for names that cannot be in a key.
        """
        ...

    def reader_tokens(
        self, node: GraphNode, streams: Sequence[StreamName], number: Callable[[], int]
    ) -> tuple[str, ...]:
        """The liveliness tokens of ``node``, a reader of ``streams``, of all robots if its robot is ``"*"``.

        ``number()`` returns the next unused number of the session.
        """
        ...

    def expression(self, robot: str, stream: StreamName, name: str = ANY) -> str:
        """The key expression of ``stream`` from all writers of ``robot``, or of all robots for ``"*"``.

        ``name`` selects one writer of a stream whose writers have names.
        """
        ...

    def robot_from_key(self, key: str) -> str:
        """The robot that a key belongs to. Raises InvalidInput if it belongs to none."""
        ...

    def decode(self, stream: StreamName, arrival: SerializedSample, robot: str) -> Sequence[Message]:
        """The messages of a sample received on ``stream`` of ``robot``. Raises MessageError."""
        ...

    def usual_envelope(self, stream: StreamName) -> Envelope | None:
        """The envelope of samples whose payloads a ``FastPath`` can compare; None if it knows no format."""
        ...

    def edge_writer_name(self, key: str) -> str | None:
        """The name under which the edges, joints, scans or maps on ``key`` are published, if the key has it.

        Raises InvalidInput if the key belongs to no robot.
        """
        ...

    def joined_tokens(self, tokens: Sequence[str]) -> Sequence[str]:
        """As few liveliness tokens as can announce the same streams of one writer as ``tokens``."""
        ...


def selected_robots(robot: str | Sequence[str], wire: Wire) -> tuple[str, ...]:
    """``robot`` as a tuple of names. Raises InvalidInput unless a sequence has different valid names."""
    if isinstance(robot, str):
        return (robot,)
    if robot is None:  # pyright: ignore[reportUnnecessaryComparison]  # e.g. of a missing variable
        check_robot(robot)
    names = tuple(robot)
    if not names:
        raise InvalidInput("robot is an empty sequence; name the robots, or give '*' for all")
    if ANY in names:
        raise InvalidInput("'*' is in a sequence of robots; give robot='*' for all, or the names alone")
    for name in names:
        check_robot(name)
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        text = ", ".join(map(repr, repeated))
        raise InvalidInput(f"the sequence of robots has {text} more than once; name each robot once")
    if wire.shared and len(names) > 1:
        raise InvalidInput(
            f"the sequence of robots has {len(names)} names; on the wire {wire.name!r} robots share topics "
            "whose keys do not name one of them; open a listener for each robot, on one buffer"
        )
    return names
