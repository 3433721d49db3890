"""One MCAP file, read by its index, or by a scan where it has none."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from mcap.opcode import Opcode

from zstate.errors import RecordingError
from zstate.record.blocks import MESSAGE, Damaged, entries
from zstate.record.byte_file import ByteFile
from zstate.record.channel import CDR, Channel, Record
from zstate.record.index import Index, Piece
from zstate.record.scan import Scan
from zstate.record.storage import Choice, Format
from zstate.record.summary import Summary, header_of
from zstate.record.time_order import Part


@contextmanager
def reading(path: Path) -> Generator[ByteFile, None, None]:
    """The file open, and what goes wrong with it said as a RecordingError."""
    try:
        with ByteFile(path) as file:
            yield file
    except OSError as error:
        raise RecordingError(f"{str(path)!r} cannot be read: {error.strerror}", path=str(path)) from error
    except Damaged as damage:
        text = f"{str(path)!r} is damaged: {damage}; `zstate recover` saves what can be read of it"
        raise RecordingError(text, path=str(path)) from damage


class McapFile:
    """The storage "mcap". The file is open only while it is read, as a recording may have thousands."""

    format: Format = "mcap"

    def __init__(self, path: Path) -> None:
        self.path = path
        with reading(path) as file:
            self.size = file.size
            self._index = _index(file)
        found = self._index
        self.profile, self.library = found.header.profile, found.header.library
        self._channels = {number: self._channel(number) for number in found.channels}
        self.channels = tuple(self._channels.values())
        self.span = found.span
        self.compressions = tuple(sorted({piece.compression for piece in found.pieces} - {""}))
        self.complete = found.complete
        self.losses = tuple(map(str, found.losses))

    def _channel(self, number: int) -> Channel:
        channel = self._index.channels[number]
        schema = self._index.schemas.get(channel.schema_id)
        type_name = "" if schema is None else schema.name
        count = self._index.counts.get(number, 0)
        return Channel(channel.topic, type_name, channel.message_encoding, channel.metadata, count)

    def parts(self, choice: Choice) -> list[Part]:
        wanted = {
            number: channel
            for number, channel in self._channels.items()
            if channel.encoding == CDR and (choice.topics is None or channel.topic in choice.topics)
        }
        return [
            Part(piece.first, partial(self._records, piece, wanted, choice))
            for piece in self._index.pieces
            if piece.first < choice.end
            and piece.last >= choice.begin
            and (piece.channels is None or not piece.channels.isdisjoint(wanted))
        ]

    def _records(self, piece: Piece, wanted: Mapping[int, Channel], choice: Choice) -> Iterator[Record]:
        with reading(self.path) as file:
            records = list(_messages(piece.content(file), wanted, choice))
            records.sort(key=lambda record: record.log_time)
            if records and not piece.first <= records[0].log_time <= records[-1].log_time <= piece.last:
                raise Damaged(f"the chunk at {piece.offset} holds other times than it says")
        yield from records

    def close(self) -> None:
        """It is not open."""


def _index(file: ByteFile) -> Index:
    header, _ = header_of(file)
    try:
        return Summary(file).index(header)
    except Damaged:
        return Scan(file).index()


def _messages(data: bytes, wanted: Mapping[int, Channel], choice: Choice) -> Iterator[Record]:
    _, begin, end = choice
    for opcode, start, stop in entries(data):
        if opcode != Opcode.MESSAGE:
            continue
        number, sequence, log_time, publish_time = MESSAGE.unpack_from(data, start)
        channel = wanted.get(number)
        if channel is not None and begin <= log_time < end:
            yield Record(channel, data[start + MESSAGE.size : stop], log_time, publish_time, sequence)
