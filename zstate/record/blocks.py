"""Blocks: the bytes of an MCAP file taken apart, without trust in what they say.

A record is an opcode, a length and a body (https://mcap.dev/spec). A chunk's body holds records once
more, compressed. mcap's own reader takes a shortened read for a whole one and a damaged length for an
amount of memory to ask for; here each is ``Damaged``.
"""

# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownArgumentType=false
# lz4 has no types

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from typing import Any, NamedTuple, TypeVar, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode, length of the body
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; the payload follows
_CHUNK = struct.Struct("<QQQII")  # first and last log time, size and CRC of the content, length of a word
_INDEX = struct.Struct("<HI")  # channel, size of what follows

MOST_CONTENT = 1 << 28
"""A chunk holds this many bytes at most without compression, 256 MiB; writers make chunks of about 1 MiB."""

FIRST_PRIVATE_OPCODE = 0x80
"""Opcodes from here on are anybody's own; those below that the specification does not name are damage."""

_UNREADABLE = (struct.error, ValueError, McapError, zstandard.ZstdError, RuntimeError, MemoryError)


R = TypeVar("R", bound=McapRecord)


class Damaged(Exception):
    """Bytes that are not what should stand there."""


class Chunk(NamedTuple):
    """A chunk as it stands in the file. ``data`` may end early when the file does."""

    first: int
    last: int
    size: int
    crc: int
    compression: str
    data: bytes


def entries(content: bytes) -> Iterator[tuple[int, int, int]]:
    """The records in ``content``: opcode, and where the body begins and ends."""
    at, size = 0, len(content)
    while at < size:
        if size - at < HEAD.size:
            raise Damaged("it ends within a record")
        opcode, length = HEAD.unpack_from(content, at)
        start, at = at + HEAD.size, at + HEAD.size + length
        if at > size:
            raise Damaged("it ends within a record")
        if opcode == 0:
            raise Damaged("no record begins with the byte 0")
        if opcode == Opcode.MESSAGE and length < MESSAGE.size:
            raise Damaged(f"a message of {length} bytes, where {MESSAGE.size} say which it is")
        yield opcode, start, at


def whole_entries(content: bytes) -> bytes:
    """``content`` up to the end of its last whole record."""
    end = 0
    with suppress(Damaged):
        for _, _, stop in entries(content):
            end = stop
    return content[:end]


def parsed(kind: type[R], body: bytes) -> R:
    """The record of that kind whose body this is."""
    try:
        record = cast("R", cast("Any", kind).read(ReadDataStream(BytesIO(body))))
        again = RecordBuilder()
        record.write(again)
    except _UNREADABLE as error:
        raise Damaged(f"not a {kind.__name__} record: {error}") from error
    # mcap does not see that bytes are missing. Later versions of the format may add some at the end.
    if not body.startswith(again.end()[HEAD.size :]):
        raise Damaged(f"not a whole {kind.__name__} record")
    return record


def check_message_index(body: bytes) -> None:
    """Refuse a message index that does not fill its record: a wrong length would skip what follows."""
    if len(body) < _INDEX.size or _INDEX.unpack_from(body)[1] != len(body) - _INDEX.size:
        raise Damaged("not a message index")


def chunk(body: bytes, *, whole: bool = True) -> Chunk:
    """The chunk whose body this is; with ``whole=False`` its data may be cut off."""
    try:
        first, last, size, crc, width = _CHUNK.unpack_from(body)
        at = _CHUNK.size + width
        compression = body[_CHUNK.size : at].decode()
        (length,) = struct.unpack_from("<Q", body, at)
    except _UNREADABLE as error:
        raise Damaged(f"not a chunk: {error}") from error
    data = body[at + 8 : at + 8 + length]
    if whole and len(data) < length:
        raise Damaged("a chunk that is longer than its record")
    return Chunk(first, last, size, crc, compression, data)


def content(chunk: Chunk) -> bytes:
    """What a chunk holds, checked against its size and checksum. Of a large one nothing is decompressed."""
    if chunk.size > MOST_CONTENT:
        raise Damaged(
            f"a chunk that says it holds {chunk.size} bytes; at most {MOST_CONTENT} are read at once"
        )
    try:
        data = _decompressed(chunk)
    except _UNREADABLE as error:
        raise Damaged(f"a chunk that cannot be decompressed ({error})") from error
    if len(data) != chunk.size:
        raise Damaged(f"a chunk of {len(data)} bytes that says {chunk.size}")
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise Damaged("a chunk whose checksum is wrong")
    return data


def _decompressed(chunk: Chunk) -> bytes:
    if chunk.compression == "zstd":
        # Asked first: a damaged frame may name any amount of memory.
        if zstandard.frame_content_size(chunk.data) not in {-1, chunk.size}:
            raise Damaged("a chunk and its zstd frame that disagree on their size")
        return zstandard.decompress(chunk.data, max_output_size=chunk.size)
    if chunk.compression == "lz4":
        # One byte more than there should be shows that there is more.
        frame = lz4.frame.LZ4FrameDecompressor()
        data = bytes(frame.decompress(chunk.data, max_length=chunk.size + 1))
        if not frame.eof:
            raise Damaged(f"a chunk that says {chunk.size} bytes and has another lz4 frame, or one cut off")
        return data
    if not chunk.compression:
        return chunk.data
    raise Damaged(f"a chunk with the unknown compression {chunk.compression!r}")


def content_so_far(chunk: Chunk) -> bytes:
    """The whole records at the beginning of a chunk that is cut off."""
    most = min(chunk.size, MOST_CONTENT)
    try:
        if chunk.compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
                data = stream.read(most)
        elif chunk.compression == "lz4":
            data = bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most))
        else:
            data = chunk.data
    except _UNREADABLE:
        return b""
    return whole_entries(data)
