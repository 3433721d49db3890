"""Native wire format: plain keys, MessagePack arrays, type and version in the Zenoh encoding.

docs/wire.md is its specification.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

import msgspec

from zstate.errors import InvalidInput, MessageError
from zstate.stream_registry import all_streams, edge_streams, find_stream, is_named, is_own, stream_named
from zstate.streams import BULK_BYTES, StreamName
from zstate.wire import keys
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.messages import JointState, Message, check_edges, check_size
from zstate.wire.protocol import Envelope, GraphNode, SerializedSample

VERSION = 1

M = TypeVar("M", bound=Message)

# The smallest limit: most payloads pass with one comparison.
_MIN_LIMIT_BYTES = 1_000

_ENCODER = msgspec.msgpack.Encoder()


class _Decoders(dict[type[Message], msgspec.msgpack.Decoder[Message]]):
    """A decoder of each type, made at its first use."""

    def __missing__(self, kind: type[Message]) -> msgspec.msgpack.Decoder[Message]:
        self[kind] = decoder = msgspec.msgpack.Decoder(kind)
        return decoder


_DECODERS = _Decoders()
_ENCODING = re.compile(r"zstate/(\w+);v=([1-9]\d{0,8})")


def stream_encoding(stream: StreamName) -> str:
    """The Zenoh encoding of the messages of a stream. Raises InvalidInput for an unknown one."""
    return encoding_of(stream_named(stream).type)


@lru_cache(256)
def encoding_of(kind: type[Message]) -> str:
    """The Zenoh encoding of the messages of type ``kind``, which may be that of another package's stream."""
    version = VERSION
    if not _is_own(kind):
        version = next((row.version for row in all_streams() if row.type is kind), VERSION)
    return f"zstate/{_type_name(kind)};v={version}"


def _is_own(kind: type[Message]) -> bool:
    return kind.__module__.startswith("zstate.")


def _type_name(kind: type[Message]) -> str:
    return kind.type_name or kind.__name__


def encode(message: Message) -> bytes:
    """The payload of ``message``; its Zenoh encoding is ``encoding_of(type(message))``."""
    return message.pack(_ENCODER.encode(message))


def decode(payload: bytes, encoding: str, kind: type[M]) -> M:
    """The message of type ``kind`` in ``payload``, whose Zenoh encoding is ``encoding``.

    Raises MessageError with the reason "foreign" (another type, or not a zstate message), "newer version",
    "too large", "truncated" or "malformed". The buffer checks whether the numbers are finite.
    """
    if encoding != encoding_of(kind):
        raise _foreign_error(encoding, kind)
    if len(payload) > _MIN_LIMIT_BYTES and len(payload) > (kind.max_bytes or BULK_BYTES):
        raise MessageError(f"a {_type_name(kind)} of {len(payload)} bytes", reason="too large")
    try:
        return _DECODERS[kind].decode(kind.unpack(payload))  # type: ignore[return-value]  # one decoder per type
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        if isinstance(error.__cause__, MessageError):  # of the message's own check
            raise error.__cause__ from None
        # msgspec raises one exception for both; only the texts differ
        if type(error) is msgspec.DecodeError and "truncated" in str(error):
            text = f"a {_type_name(kind)} cut off after {len(payload)} bytes"
            raise MessageError(text, reason="truncated") from None
        raise MessageError(f"a malformed {_type_name(kind)}: {error}", reason="malformed") from None


def decode_joint_state(payload: bytes) -> JointState:
    """The joint state in ``payload``, which this process encoded."""
    return decode(payload, encoding_of(JointState), JointState)


class _JointPositions(msgspec.Struct, array_like=True, gc=False):
    """The fields of a JointState as far as its positions."""

    stamp: int
    seq: int
    session: int
    order: bytes
    positions: memoryview


_POSITIONS_DECODER = msgspec.msgpack.Decoder(_JointPositions)


def joint_positions(payload: bytes) -> memoryview:
    """The positions of ``decode_joint_state(payload)``, in less than half of its time."""
    return _POSITIONS_DECODER.decode(payload).positions


class NativeStreamEncoder:
    """Encodes one stream of one writer as MessagePack."""

    can_withdraw = True
    attachment = None

    def __init__(self, robot: str, writer: WriterId, stream: StreamName, name: str) -> None:
        self.key = keys.stream_key(robot, stream, name)
        self.encoding = stream_encoding(stream)
        identity = Announcement(robot, stream, writer, name if is_named(stream) else "").identity
        self.token = None if stream == "clock" else keys.WRITER_TOKEN.key(robot, stream, identity)

    encode = staticmethod(encode)

    def compile_joint_states(self) -> None:
        return None


class NativeWire:
    """The native wire format (``zstate.wire.protocol.Wire``)."""

    name = "native"
    shared: frozenset[StreamName] = frozenset()
    transforms: StreamName = "transforms"
    partial_joint_states: StreamName = "partial_joint_states"

    @property
    def edges(self) -> tuple[StreamName, ...]:
        return edge_streams()

    def carries(self, stream: StreamName) -> bool:
        return find_stream(stream) is not None

    def node_token(self, node: GraphNode) -> None:
        return None

    def stream_encoder(
        self, node: GraphNode, stream: StreamName, number: int, name: str = ""
    ) -> NativeStreamEncoder:
        return NativeStreamEncoder(node.robot, node.identity, stream, name)

    def reader_tokens(
        self, node: GraphNode, streams: Sequence[StreamName], number: Callable[[], int]
    ) -> tuple[str, ...]:
        identity = replace(node.identity, session=number()).identity
        # A program that does not know a stream ignores all of its token.
        own = [stream for stream in streams if is_own(stream)]
        others = [[stream] for stream in streams if not is_own(stream)]
        return tuple(keys.READER_TOKEN.key(node.robot, one, identity) for one in (own, *others) if one)

    def expression(self, robot: str, stream: StreamName, name: str = keys.ANY) -> str:
        return keys.stream_expression(robot, stream, name)

    robot_from_key = staticmethod(keys.robot_from_key)

    def decode(self, stream: StreamName, arrival: SerializedSample, robot: str) -> Sequence[Message]:
        if arrival.size or len(arrival.payload) > _MIN_LIMIT_BYTES:
            check_size(stream, arrival.size or len(arrival.payload))
        message = decode(arrival.payload, arrival.encoding, stream_named(stream).type)
        if stream == "tf_static":
            check_edges(message)
        return (message,)

    def usual_envelope(self, stream: StreamName) -> Envelope:
        return Envelope(stream_encoding(stream))

    def edge_writer_name(self, key: str) -> str:
        keys.robot_from_key(key)
        return keys.check_writer(key.rpartition("/")[2])

    def writers_expression(self, robot: str) -> str:
        return keys.WRITER_TOKEN.expression(robot)

    def joined_tokens(self, tokens: Sequence[str]) -> Sequence[str]:
        announced = [one for token in tokens for one in self.parse_token(token, keys.ANY)]
        names = {one.name for one in announced if one.name}
        if not announced or len(names) > 1:  # a token has one name
            return tokens
        # With the name, if one has it.
        identity = max((one.identity for one in announced), key=len)
        return (keys.WRITER_TOKEN.key(announced[0].robot, [one.stream for one in announced], identity),)

    def parse_token(self, token: str, robot: str) -> tuple[Announcement, ...]:
        try:
            return Announcement.parse_all(*keys.WRITER_TOKEN.parse(token))
        except InvalidInput:
            return ()


def _version(kind: type[Message]) -> int:
    return int(encoding_of(kind).rpartition("=")[2])


def _foreign_error(encoding: str, kind: type[Message]) -> MessageError:
    match, name = _ENCODING.fullmatch(encoding), _type_name(kind)
    if match and match[1] == name and int(match[2]) > _version(kind):
        update = kind.__module__.partition(".")[0]
        text = f"{name} of version {match[2]}, but this {update} reads version {_version(kind)}"
        return MessageError(f"{text}: `pip install -U {update}`", reason="newer version")
    return MessageError(
        f"not a {name}: its encoding is {encoding!r}, ours is {encoding_of(kind)!r}; "
        "another program writes on this key",
        reason="foreign",
    )
