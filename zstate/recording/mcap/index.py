"""Index of an MCAP file: its channels and data ranges, read from its summary or rebuilt by a scan.

A scan reads all of a file that has no summary, as a killed recorder leaves it, or that is damaged. It leaves
out unreadable bytes, reports them in ``losses``, and continues at the next whole chunk.
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from zstate.recording.mcap.records import (
    FIRST_PRIVATE_OPCODE,
    HEAD,
    MAGIC,
    MESSAGE,
    BoundedFile,
    CorruptData,
    check_message_index,
    decompress,
    decompress_prefix,
    iter_records,
    only_message,
    parse_chunk,
    parse_record,
)

_HEAD_BYTES = 1 << 17
"""One block of zstd, compressed or not."""
_FOOTER_SIZE = HEAD.size + 20
_CRC_SIZE = 4

_BARE = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_BARE_RANGE = 1 << 20  # bytes of messages outside of chunks that are read at once

# A chunk's compression as it stands in the file, behind the record's head and 28 bytes of numbers.
_SIGNATURE = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_BEFORE_SIGNATURE = HEAD.size + 28
_WINDOW = 1 << 22
_OVERLAP = 8


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

    def head(self, file: BoundedFile) -> tuple[int, int, bytes] | None:
        """The beginning of a chunk that has one message: see ``only_message``; None of others."""
        if self.kind != "chunk" or self.channels is None or len(self.channels) > 1:
            return None
        end = min(self.end, self.offset + _HEAD_BYTES)
        return only_message(parse_chunk(file.body(self.offset, end), whole=False), _HEAD_BYTES)

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
        self.metadata: list[MetadataIndex] = []
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
            elif opcode == Opcode.METADATA_INDEX:
                self.metadata.append(parse_record(MetadataIndex, data[start:end]))
            elif opcode == Opcode.STATISTICS:
                self.statistics = parse_record(Statistics, data[start:end])
        self.first, self.last = min(times, default=0), max(times, default=0)


class Summary:
    """The summary section between the data and the footer. Raises CorruptData without a reliable one."""

    def __init__(self, file: BoundedFile) -> None:
        footer = read_footer(file)
        self._file = file
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

    def metadata(self, name: str) -> list[Metadata]:
        """The metadata records of this name. Raises CorruptData if the summary leads elsewhere."""
        found: list[Metadata] = []
        for one in self.contents.metadata:
            if one.name == name:
                opcode, body = self._file.record(one.offset)
                if opcode != Opcode.METADATA:
                    raise CorruptData("its summary names a metadata record where none is")
                found.append(parse_record(Metadata, body))
        return found


class FileScan:
    """Contents of a file: its rebuilt ``index``, ``metadata`` and ``attachments``.

    Raises CorruptData if not even its header can be read.
    """

    def __init__(self, file: BoundedFile) -> None:
        self._file = file
        header, at = read_header(file)
        self._end = file.size
        self._summary: Summary | None = None
        with suppress(CorruptData):
            self._summary = Summary(file)
            self._end = self._summary.start
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._ranges: list[DataRange] = []
        self._losses: list[DataLoss] = []
        self._has_data_end = False
        self.metadata: list[Metadata] = []
        self.attachments: list[Attachment] = []
        self._bare_start: int | None = None
        while at < self._end and not self._has_data_end:
            at = self._step(at)
        self._add_bare_range(at)
        schemas, channels = self._schemas, self._channels
        if self._summary is not None:  # its copy describes the channels whose chunk is lost
            schemas = {**self._summary.contents.schemas, **schemas}
            channels = {**self._summary.contents.channels, **channels}
        for number, count in self._counts.items():
            if number not in channels:
                reason = f"{count} messages of channel {number}, whose description is lost"
                self._losses.append(DataLoss(self._ranges[0].offset, 0, reason))
        counts = {number: count for number, count in self._counts.items() if number in channels}
        ranges = tuple(one for one in self._ranges if one.channels)
        span = (min(one.first for one in ranges), max(one.last for one in ranges)) if ranges else None
        complete = False
        if self._has_data_end and not self._losses:
            with suppress(CorruptData):
                read_footer(file)
                complete = True
        losses = tuple(self._losses)
        self.index = Index(header, schemas, channels, counts, span, ranges, complete, losses)

    def _step(self, at: int) -> int:
        """Read the record at ``at``; the offset to continue at."""
        end: int | None = None
        opcode = 0
        try:
            opcode, stated = self._file.record_head(at)
            end = stated if stated <= self._end else None
            self._add_record(opcode, at, end)
        except CorruptData as damage:
            self._add_bare_range(at)
            return self._resume(at, opcode, end, str(damage))
        return stated

    def _add_record(self, opcode: int, at: int, end: int | None) -> None:
        if end is None:
            is_cut = self._summary is None
            raise CorruptData("the file is cut off there" if is_cut else "a record's length is wrong")
        if opcode == Opcode.DATA_END and self._summary is not None and end < self._end:
            raise CorruptData("a DataEnd record with more data behind it")
        if opcode in _BARE:
            self._bare_start = at if self._bare_start is None else self._bare_start
            if end - self._bare_start >= _BARE_RANGE:
                self._add_bare_range(end)
            return
        self._add_bare_range(at)
        body = self._file.body(at, end)
        if opcode == Opcode.DATA_END:
            parse_record(DataEnd, body)
            self._has_data_end = True
        elif opcode == Opcode.CHUNK:
            chunk = parse_chunk(body)
            self._add(DataRange("chunk", at, end, compression=chunk.compression), decompress(chunk))
        elif opcode == Opcode.METADATA:
            self.metadata.append(parse_record(Metadata, body))
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.append(parse_record(Attachment, body))
        elif opcode == Opcode.MESSAGE_INDEX:
            check_message_index(body)
        elif opcode < FIRST_PRIVATE_OPCODE:
            raise CorruptData(f"no record begins with the byte {opcode}")

    def _add_bare_range(self, end: int) -> None:
        """Add the records outside of chunks that end here as one range."""
        if self._bare_start is None:
            return
        start, self._bare_start = self._bare_start, None
        try:
            self._add(DataRange("bare", start, end), self._file.read(start, end - start))
        except CorruptData as damage:
            self._losses.append(DataLoss(start, end - start, str(damage)))

    def _add(self, data_range: DataRange, data: bytes) -> None:
        contents = RecordContents(data)
        for number, schema in contents.schemas.items():
            self._schemas.setdefault(number, schema)
        for number, channel in contents.channels.items():
            self._channels.setdefault(number, channel)
        self._counts += contents.counts
        times = {"first": contents.first, "last": contents.last}
        self._ranges.append(data_range._replace(**times, channels=frozenset(contents.counts)))

    def _resume(self, at: int, opcode: int, end: int | None, reason: str) -> int:
        """The offset to continue at after damage at ``at``, in a record that ends at ``end`` if known."""
        found = _next_chunk(self._file, at + 1, self._end if end is None else end) or end
        if found is None and opcode == Opcode.CHUNK:
            # The file ends within this chunk; its beginning may be readable.
            before = self._counts.total()
            cut = DataRange("cut chunk", at, self._end)
            with suppress(CorruptData):
                self._add(cut, cut.content(self._file))
            reason = f"{reason}, but for {self._counts.total() - before} messages"
        next_at = self._end if found is None else found
        self._losses.append(DataLoss(at, next_at - at, reason))
        return next_at


def _next_chunk(file: BoundedFile, start: int, stop: int) -> int | None:
    """Offset of the first whole compressed chunk that begins in [start, stop), found by its compression."""
    at = start
    while at < stop:
        window = file.read(at, min(_WINDOW, file.size - at))
        for match in _SIGNATURE.finditer(window):
            candidate = at + match.start() - _BEFORE_SIGNATURE
            if start <= candidate < stop:
                with suppress(CorruptData):
                    opcode, body = file.record(candidate)
                    if opcode == Opcode.CHUNK:
                        decompress(parse_chunk(body))
                        return candidate
        at += _WINDOW - _OVERLAP
    return None
