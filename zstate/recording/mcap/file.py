"""One MCAP file, read by its index or a scan, and the files of a split recording.

A split recording is run.mcap, run_1.mcap, run_2.mcap ... Each file carries the recording's identity in a
metadata record behind its header. Names alone do not suffice: an older recording of the same name may have
left files behind.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from zstate.recording.errors import RecordingError
from zstate.recording.mcap.index import DataRange, FileScan, Summary, read_header
from zstate.recording.mcap.records import MAGIC, MESSAGE, BoundedFile, CorruptData, iter_records, parse_record
from zstate.recording.storage import Channel, Format, ReadFilter, Record, SortedPart

IDENTITY = "zstate.recording"
"""Name of the metadata record; its keys are "id", and "part" (0, 1, ...)."""

MISSING = "zstate.missing"
"""Name of the metadata record with how many messages the recorder did not get, by "robot/stream"."""

_COUNT = re.compile("[0-9]{1,18}")
_SIGNATURES = {
    b"#ROSBAG V": "a bag of ROS 1: `rosbags-convert` makes a ROS 2 one of it",
    b"\x28\xb5\x2f\xfd": "compressed: `zstd -d` unpacks it",
    b"\x1f\x8b": "compressed: `gunzip` unpacks it",
    b"\x04\x22\x4d\x18": "compressed: `lz4 -d` unpacks it",
    b"PK\x03\x04": "a ZIP archive: unpack it",
    b"rosbag2_bagfile_information": "a bag's metadata.yaml: name its folder",
}


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
            try:
                summary = Summary(file)
                self._index = index = summary.index()
                metadata = summary.metadata(MISSING)
            except CorruptData:
                scan = FileScan(file)
                self._index = index = scan.index
                metadata = [one for one in scan.metadata if one.name == MISSING]
        self.profile, self.library = index.header.profile, index.header.library
        self._channels: dict[int, Channel] = {}
        for number, channel in index.channels.items():
            schema = index.schemas.get(channel.schema_id)
            facts = ("" if schema is None else schema.name, channel.message_encoding, channel.metadata)
            self._channels[number] = Channel(channel.topic, *facts, index.counts.get(number, 0))
        self.channels = tuple(self._channels.values())
        self.span = index.span
        self.compressions = tuple(sorted({one.compression for one in index.ranges} - {""}))
        self.complete = index.complete
        self.losses = tuple(map(str, index.losses))
        stated = chain.from_iterable(one.metadata.items() for one in metadata)
        self.missing: Mapping[str, int] = {
            name: int(count) for name, count in stated if _COUNT.fullmatch(count)
        }

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


def explain_unreadable(path: Path, beginning: bytes) -> str:
    """Why the file at ``path`` with these first bytes cannot be read, and what to do."""
    if not beginning:
        return f"{str(path)!r} is empty: its recorder ended before it wrote anything"
    if MAGIC.startswith(beginning):
        return f"{str(path)!r} is cut off within its first {len(MAGIC)} bytes; nothing of it can be saved"
    for magic, what in _SIGNATURES.items():
        if beginning.startswith(magic):
            return f"{str(path)!r} is {what}"
    return (
        f"{str(path)!r} is not a recording: it begins with {beginning[:12]!r}, and neither as an MCAP file "
        "nor as the SQLite file of a bag"
    )


def split_path(first: Path, part: int) -> Path:
    """The file of a recording's part, numbered as by rosbag2."""
    return first if part == 0 else first.with_name(f"{first.stem}_{part}{first.suffix}")


def later_splits(first: Path) -> list[tuple[int, Path]]:
    """The files in the folder of ``first`` that are named as its later parts, by number."""
    pattern = re.compile(rf"{re.escape(first.stem)}_([1-9]\d*){re.escape(first.suffix)}")
    found = ((pattern.fullmatch(path.name), path) for path in first.parent.iterdir())
    return sorted((int(match[1]), path) for match, path in found if match)


def split_files(first: Path) -> tuple[list[Path], list[str]]:
    """The files of the recording that begins with ``first``, and the names of missing ones.

    ``first`` alone if it is not the first part of a recording by zstate.
    """
    identity = read_identity(first)
    if identity is None or identity[1] != "0":
        return [first], []
    later = [
        (part, path) for part, path in later_splits(first) if read_identity(path) == (identity[0], str(part))
    ]
    present = {part for part, _ in later}
    missing = [
        split_path(first, part).name for part in range(1, max(present, default=0)) if part not in present
    ]
    return [first, *(path for _, path in later)], missing


def read_identity(path: Path) -> tuple[str, str] | None:
    """The id of the recording and the number of the part; None if zstate did not record the file."""
    try:
        with BoundedFile(path) as file:
            if not file.has_mcap_magic:
                return None
            opcode, body = file.record(read_header(file)[1])
            if opcode != Opcode.METADATA:
                return None
            found = parse_record(Metadata, body)
    except (CorruptData, OSError):
        return None
    return (found.metadata.get("id", ""), found.metadata.get("part", "")) if found.name == IDENTITY else None
