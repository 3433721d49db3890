"""CDR, the serialisation of ROS 2 messages, written and read value by value.

A payload is a 4-byte encapsulation header and the values one after the other, each aligned to a multiple of
its size, counted from the fifth byte. Padding, and bytes after the last value, are undefined: ROS 2 leaves
uninitialised memory there. Stamps are ``builtin_interfaces/Time``: seconds, and nanoseconds below a second.
``std_msgs/msg/String`` and ``rosgraph_msgs/msg/Clock``, messages of a single value, are encoded here.

There is a fast path for payloads that differ only in their numbers. From one sample to the next stamps and
numbers change; names, counts and lengths stay. After a payload was read value by value, the place of its
numbers is known, and the next one is rearranged in one step: the fixed bytes to the front, to be matched as a
whole, the numbers behind them.
"""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from zstate._util.format import SECOND_NS
from zstate.errors import InvalidInput, MessageError
from zstate.wire.ros2.types import CLOCK, STRING

STAMP_BYTES = 8
HEADER_BYTES = 4
BIG_ENDIAN, LITTLE_ENDIAN = b"\x00\x00", b"\x00\x01"

M = TypeVar("M")
Span = tuple[int, int]  # first byte, and the one after the last

_EARLIEST, _LATEST = -(2**31) * SECOND_NS, 2**31 * SECOND_NS - 1
_TIME = Struct("<iI")
_DOUBLE_BYTES = 8
_COUNT_BYTES = 4
_COUNT = Struct("<I")
_READERS = {
    order: (Struct(f"{mark}I"), Struct(f"{mark}iI"))
    for order, mark in ((BIG_ENDIAN, ">"), (LITTLE_ENDIAN, "<"))
}

_CACHE_BYTES = 2**20  # of payloads; in memory it takes about three times as much
_ENTRY_BYTES = 1024  # of an entry, without its payload's length; approximate
# With more templates of one length, trying them costs as much as reading value by value.
_MAX_TEMPLATES = 8

# Times, doubles and every value after a count start at a multiple of four bytes.
_UINT32 = np.dtype("<u4")


def to_time(stamp: int) -> tuple[int, int]:
    """``stamp`` [ns] as (sec, nanosec); nanosec counts forwards, before 1970 too.

    Raises InvalidInput outside the years 1901 to 2038, the range of ROS 2's seconds.
    """
    if not _EARLIEST <= stamp <= _LATEST:
        raise InvalidInput(
            f"ROS 2 cannot represent the stamp {stamp}: its seconds are an int32, which ends in 1901 and in "
            "2038; stamps are nanoseconds since 1970"
        )
    return divmod(stamp, SECOND_NS)


def from_time(sec: int, nanosec: int) -> int:
    """The stamp [ns] of a time. Raises MessageError if ``nanosec`` is a second or more."""
    if nanosec >= SECOND_NS:
        raise MessageError(
            f"a time of {sec} s and {nanosec} ns: the nanoseconds are below {SECOND_NS}", reason="malformed"
        )
    return sec * SECOND_NS + nanosec


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

    def numbers(self, block: bytes, size: int = _DOUBLE_BYTES) -> None:
        """A block of numbers of ``size`` bytes, by default float64, of a fixed count."""
        self._align(size)
        self._data += block

    def sequence(self, block: bytes, size: int = _DOUBLE_BYTES) -> None:
        """A block of such numbers with its count; an empty one has no padding after the count."""
        self.count(len(block) // size)
        if block:
            self.numbers(block, size)

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

    def numbers(self, count: int, size: int = _DOUBLE_BYTES) -> bytes:
        """A block of ``count`` numbers of ``size`` bytes, by default float64."""
        start, end = span = self._next(count * size, size)
        self.blocks.append(span)
        block = self.payload[start:end]
        return block if self.order == LITTLE_ENDIAN else np.frombuffer(block, f"u{size}").byteswap().tobytes()

    def sequence(self, size: int = _DOUBLE_BYTES) -> bytes:
        """A block of such numbers after its count."""
        count = self.count()
        if count:
            return self.numbers(count, size)
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


class CdrTemplate:
    """The place of the numbers in the payload that ``reader`` has read to the end."""

    def __init__(self, reader: CdrReader) -> None:
        self._count = reader.position // _UINT32.itemsize
        words = np.arange(self._count)
        spans = [*reader.stamps, *reader.blocks]
        numbers = [words[start // _UINT32.itemsize : end // _UINT32.itemsize] for start, end in spans]
        fixed = np.delete(words, np.concatenate([words[:0], *numbers]))
        self._fixed_bytes = fixed.size * _UINT32.itemsize
        self._order = np.concatenate([fixed, *numbers])
        self._places = np.argsort(self._order)
        mask = np.full(reader.position, 0xFF, np.uint8)
        for start, end in [(len(reader.order), HEADER_BYTES), *reader.gaps]:
            mask[start:end] = 0  # padding, and the two option bytes of the header
        self._mask = mask.view(_UINT32)[self._order]

    def split(self, payload: bytes) -> tuple[bytes, bytes]:
        """The fixed bytes of ``payload``, with zero padding, and its numbers: all stamps, then all blocks.

        ``payload`` is at least as long as the template's.
        """
        # Not ``buffer & mask`` first: rearranging makes the copy that is aligned.
        words = np.frombuffer(payload, _UINT32, self._count).take(self._order)
        data = (words & self._mask).tobytes()
        return data[: self._fixed_bytes], data[self._fixed_bytes :]

    def split_many(self, payloads: Sequence[bytes]) -> tuple[NDArray[np.uint32], NDArray[np.uint32]]:
        """``split`` of each of ``payloads``, of one length: a row of 32-bit words each, in both arrays."""
        rows = np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), -1)
        words = np.ascontiguousarray(rows[:, : self._count * _UINT32.itemsize]).view(_UINT32)
        words = words.take(self._order, axis=1)
        words &= self._mask
        fixed = self._fixed_bytes // _UINT32.itemsize
        return words[:, :fixed], words[:, fixed:]

    def join(self, fixed: bytes, numbers: bytes) -> bytes:
        """The payload that ``split`` takes apart into these."""
        return np.frombuffer(fixed + numbers, _UINT32).take(self._places).tobytes()

    def is_like(self, other: CdrTemplate) -> bool:
        """Whether both split every payload in the same way."""
        return np.array_equal(self._order, other._order) and np.array_equal(self._mask, other._mask)


class TemplateCache(Generic[M]):
    """Decoded values by the fixed bytes of payloads, for any number of writers.

    The size is limited: a full cache is cleared, and payloads that still arrive are added again.
    """

    def __init__(self) -> None:
        self._clear()

    def find(self, payload: bytes) -> tuple[M, bytes] | None:
        """The value of an added payload that differs from this one only in numbers, and the numbers."""
        for template, values in self._by_length.get(len(payload), ()):
            fixed, numbers = template.split(payload)
            value = values.get(fixed)
            if value is not None:
                return value, numbers
        return None

    def find_many(self, payloads: Sequence[bytes]) -> tuple[M, NDArray[np.uint32]] | None:
        """``find`` for payloads of one length: their common value, and a row of numbers for each.

        None if their values are not known, or differ. Numbers are in 32-bit words.
        """
        for template, values in self._by_length.get(len(payloads[0]), ()):
            fixed, _ = template.split(payloads[0])
            value = values.get(fixed)
            if value is not None:
                all_fixed, numbers = template.split_many(payloads)
                return (value, numbers) if (all_fixed == np.frombuffer(fixed, _UINT32)).all() else None
        return None

    def add(self, reader: CdrReader, value: M) -> None:
        """Keep the ``value`` of the payload that ``reader`` has read to the end."""
        length = len(reader.payload)
        if reader.order != LITTLE_ENDIAN or length + _ENTRY_BYTES > _CACHE_BYTES:
            return
        self._free_bytes -= length + _ENTRY_BYTES
        if self._free_bytes < 0:
            self._clear()
        new = CdrTemplate(reader)
        fixed, _ = new.split(reader.payload)
        templates = self._by_length.get(length, ())
        for template, values in templates:
            if template.is_like(new):
                values[fixed] = value
                return
        if len(templates) < _MAX_TEMPLATES:
            self._by_length[length] = (*templates, (new, {fixed: value}))

    def _clear(self) -> None:
        self._by_length: dict[int, tuple[tuple[CdrTemplate, dict[bytes, M]], ...]] = {}
        self._free_bytes = _CACHE_BYTES


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
