"""The ledger of an archive: the files that count, as the imports of recordings and `compact` list them.

An import writes its record, ``imports/IMPORT.parquet``, last. `zstate archive compact` writes one file with
the records of all imports, ``compacted/compacted-N.parquet``, of which the one with the largest N counts: it
replaces the records and the files that it was made of, at once, as it appears as a whole. A record of an
import that was made later than the one in there counts in its place.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

import re
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from zstate.archive.layout import (
    COMPACTED,
    IMPORTS,
    SUFFIX,
    WRITERS,
    check_version,
    folder_of,
    record_schema,
    write_small,
)
from zstate.archive.storage import Store, arrow
from zstate.recording.errors import RecordingError

_PREFIX = "compacted-"

_ROWS_PER_GROUP = 4096


class Entry(NamedTuple):
    """The samples of one import in a file, as the ledger lists them.

    ``name`` is that of the import of a recording. The file may have samples of others as well, before the
    stamp ``first`` and after ``last`` [ns]; it has so many row ``groups``, 0 if that is not listed.
    ``frames`` is the digest of the static edges and the model that were in effect, ``recorded`` the first log
    time [ns] of the recording, ``imported`` the time of its import [ns].
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
    groups: int
    frames: str
    recorded: int
    recording: str
    imported: int

    @property
    def order(self) -> tuple[int, str, int]:
        """Of samples with the same stamp, those of the entry with the largest count."""
        return self.recorded, self.name, self.first


def entries_of(rows: Iterable[Mapping[str, Any]], name: str = "") -> list[Entry]:
    """The entries in rows of a record; ``name`` is that of the import if they have none."""
    known = Entry._fields[1:]
    defaults = {"groups": 0}
    return [
        Entry(row.get("import") or name, *(row.get(field, defaults.get(field)) for field in known))
        for row in rows
        if row["path"]
    ]


def record_path(name: str) -> str:
    """The record of the import ``name``."""
    return f"{folder_of(IMPORTS)}/{name}{SUFFIX}"


def compacted_stem(number: int) -> str:
    """The name of compaction ``number``, with which its files begin."""
    return f"{_PREFIX}{number:06d}"


def compacted_path(number: int) -> str:
    """The ledger that compaction ``number`` has written."""
    return f"{folder_of(COMPACTED)}/{compacted_stem(number)}{SUFFIX}"


def is_compacted(stem: str) -> bool:
    """Whether the name of a file, up to its first dot, is one of a compaction."""
    return stem.startswith(_PREFIX)


class Ledger:
    """The ledger of the archive in ``store``.

    ``number`` is that of the compaction that counts, 0 for none. What was read is kept.
    """

    def __init__(self, store: Store, number: int | None = None) -> None:
        self._store = store
        self.number = newest_compaction(store) if number is None else number
        self._records: dict[str, tuple[Entry, ...]] = {}
        self._compacted: dict[str, Mapping[str, tuple[Entry, ...]]] = {}
        self._imported: Mapping[str, int] | None = None

    def imported(self) -> Mapping[str, int]:
        """When each of the imports was made that the compaction lists."""
        if self._imported is None:
            self._imported = {}
            if self.number:
                table = self.table(compacted_path(self.number), ["import", "imported"])
                self._imported = dict(zip(*(column.to_pylist() for column in table.columns), strict=True))
        return self._imported

    def recorded_names(self) -> list[str]:
        """The imports with a record of their own."""
        return [name.removesuffix(SUFFIX) for name in self._store.names(folder_of(IMPORTS))]

    def is_complete(self, name: str) -> bool:
        """Whether the import ``name`` is complete."""
        return self.has_record(name) or name in self.imported()

    def has_record(self, name: str) -> bool:
        """Whether the import ``name`` is complete, and has a record of its own."""
        return self._store.has(record_path(name))

    def record(self, name: str) -> tuple[Entry, ...]:
        """The files that the record of an import lists; none if it has none of its own."""
        if name not in self._records:
            if not self.has_record(name):
                return ()
            rows = self.table(record_path(name)).to_pylist()
            self._records[name] = tuple(entries_of(rows, name))
        return self._records[name]

    def files_of(self, name: str) -> list[Entry]:
        """The files that the import ``name`` has added, of all robots."""
        own = self.record(name)
        listed = self._listed("import", name)
        return [*own] if _is_newer(own, listed) else listed

    def compacted(self, robot: str) -> Mapping[str, tuple[Entry, ...]]:
        """By import, the files of ``robot`` that the compaction lists."""
        if robot not in self._compacted:
            found: dict[str, list[Entry]] = {}
            for one in self._listed("robot", robot):
                found.setdefault(one.name, []).append(one)
            self._compacted[robot] = {name: tuple(entries) for name, entries in found.items()}
        return self._compacted[robot]

    def of_robot(self, robot: str, names: Iterable[str]) -> list[Entry]:
        """The files of ``robot`` that the imports ``names`` have added."""
        compacted = self.compacted(robot)
        chosen = list(dict.fromkeys(names))
        alone = set(self.recorded_names()) if compacted else set(chosen)
        self._store.in_threads(
            self.record, [one for one in chosen if one in alone and one not in self._records]
        )
        found: list[Entry] = []
        for name in chosen:
            known = compacted.get(name, ())
            if name in alone:
                own = self.record(name)
                if _is_newer(own, known):
                    found += (one for one in own if one.robot == robot)
                    continue
            found += known
        return found

    def counted(self) -> tuple[list[str], set[str]]:
        """The imports whose own record counts, and those of them that the compaction lists as well."""
        imported = self.imported()
        own = self.recorded_names()
        again = {
            name
            for name in own
            if name in imported
            and max((one.imported for one in self.record(name)), default=0) > imported[name]
        }
        return [name for name in own if name not in imported or name in again], again

    def rows(self, *, skip_damaged: bool = False) -> list[dict[str, Any]]:
        """All rows that count. Raises RecordingError for a record that cannot be read, or leaves it out."""

        def read(path: str) -> list[dict[str, Any]]:
            try:
                return self.table(path).to_pylist()
            except RecordingError:
                if not skip_damaged:
                    raise
                return []

        rows = read(compacted_path(self.number)) if self.number else []
        imported = {row["import"]: row["imported"] for row in rows}
        names = self.recorded_names()
        own: dict[str, list[dict[str, Any]]] = {}
        for name, found in zip(names, self._store.in_threads(read, [*map(record_path, names)]), strict=True):
            newest = max((row["imported"] for row in found), default=0)
            if name not in imported or newest > imported[name]:
                own[name] = [{"groups": 0, "columns": None, **row, "import": name} for row in found]
        rows = [row for row in rows if row["import"] not in own]
        return [*rows, *(row for found in own.values() for row in found)]

    def replaced(self, rows: Iterable[Mapping[str, Any]], paths: Iterable[str]) -> list[str]:
        """Those of ``paths`` that a compaction has replaced, or left; ``rows`` are all that count."""
        listed = {row["path"] for row in rows}
        own, _ = self.counted()
        old = {*self.recorded_names()} - {*own}
        found: list[str] = []
        for path in paths:
            top, _, name = path.partition("/")
            stem = name.rpartition("/")[2].partition(".")[0]
            is_other = is_compacted(stem) and stem != compacted_stem(self.number)
            is_replaced = {
                IMPORTS: stem in old,
                COMPACTED: is_other,
                WRITERS: is_other or stem in self.imported(),
            }.get(f"{top}/", False)
            if top.startswith("stream=") and path not in listed:
                is_replaced = is_compacted(stem) or stem in self.imported()
            if is_replaced:
                found.append(path)
        return found

    def table(self, path: str, columns: Sequence[str] | None = None) -> Any:
        """A table that fits into memory, a pyarrow.Table. Raises RecordingError."""
        with self._opened(path) as file:
            return file.read(columns, use_threads=False)

    @contextmanager
    def _opened(self, path: str) -> Generator[Any, None, None]:
        with self._store.opened(path) as file:
            opened = arrow().parquet.ParquetFile(file, page_checksum_verification=True)
            check_version(opened.metadata.metadata, self._store.where(path))
            yield opened

    def _listed(self, column: str, value: str) -> list[Entry]:
        """The entries of the compaction with ``value``; only row groups that may have it are read."""
        if not self.number:
            return []
        rows: list[Mapping[str, Any]] = []
        columns = [name for name in record_schema().names if name != "columns"]
        with self._opened(compacted_path(self.number)) as file:
            place = file.metadata.schema.names.index(column)
            for group in range(file.num_row_groups):
                about = file.metadata.row_group(group).column(place).statistics
                if about.min <= value <= about.max:
                    table = file.read_row_group(group, columns, use_threads=False)
                    found = [n for n, one in enumerate(table.column(column).to_pylist()) if one == value]
                    if found:  # rows of one robot are together
                        part = table.slice(found[0], found[-1] + 1 - found[0])
                        rows += (row for row in part.to_pylist() if row[column] == value)
        return entries_of(rows)


def _is_newer(own: Sequence[Entry], compacted: Sequence[Entry]) -> bool:
    """Whether an import's own record counts, rather than what the compaction lists of it."""
    return bool(own) and not (compacted and compacted[0].imported >= max(one.imported for one in own))


def write_ledger(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write the ledger of a compaction, in which the rows of one robot are close together."""
    ordered = sorted(rows, key=lambda row: (row["robot"], row["import"], row.get("first") or 0))
    write_small(path, record_schema(), ordered, _ROWS_PER_GROUP)


def newest_compaction(store: Store) -> int:
    """The number of the compaction that counts; 0 for none."""
    names = store.names(folder_of(COMPACTED))
    found = (re.fullmatch(rf"{_PREFIX}(\d+)\{SUFFIX}", name, re.ASCII) for name in names)
    return max((int(one[1]) for one in found if one), default=0)
