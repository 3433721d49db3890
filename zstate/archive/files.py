"""The files of an archive that reads need: listed by import, chosen by time, read by row group."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.archive.layout import SUFFIX, WRITERS, check_version, cuts_by_date, folder_of, value_of
from zstate.archive.ledger import Entry, Ledger, newest_compaction
from zstate.archive.storage import Store, arrow, numbers_of

Stamps = NDArray[np.int64]

_ROWS_FOR_THREADS = 100_000
"""Rows of one file of which several columns are decoded at once."""


class Piece(NamedTuple):
    """A file, and its samples of some imports, which are consecutive ``entries`` of the ledger."""

    path: str
    entries: Sequence[Entry]

    @property
    def first(self) -> int:
        """The first stamp [ns]."""
        return min(one.first for one in self.entries)

    @property
    def last(self) -> int:
        """The last stamp [ns]."""
        return max(one.last for one in self.entries)


class Group(NamedTuple):
    """The row group ``number`` of the file of a ``piece``, with stamps from ``first`` to ``last`` [ns]."""

    piece: Piece
    number: int
    first: int
    last: int
    rows: int


class Groups(NamedTuple):
    """Row groups to read of the file of one ``piece``."""

    piece: Piece
    numbers: list[int]
    rows: int


class Files:
    """The files of the archive in ``store``. What was read of one is kept: files do not change."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.ledger = Ledger(store)
        self._footers: dict[str, Any] = {}

    def refresh(self) -> int:
        """Read the ledger again if there was a compaction; its number."""
        number = newest_compaction(self.store)
        if number != self.ledger.number:
            self.ledger = Ledger(self.store, number)
        return number

    def imports_of(self, robot: str) -> set[str]:
        """The imports, complete or not, with files or writers of a robot."""
        return {*self.ledger.compacted(robot), *self.writers_of(robot)}

    def writers_of(self, robot: str) -> list[str]:
        """The imports and compactions, complete or not, with a table of writers of a robot."""
        names = self.store.names(folder_of(WRITERS, robot))
        return [name.removesuffix(SUFFIX) for name in names]

    def records(self, robot: str, names: Iterable[str]) -> list[Entry]:
        """The files of ``robot`` that these imports have added."""
        return self.ledger.of_robot(robot, names)

    def dates(self, stream: str, robot: str) -> list[str]:
        """The dates with samples of a robot."""
        return [value_of(name) for name in self.store.folders(folder_of(stream, robot))]

    def around(self, robot: str, streams: Iterable[str], stamps: Stamps, *, between: bool) -> list[Entry]:
        """All files of the imports with files on the dates of ascending ``stamps``, or next to these.

        With ``between`` also those on all dates from the first to the last of the stamps.
        """
        wanted = np.array([day for day, _ in cuts_by_date(stamps)])
        names: set[str] = set()
        compacted: set[tuple[str, str]] = set()
        for stream in streams:
            dates = np.array(self.dates(stream, robot), str)
            at, after = dates.searchsorted(wanted), dates.searchsorted(wanted, "right")
            chosen = {*at.tolist(), *(at - 1).tolist(), *after.tolist()}
            if between:
                chosen |= {*range(int(at[0]), int(after[-1]))}
            for day in (str(dates[one]) for one in sorted(chosen) if 0 <= one < len(dates)):
                files = self.store.names(folder_of(stream, robot, day))
                names |= {file.partition(".")[0] for file in files if file.endswith(SUFFIX)}
                compacted.add((stream, day))
        for name, entries in self.ledger.compacted(robot).items():
            if any((one.stream, one.date) in compacted for one in entries):
                names.add(name)
        return self.records(robot, sorted(names))

    def groups(self, entries: Sequence[Entry], stamps: Stamps, *, between: bool) -> list[Group]:
        """The row groups of files of one key with the samples around each of ascending ``stamps``.

        With ``between`` also all samples from the first to the last of the stamps.
        """
        by_path: dict[str, list[Entry]] = {}
        for one in entries:
            by_path.setdefault(one.path, []).append(one)
        pieces = [Piece(path, ordered) for path, ordered in by_path.items()]
        chosen = _needed([(one.first, one.last) for one in pieces], stamps, between=between)
        pieces = [pieces[number] for number in chosen]
        found: list[Group] = []
        self.store.in_threads(self.footer, [one.path for one in pieces if not self._has_one_group(one)])
        for piece in pieces:
            if self._has_one_group(piece):
                rows = sum(one.rows for one in piece.entries)
                found.append(Group(piece, 0, piece.first, piece.last, rows))
                continue
            footer = self.footer(piece.path)
            column = footer.schema.names.index("stamp")
            for group in range(footer.num_row_groups):
                about = footer.row_group(group)
                statistics = about.column(column).statistics
                first, last = max(statistics.min, piece.first), min(statistics.max, piece.last)
                if first <= last:
                    found.append(Group(piece, group, first, last, about.num_rows))
        return needed_groups(found, stamps, between=between)

    def _has_one_group(self, piece: Piece) -> bool:
        return piece.entries[0].groups == 1 and piece.path not in self._footers

    def footer(self, path: str) -> Any:
        """The metadata of a file. Raises RecordingError for one that cannot be read."""
        if path not in self._footers:
            with self.store.opened(path) as file:
                footer = arrow().parquet.read_metadata(file)
            check_version(footer.metadata, self.store.where(path))
            self._footers[path] = footer
        return self._footers[path]

    def read_all(self, groups: Sequence[Groups], columns: Sequence[str] | None = None) -> list[Any]:
        """The rows of each of ``groups``."""
        return self.store.in_threads(lambda one: self.read(one, columns), groups)

    def read(self, groups: Groups, columns: Sequence[str] | None = None) -> Any:
        """The rows of ``groups``, a pyarrow.Table; of ``columns`` those that the file has."""
        path, piece = groups.piece.path, groups.piece
        with self.store.opened(path) as file:
            opened = arrow().parquet.ParquetFile(
                file,
                metadata=self._footers.get(path),
                page_checksum_verification=True,
                pre_buffer=not self.store.is_local,  # then one request reads what is close together
            )
            if path not in self._footers:
                check_version(opened.metadata.metadata, self.store.where(path))
            is_large = groups.rows >= _ROWS_FOR_THREADS
            table = opened.read_row_groups(groups.numbers, columns=columns, use_threads=is_large)
        stamps = numbers_of(table.column("stamp"))
        if stamps.min() < piece.first or stamps.max() > piece.last:  # samples of other imports
            return table.filter(arrow().array((stamps >= piece.first) & (stamps <= piece.last)))
        return table


def needed_groups(groups: Sequence[Group], stamps: Stamps, *, between: bool = False) -> list[Group]:
    """Those of ``groups`` with the samples around each of ascending ``stamps``; see ``Files.groups``.

    Of the groups for some stamps, those for a part of these are the same as of all groups.
    """
    spans = [(one.first, one.last) for one in groups]
    return [groups[number] for number in _needed(spans, stamps, between=between)]


def by_file(groups: Iterable[Group]) -> list[Groups]:
    """``groups``, together if they are in the same file."""
    found: dict[str, Groups] = {}
    for one in groups:
        before = found.get(one.piece.path, Groups(one.piece, [], 0))
        found[one.piece.path] = Groups(one.piece, [*before.numbers, one.number], before.rows + one.rows)
    return list(found.values())


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
