"""One MCAP file, read by its index, or by a scan if it has none."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from mcap.opcode import Opcode

from zstate.errors import RecordingError
from zstate.recording.mcap.index import DataRange, Index, Summary, read_header
from zstate.recording.mcap.records import MESSAGE, BoundedFile, CorruptData, iter_records
from zstate.recording.mcap.scan import Scan
from zstate.recording.storage import Channel, Format, ReadFilter, Record, SortedPart


@contextmanager
def open_errors(path: Path) -> Generator[BoundedFile, None, None]:
    """Open the file, and raise its I/O errors and damage as RecordingError."""
    try:
        with BoundedFile(path) as file:
            yield file
    except OSError as error:
        raise RecordingError(f"{str(path)!r} cannot be read: {error.strerror}", path=str(path)) from error
    except CorruptData as damage:
        text = f"{str(path)!r} is damaged: {damage}; `zstate recover` saves what can be read of it"
        raise RecordingError(text, path=str(path)) from damage


class McapFile:
    """The storage "mcap". The file is open only during reads, since a recording may have thousands."""

    format: Format = "mcap"

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_errors(path) as file:
            self.size = file.size
            self._index = index = _read_index(file)
        self.profile, self.library = index.header.profile, index.header.library
        self._channels = {number: self._channel(number) for number in index.channels}
        self.channels = tuple(self._channels.values())
        self.span = index.span
        self.compressions = tuple(sorted({one.compression for one in index.ranges} - {""}))
        self.complete = index.complete
        self.losses = tuple(map(str, index.losses))

    def _channel(self, number: int) -> Channel:
        channel = self._index.channels[number]
        schema = self._index.schemas.get(channel.schema_id)
        type_name = "" if schema is None else schema.name
        count = self._index.counts.get(number, 0)
        return Channel(channel.topic, type_name, channel.message_encoding, channel.metadata, count)

    def parts(self, read_filter: ReadFilter) -> list[SortedPart]:
        selected = {
            number: channel for number, channel in self._channels.items() if read_filter.accepts(channel)
        }
        return [
            SortedPart(one.first, partial(self._records, one, selected, read_filter))
            for one in self._index.ranges
            if one.first < read_filter.end
            and one.last >= read_filter.begin
            and (one.channels is None or not one.channels.isdisjoint(selected))
        ]

    def _records(
        self, data_range: DataRange, selected: Mapping[int, Channel], read_filter: ReadFilter
    ) -> Iterator[Record]:
        _, begin, end = read_filter
        records: list[Record] = []
        with open_errors(self.path) as file:
            data = data_range.content(file)
            for opcode, start, stop in iter_records(data):
                if opcode != Opcode.MESSAGE:
                    continue
                number, sequence, log_time, publish_time = MESSAGE.unpack_from(data, start)
                channel = selected.get(number)
                if channel is not None and begin <= log_time < end:
                    payload = data[start + MESSAGE.size : stop]
                    records.append(Record(channel, payload, log_time, publish_time, sequence))
            records.sort(key=lambda record: record.log_time)
            if records and not (
                data_range.first <= records[0].log_time and records[-1].log_time <= data_range.last
            ):
                raise CorruptData(f"the chunk at {data_range.offset} has log times outside its index entry")
        yield from records

    def close(self) -> None:
        """Do nothing: the file is open only during reads."""


def _read_index(file: BoundedFile) -> Index:
    header, _ = read_header(file)
    try:
        return Summary(file).index(header)
    except CorruptData:
        return Scan(file).index()
