"""CDR, the serialisation of ROS 2 messages, written and read value by value.

A payload is a 4-byte encapsulation header and the values one after the other, each aligned to a multiple of
its size, counted from the fifth byte. Padding, and bytes after the last value, are undefined: ROS 2 leaves
uninitialised memory there. Stamps are ``builtin_interfaces/Time``: seconds, and nanoseconds below a second.
``std_msgs/msg/String`` and ``rosgraph_msgs/msg/Clock``, messages of a single value, are encoded here.
"""

from __future__ import annotations

from struct import Struct

import numpy as np

from zstate.errors import InvalidInput, MessageError
from zstate.wire.ros2.types import CLOCK, STRING

STAMP_BYTES = 8
HEADER_BYTES = 4
BIG_ENDIAN, LITTLE_ENDIAN = b"\x00\x00", b"\x00\x01"

Span = tuple[int, int]  # first byte, and the one after the last

_SECOND = 1_000_000_000
_EARLIEST, _LATEST = -(2**31) * _SECOND, 2**31 * _SECOND - 1
_TIME = Struct("<iI")
_DOUBLE_BYTES = 8
_COUNT_BYTES = 4
_COUNT = Struct("<I")
_READERS = {
    order: (Struct(f"{mark}I"), Struct(f"{mark}iI"))
    for order, mark in ((BIG_ENDIAN, ">"), (LITTLE_ENDIAN, "<"))
}


def to_time(stamp: int) -> tuple[int, int]:
    """``stamp`` [ns] as (sec, nanosec); nanosec counts forwards, before 1970 too.

    Raises InvalidInput outside the years 1901 to 2038, the range of ROS 2's seconds.
    """
    if not _EARLIEST <= stamp <= _LATEST:
        raise InvalidInput(
            f"ROS 2 cannot represent the stamp {stamp}: its seconds are an int32, which ends in 1901 and in "
            "2038; stamps are nanoseconds since 1970"
        )
    return divmod(stamp, _SECOND)


def from_time(sec: int, nanosec: int) -> int:
    """The stamp [ns] of a time. Raises MessageError if ``nanosec`` is a second or more."""
    if nanosec >= _SECOND:
        raise MessageError(
            f"a time of {sec} s and {nanosec} ns: the nanoseconds are below {_SECOND}", reason="malformed"
        )
    return sec * _SECOND + nanosec


def pack_stamp(stamp: int) -> bytes:
    """The 8 bytes of ``stamp`` in a little-endian message. Raises InvalidInput as ``to_time`` does."""
    return _TIME.pack(*to_time(stamp))


def unpack_stamps(times: bytes) -> tuple[int, ...]:
    """The stamps of consecutive little-endian times. Raises MessageError as ``from_time`` does."""
    return tuple(from_time(sec, nanosec) for sec, nanosec in _TIME.iter_unpack(times))


class CdrWriter:
    """Builds a little-endian payload, with zeros as padding."""

    def __init__(self) -> None:
        self._data = bytearray(LITTLE_ENDIAN + b"\x00\x00")

    def count(self, value: int) -> None:
        """The number of items that follow: a uint32."""
        self._align(_COUNT_BYTES)
        self._data += _COUNT.pack(value)

    def stamp(self, stamp: int) -> None:
        """A time. Raises InvalidInput if it is out of ROS 2's range."""
        self._align(_COUNT_BYTES)
        self._data += pack_stamp(stamp)

    def text(self, text: str) -> None:
        """A string. Raises InvalidInput for a NUL or a lone surrogate in it."""
        try:
            data = text.encode()
        except UnicodeEncodeError as error:
            raise InvalidInput(f"the string {text[:40]!r} is not Unicode text: {error.reason}") from None
        if b"\x00" in data:
            raise InvalidInput(f"the string {text[:40]!r} has a NUL in it, which ends a string for ROS 2")
        self.count(len(data) + 1)
        self._data += data + b"\x00"

    def numbers(self, block: bytes) -> None:
        """A block of float64 of a fixed count."""
        self._align(_DOUBLE_BYTES)
        self._data += block

    def sequence(self, block: bytes) -> None:
        """A block of float64 with its count; an empty one has no padding after the count."""
        self.count(len(block) // _DOUBLE_BYTES)
        if block:
            self.numbers(block)

    def payload(self) -> bytes:
        """The payload written so far."""
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(_padding(len(self._data), size))


class CdrReader:
    """Reads the values of ``payload`` one after the other, and records where numbers and padding are.

    ``kind`` is the message type, for errors: MessageError with the reason "truncated" or "malformed".
    ``stamps``, ``blocks`` and ``gaps`` (padding) are spans of the payload, ``position`` is the next byte.
    Memory is allocated only after the items of a count are known to be in the payload.
    """

    def __init__(self, payload: bytes, kind: str) -> None:
        self.payload = payload
        self.position = HEADER_BYTES
        self.stamps: list[Span] = []
        self.blocks: list[Span] = []
        self.gaps: list[Span] = []
        self._kind = kind
        if len(payload) < HEADER_BYTES:
            raise self._truncated()
        self.order = payload[:2]
        if self.order not in _READERS:
            raise self.malformed(f"its encapsulation is {payload[:2].hex(' ')}, not that of plain CDR, 00 0x")
        self._count, self._time = _READERS[self.order]

    def count(self) -> int:
        """The number of items that follow."""
        start, _ = self._next(_COUNT_BYTES, _COUNT_BYTES)
        return self._count.unpack_from(self.payload, start)[0]

    def stamp(self) -> int:
        """A time, as a stamp [ns]."""
        span = self._next(STAMP_BYTES, _COUNT_BYTES)
        self.stamps.append(span)
        return from_time(*self._time.unpack_from(self.payload, span[0]))

    def text(self) -> str:
        """A string."""
        start, end = self._next(self.count(), 1)
        data = self.payload[start:end]
        if data.find(b"\x00") != len(data) - 1 or not data:
            raise self.malformed(f"the string {data[:40]!r} does not end at its first NUL")
        try:
            return data[:-1].decode()
        except UnicodeDecodeError as error:
            raise self.malformed(f"a string that is not UTF-8 ({error.reason}): {data[:40]!r}") from None

    def numbers(self, count: int) -> bytes:
        """A block of ``count`` float64."""
        start, end = span = self._next(count * _DOUBLE_BYTES, _DOUBLE_BYTES)
        self.blocks.append(span)
        block = self.payload[start:end]
        return block if self.order == LITTLE_ENDIAN else np.frombuffer(block, "u8").byteswap().tobytes()

    def sequence(self) -> bytes:
        """A block of float64 after its count."""
        count = self.count()
        if count:
            return self.numbers(count)
        self.blocks.append((self.position, self.position))
        return b""

    def malformed(self, what: str) -> MessageError:
        """A MessageError with the reason "malformed"."""
        return MessageError(f"a malformed {self._kind}: {what}", reason="malformed")

    def _next(self, size: int, alignment: int) -> Span:
        start = self.position + _padding(self.position, alignment)
        if start + size > len(self.payload):
            raise self._truncated(f": {size} more are expected at byte {start}")
        if start > self.position:
            self.gaps.append((self.position, start))
        self.position = start + size
        return start, self.position

    def _truncated(self, what: str = "") -> MessageError:
        text = f"a {self._kind} cut off after {len(self.payload)} bytes{what}"
        return MessageError(text, reason="truncated")


def _padding(position: int, alignment: int) -> int:
    return (HEADER_BYTES - position) % alignment


def encode_string(text: str) -> bytes:
    """The payload of a String. Raises InvalidInput for a text with a NUL or a lone surrogate in it."""
    writer = CdrWriter()
    writer.text(text)
    return writer.payload()


def decode_string(payload: bytes) -> str:
    """The text of a String. Raises MessageError with the reason "truncated" or "malformed"."""
    return CdrReader(payload, STRING.name).text()


def encode_clock(stamp: int) -> bytes:
    """The payload of a Clock at ``stamp`` [ns]. Raises InvalidInput outside the years 1901 to 2038."""
    writer = CdrWriter()
    writer.stamp(stamp)
    return writer.payload()


def decode_clock(payload: bytes) -> int:
    """The stamp [ns] of a Clock. Raises MessageError with the reason "truncated" or "malformed"."""
    return CdrReader(payload, CLOCK.name).stamp()
