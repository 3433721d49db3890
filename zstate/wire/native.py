"""The native wire: plain keys, MessagePack arrays, type and version in the Zenoh encoding."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import msgspec

from zstate.errors import InvalidInput, MessageError
from zstate.wire.keys import (
    Stream,
    check_writer,
    parse_writer_key,
    reader_key,
    robot_of,
    stream_expression,
    stream_key,
    writer_expression,
    writer_key,
)
from zstate.wire.messages import (
    Clock,
    JointCommand,
    JointState,
    Message,
    Past,
    RobotDescription,
    StaticTransforms,
    Status,
    TransformSample,
)
from zstate.wire.sample_names import SampleNames
from zstate.wire.sizes import LATCHED_BYTES, SAMPLE_BYTES, check_edges, check_size
from zstate.wire.wire import Arrival, Place
from zstate.wire.writer import Announced, Writer

VERSION = 1

M = TypeVar("M", bound=Message)

_TYPES: tuple[type[Message], ...] = (
    JointState,
    TransformSample,
    JointCommand,
    StaticTransforms,
    RobotDescription,
    Clock,
    Status,
    Past,
)
ENCODINGS: dict[type[Message], str] = {kind: f"zstate/{kind.__name__};v={VERSION}" for kind in _TYPES}
STREAM_TYPES: dict[Stream, type[Message]] = {
    "joint_states": JointState,
    "tf": TransformSample,
    "tf_static": StaticTransforms,
    "robot_description": RobotDescription,
    "joint_commands": JointCommand,
    "clock": Clock,
}

# Nothing is too large that is not larger than this.
_LEAST_BYTES = 1_000

# Of what travels on no stream of its own.
_MOST_BYTES: dict[type[Message], int] = {Status: 64_000, Past: 4 * SAMPLE_BYTES}

_ENCODER = msgspec.msgpack.Encoder()
_DECODERS = {kind: msgspec.msgpack.Decoder(kind) for kind in _TYPES}
_ENCODING = re.compile(r"zstate/(\w+);v=([1-9]\d{0,8})")


def encode(message: Message) -> bytes:
    """The bytes of ``message``; they travel under the encoding ``ENCODINGS[type(message)]``."""
    return _ENCODER.encode(message)


def decode(payload: bytes, encoding: str, kind: type[M]) -> M:
    """The message of type ``kind`` in ``payload``, whose Zenoh encoding is ``encoding``.

    Raises MessageError with the reason "foreign" (another type, or not ours at all), "newer version",
    "truncated" or "malformed". Whether the numbers are finite is the buffer's business.
    """
    if encoding != ENCODINGS[kind]:
        raise _stranger(encoding, kind)
    if len(payload) > _LEAST_BYTES and len(payload) > _MOST_BYTES.get(kind, LATCHED_BYTES):
        raise MessageError(f"a {kind.__name__} of {len(payload)} bytes", reason="too large")
    try:
        return _DECODERS[kind].decode(payload)  # type: ignore[return-value]  # one decoder per type
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _broken(payload, kind, error) from None


class NativeOutlet:
    """How one writer says one stream on the native wire."""

    can_withdraw = True

    def __init__(self, robot: str, stream: Stream, writer: Writer, name: str) -> None:
        self.key = stream_key(robot, stream, name)
        self.encoding = ENCODINGS[STREAM_TYPES[stream]]
        said = Announced(robot, stream, writer, name if stream == "tf_static" else "")
        self.token = None if stream == "clock" else writer_key(robot, stream, said.identity)

    def encode(self, message: Message) -> bytes:
        return _ENCODER.encode(message)

    def attachment(self, now: int) -> None:
        return None


class NativeVoice:
    """One writer of one robot on the native wire."""

    token = None

    def __init__(self, robot: str, writer: Writer) -> None:
        self._robot = robot
        self._writer = writer

    def outlet(self, stream: Stream, number: int, name: str = "") -> NativeOutlet:
        return NativeOutlet(self._robot, stream, self._writer, name)


class NativeWire:
    """The native wire behind the seam of ``zstate.wire.wire.Wire``."""

    name = "native"
    shared: frozenset[Stream] = frozenset()

    def voice(self, robot: str, writer: Writer, place: Place, sample_names: SampleNames) -> NativeVoice:
        return NativeVoice(robot, writer)

    def reader_tokens(
        self, robot: str, streams: Sequence[Stream], reader: Writer, zid: str, number: Callable[[], int]
    ) -> tuple[str, ...]:
        identity = replace(reader, session=number()).identity
        return tuple(reader_key(robot, stream, identity) for stream in streams)

    def expression(self, robot: str, stream: Stream) -> str:
        return stream_expression(robot, stream)

    robot_of = staticmethod(robot_of)

    def decode(self, stream: Stream, arrival: Arrival, robot: str) -> Sequence[Message]:
        if arrival.size or len(arrival.payload) > _LEAST_BYTES:
            check_size(stream, arrival.size or len(arrival.payload))
        message = decode(arrival.payload, arrival.encoding, STREAM_TYPES[stream])
        if stream == "tf_static":
            check_edges(message)
        return (message,)

    def statics_writer(self, key: str) -> str:
        robot_of(key)
        return check_writer(key.rpartition("/")[2])

    def writers_expression(self, robot: str) -> str:
        return writer_expression(robot)

    def announced(self, token: str, robot: str) -> Announced | None:
        try:
            return Announced.parse(*parse_writer_key(token))
        except InvalidInput:
            return None


def _stranger(encoding: str, kind: type[Message]) -> MessageError:
    match = _ENCODING.fullmatch(encoding)
    if match and match[1] == kind.__name__ and int(match[2]) > VERSION:
        return MessageError(
            f"{kind.__name__} of version {match[2]}, but this zstate reads version {VERSION}: "
            "`pip install -U zstate`",
            reason="newer version",
        )
    return MessageError(
        f"not a {kind.__name__}: its encoding is {encoding!r}, ours is {ENCODINGS[kind]!r}; "
        "another program writes on this key",
        reason="foreign",
    )


def _broken(payload: bytes, kind: type[Message], error: Exception) -> MessageError:
    # msgspec has one exception for both and tells them apart in its text only
    if type(error) is msgspec.DecodeError and "truncated" in str(error):
        return MessageError(f"a {kind.__name__} cut off after {len(payload)} bytes", reason="truncated")
    return MessageError(f"a malformed {kind.__name__}: {error}", reason="malformed")
