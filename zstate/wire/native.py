"""The native wire: plain keys, MessagePack arrays, type and version in the Zenoh encoding."""

from __future__ import annotations

import re
from typing import TypeVar

import msgspec

from zstate.errors import MessageError
from zstate.wire.keys import Stream, stream_expression, stream_key
from zstate.wire.messages import (
    Clock,
    JointCommand,
    JointState,
    Message,
    RobotDescription,
    StaticTransforms,
    TransformSample,
)

VERSION = 1

M = TypeVar("M", bound=Message)

_TYPES: tuple[type[Message], ...] = (
    JointState,
    TransformSample,
    JointCommand,
    StaticTransforms,
    RobotDescription,
    Clock,
)
ENCODINGS: dict[type[Message], str] = {kind: f"zstate/{kind.__name__};v={VERSION}" for kind in _TYPES}
STREAM_TYPES: dict[Stream, type[Message]] = {
    "joint_states": JointState,
    "tf": TransformSample,
    "tf_static": StaticTransforms,
    "robot_description": RobotDescription,
    "joint_commands": JointCommand,
}

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
    try:
        return _DECODERS[kind].decode(payload)  # type: ignore[return-value]  # one decoder per type
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _broken(payload, kind, error) from None


class NativeWire:
    """The native wire behind the seam of ``zstate.wire.wire.Wire``."""

    name = "native"

    def key(self, robot: str, stream: Stream, writer: str = "") -> str:
        return stream_key(robot, stream, writer)

    def expression(self, robot: str, stream: Stream) -> str:
        return stream_expression(robot, stream)

    def encoding(self, stream: Stream) -> str:
        return ENCODINGS[STREAM_TYPES[stream]]

    def encode(self, message: Message) -> bytes:
        return _ENCODER.encode(message)

    def decode(self, stream: Stream, payload: bytes, encoding: str) -> Message:
        return decode(payload, encoding, STREAM_TYPES[stream])


def _stranger(encoding: str, kind: type[Message]) -> MessageError:
    match = _ENCODING.fullmatch(encoding)
    if match and match[1] == kind.__name__ and int(match[2]) > VERSION:
        return MessageError(
            f"{kind.__name__} of version {match[2]}, but this zstate reads version {VERSION}: upgrade it",
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
