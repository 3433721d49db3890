"""RecordReader: the records of a recording in the order of their log times."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path

from zstate.closing import Closing
from zstate.errors import RecordingError
from zstate.record.bag import bag_files
from zstate.record.blocks import MAGIC
from zstate.record.channel import CDR, Channel, Record, joined
from zstate.record.mcap_file import McapFile, reading
from zstate.record.splits import split_files
from zstate.record.sqlite_file import SqliteFile
from zstate.record.storage import Choice, Storage
from zstate.record.strangers import refusal
from zstate.record.time_order import in_time_order

_SQLITE_MAGIC = b"SQLite format 3\0"


class RecordReader(Closing):
    """A recording, opened for reading; nothing of it is changed.

    ``path`` is an MCAP file, the first of several that a RecordWriter split (the others are found
    beside it), a .db3 file, or the folder of a bag, with its metadata.yaml or without. What a file is
    its first bytes say, not its name. RecordingError when it is none of these or cannot be read.

    A file that was cut off or is damaged is read as far as it goes: ``complete`` is then False, and
    ``losses`` says what is missing. Damage that is met only while reading raises RecordingError there.
    ``skipped`` are the channels whose encoding is not CDR; their records are left out.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        files, missing = _files(self.path)
        self.storages: list[Storage] = []
        self._is_open = True
        try:
            for file in files:
                self.storages.append(_storage(file))
        except RecordingError:
            self.close()
            raise
        channels = joined(channel for storage in self.storages for channel in storage.channels)
        self._channels = tuple(channel for channel in channels if channel.encoding == CDR)
        self.skipped = tuple(channel for channel in channels if channel.encoding != CDR)
        self.losses = (
            *(f"{storage.path.name}: {loss}" for storage in self.storages for loss in storage.losses),
            *(f"{name} is missing" for name in missing),
        )
        self.complete = not self.losses and all(storage.complete for storage in self.storages)

    def channels(self) -> tuple[Channel, ...]:
        """The CDR channels of all files, each once, with the counts of its records."""
        return self._channels

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last log time [ns], both inclusive; None when there is no message."""
        spans = [storage.span for storage in self.storages if storage.span]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def records(
        self, topics: Collection[str] | None = None, begin: int | None = None, end: int | None = None
    ) -> Iterator[Record]:
        """The records of these topics (None: of all) with log times in [begin, end), by log time.

        Records of one instant stand as they were written. Only the chunks that may hold some are read,
        one after the other.
        """
        default = Choice()
        choice = Choice(
            None if topics is None else frozenset(topics),
            default.begin if begin is None else begin,
            default.end if end is None else end,
        )
        if not self._is_open:
            raise RecordingError(f"the recording {str(self.path)!r} is closed", path=str(self.path))
        return in_time_order([part for storage in self.storages for part in storage.parts(choice)])

    def close(self) -> None:
        self._is_open = False
        for storage in self.storages:
            storage.close()


def _files(path: Path) -> tuple[list[Path], list[str]]:
    """The files of a recording, and the names of those that are missing."""
    if path.is_dir():
        return bag_files(path), []
    return split_files(path)


def _storage(path: Path) -> Storage:
    with reading(path) as file:
        beginning = file.at(0, min(file.size, 64))
    if beginning.startswith(MAGIC):
        return McapFile(path)
    if beginning.startswith(_SQLITE_MAGIC):
        return SqliteFile(path)
    raise RecordingError(refusal(path, beginning), path=str(path))
