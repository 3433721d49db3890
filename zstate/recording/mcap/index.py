"""Index of an MCAP file: its channels and data ranges, read from the summary section if it has one."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

from zstate.recording.mcap.records import (
    HEAD,
    MAGIC,
    MESSAGE,
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
    first: int = 0
    last: int = 0
    channels: frozenset[int] | None = None
    compression: str = ""

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


class RecordContents:
    """What the records in ``data`` declare, and the counts and log times (0 if none) of their messages."""

    def __init__(self, data: bytes) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkIndex] = []
        self.statistics: Statistics | None = None
        self.counts: Counter[int] = Counter()
        times: list[int] = []
        for opcode, start, end in iter_records(data):
            if opcode == Opcode.MESSAGE:
                number, _, log_time, _ = MESSAGE.unpack_from(data, start)
                self.counts[number] += 1
                times.append(log_time)
            elif opcode == Opcode.SCHEMA:
                schema = parse_record(Schema, data[start:end])
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = parse_record(Channel, data[start:end])
                self.channels[channel.id] = channel
            elif opcode == Opcode.CHUNK_INDEX:
                self.chunks.append(parse_record(ChunkIndex, data[start:end]))
            elif opcode == Opcode.STATISTICS:
                self.statistics = parse_record(Statistics, data[start:end])
        self.first, self.last = min(times, default=0), max(times, default=0)


class Summary:
    """The summary section between the data and the footer. Raises CorruptData without a reliable one."""

    def __init__(self, file: BoundedFile) -> None:
        footer = read_footer(file)
        self.start = footer.summary_start
        self._header, self._data_start = read_header(file)
        if not self._data_start <= self.start <= file.size - len(MAGIC) - _FOOTER_SIZE:
            raise CorruptData("it has no summary")
        text = file.read(self.start, file.size - len(MAGIC) - _CRC_SIZE - self.start)
        if footer.summary_crc and zlib.crc32(text) != footer.summary_crc:
            raise CorruptData("the checksum of its summary is wrong")
        self.contents = RecordContents(text[: -(_FOOTER_SIZE - _CRC_SIZE)])

    def index(self) -> Index:
        """The index. Raises CorruptData if the summary leaves something out."""
        schemas, channels, chunks = self.contents.schemas, self.contents.channels, self.contents.chunks
        found = self.contents.statistics
        if found is None or len(chunks) != found.chunk_count:
            raise CorruptData("its summary leaves out chunks")
        counts, span = found.channel_message_counts, None
        if sum(counts.values()) != found.message_count:
            raise CorruptData("its summary counts its messages in two ways, which differ")
        if found.message_count:
            if not chunks:
                raise CorruptData("its messages stand outside of chunks")
            span = (found.message_start_time, found.message_end_time)
        if not set(counts) <= set(channels):
            raise CorruptData("its summary leaves out channels")
        if not {channel.schema_id for channel in channels.values()} <= {0, *schemas}:
            raise CorruptData("its summary leaves out schemas")
        ranges: list[DataRange] = []
        for chunk in chunks:
            start, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
            if start < self._data_start or end > self.start:
                raise CorruptData("its summary names a chunk where none can be")
            occurring = frozenset(chunk.message_index_offsets) or None
            times = chunk.message_start_time, chunk.message_end_time
            ranges.append(DataRange("chunk", start, end, *times, occurring, chunk.compression))
        return Index(self._header, schemas, channels, counts, span, tuple(ranges), complete=True)
