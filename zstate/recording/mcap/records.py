"""MCAP records parsed without trust in their lengths, and bounds-checked access to a file.

A record is an opcode, a length and a body (https://mcap.dev/spec). The body of a chunk is a compressed
sequence of records. mcap's own reader accepts a short read as a whole record and allocates whatever a
damaged length states; here both raise CorruptData.
"""

# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownArgumentType=false
# lz4 has no types

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import McapRecord

from zstate._util.closeable import Closeable

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")  # opcode, length of the body
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; the payload follows
_CHUNK = struct.Struct("<QQQII")  # first and last log time, size and CRC of the content, length of a word
_INDEX = struct.Struct("<HI")  # channel, size of what follows

MAX_CHUNK_BYTES = 1 << 28
"""Largest decompressed chunk that is read, 256 MiB; writers make chunks of about 1 MiB."""

FIRST_PRIVATE_OPCODE = 0x80
"""Opcodes from here on are for private use; lower ones that the specification does not define are damage."""

_UNREADABLE = (struct.error, ValueError, McapError, zstandard.ZstdError, RuntimeError, MemoryError)


R = TypeVar("R", bound=McapRecord)


class CorruptData(Exception):
    """Bytes that violate the format."""


class BoundedFile(Closeable):
    """Random access to a file, bounded by its size at opening. Raises CorruptData and OSError."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self.size = self._stream.seek(0, 2)

    def read(self, offset: int, length: int) -> bytes:
        """Exactly ``length`` bytes at ``offset``."""
        if offset + length > self.size:
            raise CorruptData("the file ends within a record")
        self._stream.seek(offset)
        data = self._stream.read(length)
        if len(data) < length:
            raise CorruptData("the file became shorter while it was read")
        return data

    def record_head(self, offset: int) -> tuple[int, int]:
        """Opcode and end offset of the record at ``offset``."""
        opcode, length = HEAD.unpack(self.read(offset, HEAD.size))
        return opcode, offset + HEAD.size + length

    def record(self, offset: int) -> tuple[int, bytes]:
        """Opcode and body of the record at ``offset``."""
        opcode, end = self.record_head(offset)
        return opcode, self.body(offset, end)

    def body(self, offset: int, end: int) -> bytes:
        """Body of the record between the two offsets."""
        return self.read(offset + HEAD.size, end - offset - HEAD.size)

    @property
    def has_mcap_magic(self) -> bool:
        return self.size >= len(MAGIC) and self.read(0, len(MAGIC)) == MAGIC

    def close(self) -> None:
        self._stream.close()


class Chunk(NamedTuple):
    """Chunk record, still compressed. ``data`` is short if the file is cut off within it."""

    first: int
    last: int
    size: int
    crc: int
    compression: str
    data: bytes


def iter_records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, body start and body end of each record in ``content``."""
    at, size = 0, len(content)
    while at < size:
        if size - at < HEAD.size:
            raise CorruptData("it ends within a record")
        opcode, length = HEAD.unpack_from(content, at)
        start, at = at + HEAD.size, at + HEAD.size + length
        if at > size:
            raise CorruptData("it ends within a record")
        if opcode == 0:
            raise CorruptData("no record begins with the byte 0")
        if opcode == Opcode.MESSAGE and length < MESSAGE.size:
            raise CorruptData(f"a message of {length} bytes, shorter than its {MESSAGE.size} byte header")
        yield opcode, start, at


def parse_record(kind: type[R], body: bytes) -> R:
    """The record of type ``kind`` with this body."""
    try:
        record = cast("R", cast("Any", kind).read(ReadDataStream(BytesIO(body))))
        again = RecordBuilder()
        record.write(again)
    except _UNREADABLE as error:
        raise CorruptData(f"not a {kind.__name__} record: {error}") from error
    # mcap does not notice missing bytes. Later versions of the format may append some.
    if not body.startswith(again.end()[HEAD.size :]):
        raise CorruptData(f"not a whole {kind.__name__} record")
    return record


def check_message_index(body: bytes) -> None:
    """Raise CorruptData unless a message index fills its record: a wrong length would skip data."""
    if len(body) < _INDEX.size or _INDEX.unpack_from(body)[1] != len(body) - _INDEX.size:
        raise CorruptData("not a message index")


def parse_chunk(body: bytes, *, whole: bool = True) -> Chunk:
    """The chunk with this body; with ``whole=False`` its data may be cut off."""
    try:
        first, last, size, crc, width = _CHUNK.unpack_from(body)
        at = _CHUNK.size + width
        compression = body[_CHUNK.size : at].decode()
        (length,) = struct.unpack_from("<Q", body, at)
    except _UNREADABLE as error:
        raise CorruptData(f"not a chunk: {error}") from error
    data = body[at + 8 : at + 8 + length]
    if whole and len(data) < length:
        raise CorruptData("a chunk that is longer than its record")
    return Chunk(first, last, size, crc, compression, data)


def decompress(chunk: Chunk) -> bytes:
    """The chunk's records, checked by size and CRC. A chunk above MAX_CHUNK_BYTES is not decompressed."""
    if chunk.size > MAX_CHUNK_BYTES:
        raise CorruptData(
            f"a chunk that states {chunk.size} bytes; at most {MAX_CHUNK_BYTES} are read at once"
        )
    try:
        data = _decompressed(chunk)
    except _UNREADABLE as error:
        raise CorruptData(f"a chunk that cannot be decompressed ({error})") from error
    if len(data) != chunk.size:
        raise CorruptData(f"a chunk of {len(data)} bytes that states {chunk.size} bytes")
    if chunk.crc and zlib.crc32(data) != chunk.crc:
        raise CorruptData("a chunk whose checksum is wrong")
    return data


def _decompressed(chunk: Chunk) -> bytes:
    if chunk.compression == "zstd":
        # Checked first: a damaged frame may request any amount of memory.
        if zstandard.frame_content_size(chunk.data) not in {-1, chunk.size}:
            raise CorruptData("a chunk and its zstd frame that disagree on their size")
        return zstandard.decompress(chunk.data, max_output_size=chunk.size)
    if chunk.compression == "lz4":
        # Limit of one byte more than stated, to detect a larger frame.
        frame = lz4.frame.LZ4FrameDecompressor()
        data = bytes(frame.decompress(chunk.data, max_length=chunk.size + 1))
        if not frame.eof:
            raise CorruptData(f"a chunk that states {chunk.size} bytes with a larger or truncated lz4 frame")
        return data
    if not chunk.compression:
        return chunk.data
    raise CorruptData(f"a chunk with the unknown compression {chunk.compression!r}")


def only_message(chunk: Chunk, size: int) -> tuple[int, int, bytes] | None:
    """The first ``size`` bytes of a chunk that has one message, and where the message begins and ends.

    ``chunk`` may be cut off. None if it has more messages, or the message begins later.
    """
    data, at = _prefix(chunk, size), 0
    while len(data) - at >= HEAD.size + MESSAGE.size:
        opcode, length = HEAD.unpack_from(data, at)
        start, at = at + HEAD.size, at + HEAD.size + length
        if opcode == Opcode.MESSAGE:
            return (start, at, data) if at == chunk.size and length >= MESSAGE.size else None
    return None


def decompress_prefix(chunk: Chunk) -> bytes:
    """The whole records at the beginning of a chunk that is cut off."""
    data, end = _prefix(chunk, MAX_CHUNK_BYTES), 0
    with suppress(CorruptData):
        for _, _, stop in iter_records(data):
            end = stop
    return data[:end]


def _prefix(chunk: Chunk, size: int) -> bytes:
    """At most ``size`` bytes of the content of a chunk; none of one that cannot be decompressed."""
    limit = min(chunk.size, size)
    try:
        if chunk.compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
                data = stream.read(limit)
        elif chunk.compression == "lz4":
            data = bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit))
        else:
            data = chunk.data[:limit]
    except _UNREADABLE:
        return b""
    return data
