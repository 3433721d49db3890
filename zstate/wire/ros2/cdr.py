"""CDR, the encoding of ROS 2 messages, written and read value by value.

A payload is 4 bytes that name the encapsulation, then the values one after the other, each at a
multiple of its size counted from the fifth byte. What stands in the gaps means nothing, and neither
does what comes after the last value: ROS 2 leaves there whatever its memory held.

Stamps as ROS 2 writes them: ``builtin_interfaces/Time``, whole seconds and the nanoseconds beyond.
"""

from __future__ import annotations

from struct import Struct

import numpy as np

from zstate.errors import InvalidInput, MessageError

STAMP_BYTES = 8

_SECOND = 1_000_000_000
_EARLIEST, _LATEST = -(2**31) * _SECOND, 2**31 * _SECOND - 1
_TIME = Struct("<iI")


def to_time(stamp: int) -> tuple[int, int]:
    """``stamp`` [ns] as (sec, nanosec); nanosec counts forwards, before 1970 too.

    Raises InvalidInput outside the years 1901 to 2038, which are all that ROS 2 has seconds for.
    """
    if not _EARLIEST <= stamp <= _LATEST:
        raise InvalidInput(
            f"ROS 2 cannot say the stamp {stamp}: its seconds are an int32, which ends in 1901 and in 2038; "
            "stamps are nanoseconds since 1970"
        )
    return divmod(stamp, _SECOND)


def from_time(sec: int, nanosec: int) -> int:
    """The stamp [ns] of a time. Raises MessageError when ``nanosec`` is a second or more."""
    if nanosec >= _SECOND:
        raise MessageError(
            f"a time of {sec} s and {nanosec} ns: the nanoseconds are below {_SECOND}", reason="malformed"
        )
    return sec * _SECOND + nanosec


def pack_stamp(stamp: int) -> bytes:
    """The 8 bytes of ``stamp`` in a little-endian message. Raises InvalidInput as ``to_time`` does."""
    return _TIME.pack(*to_time(stamp))


def unpack_stamps(times: bytes) -> tuple[int, ...]:
    """The stamps of little-endian times, one after the other. Raises MessageError as ``from_time`` does."""
    return tuple(from_time(sec, nanosec) for sec, nanosec in _TIME.iter_unpack(times))


HEADER_BYTES = 4
BIG_ENDIAN, LITTLE_ENDIAN = b"\x00\x00", b"\x00\x01"

Span = tuple[int, int]  # first byte, and the one after the last

_DOUBLE_BYTES = 8
_COUNT_BYTES = 4
_COUNT = Struct("<I")
_READERS = {
    order: (Struct(f"{mark}I"), Struct(f"{mark}iI"))
    for order, mark in ((BIG_ENDIAN, ">"), (LITTLE_ENDIAN, "<"))
}


class CdrWriter:
    """A payload in the making, little-endian, with zeros in the gaps."""

    def __init__(self) -> None:
        self._data = bytearray(LITTLE_ENDIAN + b"\x00\x00")

    def count(self, value: int) -> None:
        """How many items follow: a uint32."""
        self._align(_COUNT_BYTES)
        self._data += _COUNT.pack(value)

    def stamp(self, stamp: int) -> None:
        """A time. Raises InvalidInput when it is out of ROS 2's range."""
        self._align(_COUNT_BYTES)
        self._data += pack_stamp(stamp)

    def text(self, text: str) -> None:
        """A string. Raises InvalidInput for one that CDR cannot carry."""
        data = _utf8(text)
        self.count(len(data) + 1)
        self._data += data + b"\x00"

    def numbers(self, block: bytes) -> None:
        """A block of float64, whose count the reader knows."""
        self._align(_DOUBLE_BYTES)
        self._data += block

    def sequence(self, block: bytes) -> None:
        """A block of float64 with its count; an empty one leaves no gap behind the count."""
        self.count(len(block) // _DOUBLE_BYTES)
        if block:
            self.numbers(block)

    def payload(self) -> bytes:
        """What was written so far."""
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(_gap(len(self._data), size))


class CdrReader:
    """Takes the values of ``payload`` one after the other, and remembers where numbers and gaps are.

    ``kind`` is the message's type, for the errors: whatever cannot be read raises MessageError with
    the reason "truncated" or "malformed". ``stamps``, ``blocks`` and ``gaps`` are spans of the payload,
    ``position`` is where the next value is looked for. Nothing is set aside for a count before its
    items are seen to be there.
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
        """How many items follow."""
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
        """So many float64, as a block."""
        start, end = span = self._next(count * _DOUBLE_BYTES, _DOUBLE_BYTES)
        self.blocks.append(span)
        block = self.payload[start:end]
        return block if self.order == LITTLE_ENDIAN else np.frombuffer(block, "u8").byteswap().tobytes()

    def sequence(self) -> bytes:
        """A block of float64 that has its count before it."""
        count = self.count()
        if count:
            return self.numbers(count)
        self.blocks.append((self.position, self.position))
        return b""

    def malformed(self, what: str) -> MessageError:
        """The error that says what is wrong with the message."""
        return MessageError(f"a malformed {self._kind}: {what}", reason="malformed")

    def _next(self, size: int, alignment: int) -> Span:
        start = self.position + _gap(self.position, alignment)
        if start + size > len(self.payload):
            raise self._truncated(f": {size} more were to come at byte {start}")
        if start > self.position:
            self.gaps.append((self.position, start))
        self.position = start + size
        return start, self.position

    def _truncated(self, what: str = "") -> MessageError:
        text = f"a {self._kind} cut off after {len(self.payload)} bytes{what}"
        return MessageError(text, reason="truncated")


def _gap(position: int, alignment: int) -> int:
    return (HEADER_BYTES - position) % alignment


def _utf8(text: str) -> bytes:
    try:
        data = text.encode()
    except UnicodeEncodeError as error:
        raise InvalidInput(f"the string {text[:40]!r} is not Unicode text: {error.reason}") from None
    if b"\x00" in data:
        raise InvalidInput(f"the string {text[:40]!r} has a NUL in it, which ends a string for ROS 2")
    return data
