"""Reads the records of a recording in the order of their log times."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from pathlib import Path

from zstate._util.closeable import Closeable
from zstate.errors import RecordingError
from zstate.recording.bag_metadata import bag_files
from zstate.recording.file_signatures import explain_unreadable
from zstate.recording.mcap.file import McapFile, open_errors
from zstate.recording.mcap.records import MAGIC
from zstate.recording.mcap.split_files import split_files
from zstate.recording.sqlite_file import SqliteFile
from zstate.recording.storage import (
    CDR,
    Channel,
    ReadFilter,
    Record,
    Storage,
    merge_by_log_time,
    merge_channels,
)

_SQLITE_MAGIC = b"SQLite format 3\0"


class RecordingReader(Closeable):
    """A recording, opened read-only.

    ``path`` is an MCAP file, the first file of a split recording (the others are found in its folder), a
    .db3 file, or the folder of a bag, with or without metadata.yaml. The format is decided by the first
    bytes of a file, not its name. Raises RecordingError for other files and unreadable ones.

    A truncated or damaged file is read as far as possible: ``complete`` is then False, and ``losses``
    describes what is missing. Damage that is found only during a read raises RecordingError there.
    ``skipped`` are the channels whose encoding is not CDR; their records are left out.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        files, missing = (bag_files(self.path), []) if self.path.is_dir() else split_files(self.path)
        self.storages: list[Storage] = []
        self._is_open = True
        try:
            for file in files:
                self.storages.append(_open_storage(file))
        except RecordingError:
            self.close()
            raise
        channels = merge_channels(channel for storage in self.storages for channel in storage.channels)
        self._channels = tuple(channel for channel in channels if channel.encoding == CDR)
        self.skipped = tuple(channel for channel in channels if channel.encoding != CDR)
        self.losses = (
            *(f"{storage.path.name}: {loss}" for storage in self.storages for loss in storage.losses),
            *(f"{name} is missing" for name in missing),
        )
        self.complete = not self.losses and all(storage.complete for storage in self.storages)

    def channels(self) -> tuple[Channel, ...]:
        """The CDR channels of all files without duplicates, with their record counts."""
        return self._channels

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last log time [ns], both inclusive; None without messages."""
        spans = [storage.span for storage in self.storages if storage.span]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def records(
        self, topics: Collection[str] | None = None, begin: int | None = None, end: int | None = None
    ) -> Iterator[Record]:
        """The records of these topics (None: of all) with log times in [begin, end), by log time.

        Records of one instant are in the order of writing. Only chunks that may contain some are read, one
        after the other.
        """
        default = ReadFilter()
        read_filter = ReadFilter(
            None if topics is None else frozenset(topics),
            default.begin if begin is None else begin,
            default.end if end is None else end,
        )
        if not self._is_open:
            raise RecordingError(f"the recording {str(self.path)!r} is closed", path=str(self.path))
        return merge_by_log_time([part for storage in self.storages for part in storage.parts(read_filter)])

    def close(self) -> None:
        self._is_open = False
        for storage in self.storages:
            storage.close()


def _open_storage(path: Path) -> Storage:
    with open_errors(path) as file:
        beginning = file.read(0, min(file.size, 64))
    if beginning.startswith(MAGIC):
        return McapFile(path)
    if beginning.startswith(_SQLITE_MAGIC):
        return SqliteFile(path)
    raise RecordingError(explain_unreadable(path, beginning), path=str(path))
