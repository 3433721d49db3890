"""Compaction: fewer files with the same samples, as each file costs every lookup and query.

======================  ==========================================================================
files                   become
======================  ==========================================================================
``imports/``            one, ``compacted/compacted-N.parquet``, with the records of all imports
``writers/robot=R/``    one of each robot
samples                 one of each stream, robot, date and key, sorted by stamp, with row groups
                        as large as an import makes them
======================  ==========================================================================

Files of samples are merged if they have the same columns and frames, and the recordings follow one another:
where two of a robot overlap in time, as of two recorders, their files stay, and so do files that are large.
What an import has added stays known by its name and its stamps, so that lookups, `forget`, `expire`, the
coverage, and adding a recording again are as before.

All new files are written first; the ledger, ``compacted-N.parquet``, is the last one, and from it on they
count, and those that they replace do not. These are removed then. A compaction that is interrupted before its
ledger has changed nothing; after it, the next one removes what is left.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, groupby
from pathlib import Path
from typing import Any

import numpy as np

from zstate.archive.files import Files, Groups
from zstate.archive.layout import (
    EDGES,
    SUFFIX,
    WRITERS,
    TableFile,
    folder_of,
    value_of,
    write_small,
    writers_schema,
)
from zstate.archive.ledger import (
    Entry,
    Ledger,
    compacted_path,
    compacted_stem,
    entries_of,
    newest_compaction,
    write_ledger,
)
from zstate.archive.storage import Store
from zstate.errors import InvalidInput
from zstate.recording.errors import RecordingError

_MOST_VALUES = 64_000_000
_MOST_BYTES = 512_000_000
"""Of a merged file. One of half of that is large, and stays."""

Row = dict[str, Any]


@dataclass
class CompactionReport:
    """What one compaction did: the ``files`` that it removed, and those ``written`` in their place.

    ``problems`` are files that could not be read, by path; they stay as they are.
    """

    files: int = 0
    written: int = 0
    problems: Mapping[str, str] = field(default_factory=dict[str, str])


def compact(
    url: str, before: str | None = None, on_progress: Callable[[str], object] = lambda text: None
) -> CompactionReport:
    """Merge the files of the archive ``url``; those of samples only of dates before the date ``before``.

    While it runs, recordings may be added, and Archives may read: they see the files from before or those
    from after it. Nothing may remove or repair files, and no other compaction run. Merged samples take their
    space twice until its end. Raises RecordingError for an archive that cannot be read or written.
    """
    store = Store(url)
    report = CompactionReport()
    ledger = Ledger(store)
    own, _ = ledger.counted()
    names = {*ledger.imported(), *own}
    rows = [row for row in ledger.rows() if row["import"] in names]  # without an import that ends after this
    report.files = sweep(store, ledger, rows)
    files = Files(store)
    runs = list(_runs(files, rows, before))
    if not own and not runs:
        return report
    number = ledger.number + 1
    with store.staging(compacted_stem(number)) as folder:
        new_path = map(folder.joinpath, map(str, count())).__next__
        for done, run in enumerate(runs):
            on_progress(f"{done} of {len(runs)} files merged")
            try:
                _merge(files, run, compacted_stem(number), new_path())
            except RecordingError as error:
                report.problems = {**report.problems, str(error.path): str(error)}
            else:
                report.written += 1
        report.written += _merge_writers(store, own, number, new_path)
        _write_ledger(store, _completed(rows, names), number, new_path())
    report.written += 1
    report.files += sweep(store, Ledger(store), rows)
    return report


def _runs(files: Files, rows: Sequence[Row], before: str | None) -> Iterator[list[Row]]:
    """The rows of files that become one each, in the order of their samples."""
    by_place: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        if row["path"] and row["columns"] and (before is None or row["date"] < before):
            by_place.setdefault((row["stream"], row["robot"], row["date"], row["key"]), []).append(row)
    for placed in by_place.values():
        paths = [row["path"] for row in placed]
        if len(set(paths)) == 1:
            continue
        for run in _consecutive(files, sorted(placed, key=lambda row: _entry(row).order)):
            inside = [row["path"] for row in run]
            is_whole = all(inside.count(path) == paths.count(path) for path in set(inside))
            if is_whole and len(set(inside)) > 1:
                yield run


def _consecutive(files: Files, rows: Sequence[Row]) -> Iterator[list[Row]]:
    run: list[Row] = []
    size = 0.0
    alike = None
    for row in rows:
        values = row["rows"] * (row["columns"].count(":") or 1)
        own_size = max(values / _MOST_VALUES, row["bytes"] / _MOST_BYTES)
        kind = row["frames"], row["columns"], _parent(files, row)
        is_next = kind == alike and run[-1]["last"] < row["first"]
        if run and (not is_next or own_size >= 0.5 or size + own_size > 1.0):
            yield run
            run, size = [], 0.0
        run.append(row)
        size += own_size
        alike = kind if own_size < 0.5 else None
    if run:
        yield run


def _parent(files: Files, row: Row) -> str:
    """What all samples of a moving edge have in common; the path of a file whose samples differ."""
    if row["stream"] != EDGES:
        return ""
    try:
        footer = files.footer(row["path"])
    except (RecordingError, OSError):
        return row["path"]
    column = footer.schema.names.index("parent")
    found = [footer.row_group(group).column(column).statistics for group in range(footer.num_row_groups)]
    parents = {parent for one in found for parent in (one.min, one.max)}
    return parents.pop() if len(parents) == 1 else row["path"]


def _entry(row: Row) -> Entry:
    return entries_of([row])[0]


def _merge(files: Files, run: list[Row], stem: str, staged: Path) -> None:
    """Write the samples of ``run`` into one file, and note it in the rows."""
    stream, robot, day, key = (run[0][name] for name in ("stream", "robot", "date", "key"))
    table = TableFile(staged, stream, robot, day, key)
    try:
        for path, entries in groupby(map(_entry, run), key=lambda one: one.path):
            _copy(files, path, list(entries), table)
    except BaseException:
        table.abandon()
        raise
    written = table.finish()
    path = f"{folder_of(stream, robot, day)}/{stem}.{written.digest}{SUFFIX}"
    size = staged.stat().st_size
    files.store.put(staged, path)
    for row in run:
        row |= {"path": path, "groups": written.groups, "bytes": size * row["rows"] // written.rows}


def _copy(files: Files, path: str, entries: list[Entry], table: TableFile) -> None:
    ends = np.array([entries[0].first, entries[-1].last], np.int64)
    rows = 0
    for group in files.groups(entries, ends, between=True):
        part = files.read(Groups(group.piece, [group.number], group.rows))
        rows += part.num_rows
        table.write(part)
    if rows != sum(one.rows for one in entries):
        where = files.store.where(path)
        raise RecordingError(f"{where!r} has {rows} rows in place of those that are listed", path=where)


def _merge_writers(store: Store, own: Sequence[str], number: int, new_path: Callable[[], Path]) -> int:
    """Write the writers of each robot into one file; returns the number of files."""
    written = 0
    read = Ledger(store).table
    for robot in map(value_of, store.folders(folder_of(WRITERS))):
        folder = folder_of(WRITERS, robot)
        present = {name.removesuffix(SUFFIX) for name in store.names(folder)}
        stems = [one for one in (compacted_stem(number - 1), *own) if one in present]
        tables = store.in_threads(read, [f"{folder}/{stem}{SUFFIX}" for stem in stems])
        rows: dict[str, list[Row]] = {}
        for table in tables:  # that of an import replaces what a compaction has of it
            by_import: dict[str, list[Row]] = {}
            for row in table.to_pylist():
                by_import.setdefault(row["import"], []).append(row)
            rows |= by_import
        if stems:
            staged = new_path()
            write_small(staged, writers_schema(), [row for name in sorted(rows) for row in rows[name]])
            store.put(staged, f"{folder}/{compacted_stem(number)}{SUFFIX}")
            written += 1
    return written


def _completed(rows: Sequence[Row], names: set[str]) -> list[Row]:
    """The rows of a ledger: one at least for each of the imports ``names``, which has one time."""
    nothing = {"path": "", "robot": "", "stream": "", "date": "", "imported": 0}
    empty = [{"import": name, **nothing} for name in names - {row["import"] for row in rows}]
    newest: dict[str, int] = {}
    for row in rows:
        newest[row["import"]] = max(newest.get(row["import"], 0), row["imported"])
    for row in rows:
        row["imported"] = newest[row["import"]]
    return [*rows, *empty]


def _write_ledger(store: Store, rows: list[Row], number: int, staged: Path) -> None:
    """Write the ledger of compaction ``number``, from which on it counts."""
    write_ledger(rows, staged)
    if newest_compaction(store) != number - 1:
        raise InvalidInput(
            f"another compaction of {store.url!r} has ended while this one ran, which has changed nothing; "
            "run one at a time"
        )
    store.put(staged, compacted_path(number))


def sweep(store: Store, ledger: Ledger, rows: Sequence[Row]) -> int:
    """Remove the files that a compaction has replaced, or left; ``rows`` are all that count."""
    doomed = ledger.replaced(rows, [path for path, _ in store.files()])
    store.remove(doomed)
    return len(doomed)
