"""Index of an MCAP file: its channels and data ranges, read from the summary section if it has one."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

from zstate.recording.mcap.records import (
    HEAD,
    MAGIC,
    BoundedFile,
    CorruptData,
    decompress,
    decompress_prefix,
    iter_records,
    parse_chunk,
    parse_record,
)

_FOOTER_SIZE = HEAD.size + 20
_CRC_SIZE = 4


class DataRange(NamedTuple):
    """A byte range with messages: a chunk, a chunk that is cut off, or records outside of chunks.

    ``first`` and ``last`` are log times, both inclusive. ``channels`` are the channel ids that occur, None
    if only reading shows them.
    """

    kind: Literal["chunk", "cut chunk", "bare"]
    offset: int
    end: int
    first: int
    last: int
    channels: frozenset[int] | None
    compression: str

    def content(self, file: BoundedFile) -> bytes:
        """Its records, decompressed. Raises CorruptData if they are not whole."""
        if self.kind == "bare":
            return file.read(self.offset, self.end - self.offset)
        body = file.body(self.offset, self.end)
        if self.kind == "cut chunk":
            return decompress_prefix(parse_chunk(body, whole=False))
        try:
            return decompress(parse_chunk(body))
        except CorruptData as damage:
            raise CorruptData(f"at byte {self.offset} there is {damage}") from damage


class DataLoss(NamedTuple):
    """Bytes of a file that cannot be read, and the reason."""

    offset: int
    length: int
    reason: str

    def __str__(self) -> str:
        return f"{self.length} bytes at {self.offset}: {self.reason}"


@dataclass(frozen=True)
class Index:
    """Contents of an MCAP file. ``schemas``, ``channels`` and ``counts`` are by the file's ids.

    ``span`` is the first and the last log time, None without messages. ``complete`` is True if the writer
    closed the file and nothing of it is lost.
    """

    header: Header
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    counts: Mapping[int, int]
    span: tuple[int, int] | None
    ranges: tuple[DataRange, ...]
    complete: bool
    losses: tuple[DataLoss, ...] = ()


def read_header(file: BoundedFile) -> tuple[Header, int]:
    """The header, and the offset at which it ends."""
    opcode, end = file.record_head(len(MAGIC))
    if opcode != Opcode.HEADER:
        raise CorruptData("it does not begin with a header")
    return parse_record(Header, file.body(len(MAGIC), end)), end


def read_footer(file: BoundedFile) -> Footer:
    """The footer that a writer leaves when it closes the file."""
    at = file.size - len(MAGIC) - _FOOTER_SIZE
    if at < 0 or file.read(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        raise CorruptData("it was not closed by its writer")
    opcode, end = file.record_head(at)
    if opcode != Opcode.FOOTER or end != at + _FOOTER_SIZE:
        raise CorruptData("it has no footer")
    return parse_record(Footer, file.body(at, end))


class Summary:
    """The summary section between the data and the footer. Raises CorruptData without a reliable one."""

    def __init__(self, file: BoundedFile) -> None:
        footer = read_footer(file)
        self.start = footer.summary_start
        self._data_start = read_header(file)[1]
        if not self._data_start <= self.start <= file.size - len(MAGIC) - _FOOTER_SIZE:
            raise CorruptData("it has no summary")
        text = file.read(self.start, file.size - len(MAGIC) - _CRC_SIZE - self.start)
        if footer.summary_crc and zlib.crc32(text) != footer.summary_crc:
            raise CorruptData("the checksum of its summary is wrong")
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkIndex] = []
        self.statistics: Statistics | None = None
        text = text[: -(_FOOTER_SIZE - _CRC_SIZE)]
        for opcode, start, end in iter_records(text):
            body = text[start:end]
            if opcode == Opcode.SCHEMA:
                schema = parse_record(Schema, body)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = parse_record(Channel, body)
                self.channels[channel.id] = channel
            elif opcode == Opcode.CHUNK_INDEX:
                self.chunks.append(parse_record(ChunkIndex, body))
            elif opcode == Opcode.STATISTICS:
                self.statistics = parse_record(Statistics, body)

    def index(self, header: Header) -> Index:
        """The index. Raises CorruptData if the summary leaves something out."""
        found = self.statistics
        if found is None or len(self.chunks) != found.chunk_count:
            raise CorruptData("its summary leaves out chunks")
        counts, span = found.channel_message_counts, None
        if sum(counts.values()) != found.message_count:
            raise CorruptData("its summary counts its messages in two ways, which differ")
        if found.message_count:
            if not self.chunks:
                raise CorruptData("its messages stand outside of chunks")
            span = (found.message_start_time, found.message_end_time)
        if not set(counts) <= set(self.channels):
            raise CorruptData("its summary leaves out channels")
        if not {c.schema_id for c in self.channels.values()} <= {0, *self.schemas}:
            raise CorruptData("its summary leaves out schemas")
        ranges = tuple(self._ranges())
        return Index(header, self.schemas, self.channels, counts, span, ranges, complete=True)

    def _ranges(self) -> Iterator[DataRange]:
        for chunk in self.chunks:
            end = chunk.chunk_start_offset + chunk.chunk_length
            if chunk.chunk_start_offset < self._data_start or end > self.start:
                raise CorruptData("its summary names a chunk where none can be")
            yield DataRange(
                "chunk",
                chunk.chunk_start_offset,
                end,
                chunk.message_start_time,
                chunk.message_end_time,
                frozenset(chunk.message_index_offsets) or None,
                chunk.compression,
            )
