"""The files of an archive that reads need: listed by import, chosen by time, read by row group."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from zstate.archive.layout import (
    IMPORTS,
    SUFFIX,
    check_version,
    cuts_by_date,
    folder_of,
    value_of,
)
from zstate.archive.storage import Store, arrow

Stamps = NDArray[np.int64]
T = TypeVar("T")
R = TypeVar("R")

_REQUESTS = 16
"""To an object store at once."""

_ROWS_FOR_THREADS = 100_000
"""Rows of one file of which several columns are decoded at once."""


class Entry(NamedTuple):
    """A file of samples, as the import ``name`` of a recording lists it.

    ``frames`` is the digest of the static edges and the model that were in effect, ``recorded`` the first log
    time [ns] of the recording.
    """

    name: str
    path: str
    stream: str
    robot: str
    date: str
    key: str
    rows: int
    first: int
    last: int
    frames: str
    recorded: int
    recording: str


class Groups(NamedTuple):
    """Row groups of one file to read."""

    entry: Entry
    numbers: list[int]
    rows: int


class Files:
    """The files of the archive in ``store``. What was read of one is kept: files do not change."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self._records: dict[str, tuple[Entry, ...]] = {}
        self._footers: dict[str, Any] = {}

    def imports(self) -> list[str]:
        """The names of all complete imports."""
        return [name.removesuffix(SUFFIX) for name in self.store.names(folder_of(IMPORTS))]

    def is_complete(self, name: str) -> bool:
        """Whether the import ``name`` is complete."""
        return self.store.has(f"{folder_of(IMPORTS)}/{name}{SUFFIX}")

    def record(self, name: str) -> tuple[Entry, ...]:
        """The files of the import ``name``; none if it is not complete."""
        if name not in self._records:
            if not self.is_complete(name):
                return ()
            rows = self.table(f"{folder_of(IMPORTS)}/{name}{SUFFIX}").to_pylist()
            known = Entry._fields[1:]
            self._records[name] = tuple(Entry(name, *(row[field] for field in known)) for row in rows)
        return self._records[name]

    def records(self, names: Sequence[str]) -> list[Entry]:
        """The files of all these imports."""
        self._in_threads(self.record, [name for name in names if name not in self._records])
        return [one for name in names for one in self.record(name)]

    def table(self, path: str) -> Any:
        """A table that fits into memory, a pyarrow.Table."""
        with self.store.opened(path) as file:
            opened = arrow().parquet.ParquetFile(file, page_checksum_verification=True)
            check_version(opened.metadata.metadata, self.store.where(path))
            return opened.read(use_threads=False)

    def dates(self, stream: str, robot: str) -> list[str]:
        """The dates with samples of a robot."""
        return [value_of(name) for name in self.store.folders(folder_of(stream, robot))]

    def around(self, robot: str, streams: Iterable[str], stamps: Stamps) -> list[Entry]:
        """All files of the imports with files on the dates of ascending ``stamps``, or next to these."""
        wanted = np.array([day for day, _ in cuts_by_date(stamps)])
        names: set[str] = set()
        for stream in streams:
            dates = np.array(self.dates(stream, robot), str)
            at, after = dates.searchsorted(wanted), dates.searchsorted(wanted, "right")
            chosen = {*at.tolist(), *(at - 1).tolist(), *after.tolist()}
            for number in sorted(one for one in chosen if 0 <= one < len(dates)):
                files = self.store.names(folder_of(stream, robot, str(dates[number])))
                names |= {file.partition(".")[0] for file in files if file.endswith(SUFFIX)}
        return [one for one in self.records(sorted(names)) if one.robot == robot]

    def groups(self, entries: Sequence[Entry], stamps: Stamps, *, between: bool) -> list[Groups]:
        """The row groups of files of one key with the samples around each of ascending ``stamps``.

        With ``between`` also all samples from the first to the last of the stamps.
        """
        chosen = _needed([(one.first, one.last) for one in entries], stamps, between=between)
        entries = [entries[number] for number in chosen]
        spans: list[tuple[int, int]] = []
        places: list[tuple[int, int]] = []
        self._in_threads(self.footer, [one for one in entries if one.path not in self._footers])
        for number, entry in enumerate(entries):
            footer = self.footer(entry)
            column = footer.schema.names.index("stamp")
            for group in range(footer.num_row_groups):
                statistics = footer.row_group(group).column(column).statistics
                spans.append((statistics.min, statistics.max))
                places.append((number, group))
        by_file: dict[int, list[int]] = {}
        for one in _needed(spans, stamps, between=between):
            number, group = places[one]
            by_file.setdefault(number, []).append(group)
        found: list[Groups] = []
        for number, numbers in by_file.items():
            footer = self.footer(entries[number])
            rows = sum(footer.row_group(group).num_rows for group in numbers)
            found.append(Groups(entries[number], numbers, rows))
        return found

    def footer(self, entry: Entry) -> Any:
        """The metadata of a file. Raises RecordingError for one that cannot be read."""
        if entry.path not in self._footers:
            with self.store.opened(entry.path) as file:
                footer = arrow().parquet.read_metadata(file)
            check_version(footer.metadata, self.store.where(entry.path))
            self._footers[entry.path] = footer
        return self._footers[entry.path]

    def read_all(self, groups: Sequence[Groups], columns: Sequence[str] | None = None) -> list[Any]:
        """The rows of each of ``groups``."""
        return self._in_threads(lambda one: self.read(one, columns), groups)

    def _in_threads(self, call: Callable[[T], R], arguments: Sequence[T]) -> list[R]:
        """``in_threads``, with more of them for an object store, which takes a while for each file."""
        return in_threads(call, arguments, None if self.store.is_local else _REQUESTS)

    def read(self, groups: Groups, columns: Sequence[str] | None = None) -> Any:
        """The rows of ``groups``, a pyarrow.Table; of ``columns`` those that the file has."""
        footer = self.footer(groups.entry)
        with self.store.opened(groups.entry.path) as file:
            opened = arrow().parquet.ParquetFile(
                file,
                metadata=footer,
                page_checksum_verification=True,
                pre_buffer=not self.store.is_local,  # then one request reads what is close together
            )
            if columns is not None:
                known = opened.schema_arrow.names
                columns = [name for name in columns if name in known]
            is_large = groups.rows >= _ROWS_FOR_THREADS
            return opened.read_row_groups(groups.numbers, columns=columns, use_threads=is_large)


def _needed(spans: Sequence[tuple[int, int]], stamps: Stamps, *, between: bool) -> list[int]:
    """Which ``spans`` (first stamp, last stamp) may have the samples around each of ``stamps``, in order."""
    if not spans or not len(stamps):
        return []
    firsts, lasts = np.array(spans, np.int64).T
    starts, ends = stamps.searchsorted(firsts), stamps.searchsorted(lasts, "right")
    if between:
        is_needed = (firsts <= stamps[-1]) & (lasts >= stamps[0])
        alone = stamps[[0, -1]]
    else:
        is_needed, alone = starts < ends, stamps
    by_first, by_last = np.argsort(firsts, kind="stable"), np.argsort(lasts, kind="stable")
    overlap = (firsts[by_first][1:] <= np.maximum.accumulate(lasts[by_first])[:-1]).any()
    if not overlap and not between:  # stamps inside of a span need no other one
        gaps = zip([0, *ends[by_first].tolist()], [*starts[by_first].tolist(), len(stamps)], strict=True)
        alone = np.concatenate([stamps[start:end] for start, end in gaps])
    elif not overlap:
        place = firsts[by_first].searchsorted(alone, "right") - 1
        inside = (place >= 0) & (alone <= lasts[by_first][place])
        alone = alone[~inside]
    before = lasts[by_last].searchsorted(alone, "right") - 1
    after = firsts[by_first].searchsorted(alone)
    is_needed[by_last[before[before >= 0]]] = True
    is_needed[by_first[after[after < len(firsts)]]] = True
    return np.flatnonzero(is_needed).tolist()


def in_threads(call: Callable[[T], R], arguments: Sequence[T], threads: int | None = None) -> list[R]:
    """The results of ``call`` for each argument, in their order, by so many ``threads``.

    By default there is one for each processor: Parquet is decoded without the lock of the interpreter.
    """
    if len(arguments) < 2:
        return [call(one) for one in arguments]
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        return list(pool.map(call, arguments))
