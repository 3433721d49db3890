"""The summary: an MCAP file's index as its writer left it at the end."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Header, Schema, Statistics

from zstate.record.blocks import HEAD, MAGIC, Damaged, entries, parsed
from zstate.record.byte_file import ByteFile
from zstate.record.index import Index, Piece

_FOOTER_SIZE = HEAD.size + 20
_CRC_SIZE = 4


def header_of(file: ByteFile) -> tuple[Header, int]:
    """The header, and the offset at which it ends."""
    opcode, end = file.head(len(MAGIC))
    if opcode != Opcode.HEADER:
        raise Damaged("it does not begin with a header")
    return parsed(Header, file.body(len(MAGIC), end)), end


def footer_of(file: ByteFile) -> Footer:
    """The footer that a writer leaves when it closes the file."""
    at = file.size - len(MAGIC) - _FOOTER_SIZE
    if at < 0 or file.at(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        raise Damaged("it was not closed by its writer")
    opcode, end = file.head(at)
    if opcode != Opcode.FOOTER or end != at + _FOOTER_SIZE:
        raise Damaged("it has no footer")
    return parsed(Footer, file.body(at, end))


class Summary:
    """The records between the data and the footer. Damaged where there are none to rely on."""

    def __init__(self, file: ByteFile) -> None:
        footer = footer_of(file)
        self.start = footer.summary_start
        self._data_start = header_of(file)[1]
        if not self._data_start <= self.start <= file.size - len(MAGIC) - _FOOTER_SIZE:
            raise Damaged("it has no summary")
        text = file.at(self.start, file.size - len(MAGIC) - _CRC_SIZE - self.start)
        if footer.summary_crc and zlib.crc32(text) != footer.summary_crc:
            raise Damaged("the checksum of its summary is wrong")
        self._take(text[: -(_FOOTER_SIZE - _CRC_SIZE)])

    def _take(self, text: bytes) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkIndex] = []
        self.statistics: Statistics | None = None
        for opcode, start, end in entries(text):
            body = text[start:end]
            if opcode == Opcode.SCHEMA:
                schema = parsed(Schema, body)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = parsed(Channel, body)
                self.channels[channel.id] = channel
            elif opcode == Opcode.CHUNK_INDEX:
                self.chunks.append(parsed(ChunkIndex, body))
            elif opcode == Opcode.STATISTICS:
                self.statistics = parsed(Statistics, body)

    def index(self, header: Header) -> Index:
        """The index, if the summary says all of it; else Damaged."""
        counts, span = self._statistics()
        if not set(counts) <= set(self.channels):
            raise Damaged("its summary leaves out channels")
        if not {c.schema_id for c in self.channels.values()} <= {0, *self.schemas}:
            raise Damaged("its summary leaves out schemas")
        pieces = tuple(self._pieces())
        return Index(header, self.schemas, self.channels, counts, span, pieces, complete=True)

    def _statistics(self) -> tuple[dict[int, int], tuple[int, int] | None]:
        found = self.statistics
        if found is None or len(self.chunks) != found.chunk_count:
            raise Damaged("its summary leaves out chunks")
        counts = found.channel_message_counts
        if sum(counts.values()) != found.message_count:
            raise Damaged("its summary counts its messages in two ways, which differ")
        if found.message_count == 0:
            return counts, None
        if not self.chunks:
            raise Damaged("its messages stand outside of chunks")
        return counts, (found.message_start_time, found.message_end_time)

    def _pieces(self) -> Iterator[Piece]:
        for chunk in self.chunks:
            end = chunk.chunk_start_offset + chunk.chunk_length
            if chunk.chunk_start_offset < self._data_start or end > self.start:
                raise Damaged("its summary names a chunk where none can be")
            yield Piece(
                "chunk",
                chunk.chunk_start_offset,
                end,
                chunk.message_start_time,
                chunk.message_end_time,
                frozenset(chunk.message_index_offsets) or None,
                chunk.compression,
            )
