"""Upkeep of an archive: what is damaged in it, and what is to be removed."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from zstate.archive.compaction import sweep
from zstate.archive.layout import (
    FRAMES,
    MODELS,
    SUFFIX,
    TABLES,
    WRITERS,
    check_version,
    folder_of,
    record_schema,
    value_of,
    write_small,
    writers_schema,
)
from zstate.archive.ledger import (
    Entry,
    Ledger,
    compacted_path,
    entries_of,
    is_compacted,
    record_path,
    write_ledger,
)
from zstate.archive.storage import STAGING, Store, arrow, bytes_digest
from zstate.errors import InvalidInput
from zstate.recording.errors import RecordingError

_NAMED = 3
"""Recordings that a finding names; of more it has the number."""

_REPLACED = "not used any more, as other files have its rows; `zstate archive DIR compact` removes it"


class Finding(NamedTuple):
    """A file that is not used, or not as it was written, and what to do."""

    path: str
    problem: str


class Removed(NamedTuple):
    """How much was removed: files, and their size [bytes]."""

    files: int
    size: int


def check(url: str) -> Iterator[Finding]:
    """What is wrong in the archive ``url``, file by file; all files are read.

    A file that is found costs only itself: the rest of the archive is used.
    """
    store = Store(url)
    ledger = Ledger(store)
    listed: dict[str, list[Entry]] = {}
    rows = ledger.rows(skip_damaged=True)
    for one in entries_of(rows):
        listed.setdefault(one.path, []).append(one)
    present = [path for path, _ in store.files()]
    replaced: set[str] = set()
    with suppress(RecordingError):  # its file is found below
        replaced = {*ledger.replaced(rows, present)}
    for path in present:
        problem = _REPLACED if path in replaced else _problem(ledger, store, path, listed.get(path))
        if problem:
            yield Finding(path, problem)
    for path in sorted(listed.keys() - {*present}):
        yield Finding(path, f"missing; {_repair(listed[path])}")


def _repair(entries: Sequence[Entry]) -> str:
    """How to get the samples of a file back once it is not there."""
    names = sorted({one.recording for one in entries})
    some = ", ".join(map(repr, names[:_NAMED])) + (
        f" and {len(names) - _NAMED} more" if names[_NAMED:] else ""
    )
    return f"add {some} again"


def _problem(ledger: Ledger, store: Store, path: str, entries: Sequence[Entry] | None) -> str:
    """What is wrong with a file, of which ``entries`` are listed; empty for nothing."""
    top, _, name = path.partition("/")
    if top.startswith(STAGING):
        return "left by an import or a compaction that was interrupted: repeat it, or remove the folder"
    if path.endswith(SUFFIX):
        try:
            if f"{top}/" in TABLES:
                ledger.table(path)
                return ""
            if top.startswith("stream="):
                return _problem_of_samples(store, path, name.rpartition("/")[2], entries)
        except (RecordingError, OSError) as error:
            return f"{error}; remove it, and add its recording again"
        except ValueError:  # also ArrowInvalid
            pass
    return "not a file of an archive of zstate; move it away"


def _problem_of_samples(store: Store, path: str, name: str, entries: Sequence[Entry] | None) -> str:
    _, digest, _ = name.split(".")
    content = store.read(path)
    if entries is None:
        check_version(arrow().parquet.read_metadata(arrow().BufferReader(content)).metadata, path)
        return "of an import that was interrupted: add its recording again, or remove the file"
    if bytes_digest(content) == digest:
        return ""
    return f"damaged: its bytes have another digest than its name; remove it, and {_repair(entries)}"


def expire(url: str, before: str) -> Removed:
    """Remove all samples of dates before the date ``before``, "2026-08-01" (UTC).

    Imports without any sample left are removed, too: their recordings can be added again.
    """
    return _remove(url, lambda robot, day: day < before)


def forget(url: str, robot: str) -> Removed:
    """Remove all that the archive has of ``robot``. Raises InvalidInput for one that it does not have."""
    store = Store(url)
    if robot not in {value_of(name) for name in store.folders(folder_of(WRITERS))}:
        raise InvalidInput(f"the archive {url!r} has no robot {robot!r}")
    return _remove(url, lambda one, _: one == robot)


def _remove(url: str, is_removed: Callable[[str, str], bool]) -> Removed:
    """Remove the samples of a robot on a date for which ``is_removed`` is true: first from the imports."""
    store = Store(url)
    ledger = Ledger(store)
    rows = ledger.rows()
    sweep(store, ledger, rows)
    kept = [row for row in rows if not is_removed(row["robot"], row["date"])]
    own, _ = ledger.counted()
    by_import: dict[str, list[dict[str, Any]]] = {name: [] for name in own}
    compacted: list[dict[str, Any]] = []
    for row in kept:
        by_import.get(row["import"], compacted).append(row)
    changed = {row["import"] for row in rows if is_removed(row["robot"], row["date"])}
    for name, rest in by_import.items():
        if not rest:
            store.remove([record_path(name)])
        elif name in changed:
            _replace(store, record_path(name), partial(_write, record_schema(), rest))
    if ledger.number and changed - by_import.keys():
        path = compacted_path(ledger.number)
        if compacted:
            _replace(store, path, partial(write_ledger, compacted))
        else:
            store.remove([path])
    robots = {(row["import"], row["robot"]) for row in kept}
    scenes = {(row["robot"], row["frames"]) for row in kept}
    doomed: list[str] = []
    models: set[str] = set()
    sizes = dict(store.files())
    for path in sizes:
        top, *folders, name = path.split("/")
        values = [value_of(folder) for folder in folders]
        stem = name.removesuffix(SUFFIX)
        if top == folder_of(FRAMES) and (values[0], stem) in scenes:
            models |= {row["model"] for row in ledger.table(path).to_pylist() if row["kind"] == "model"}
            continue
        is_unused = top == folder_of(FRAMES)
        if top == folder_of(WRITERS):
            names = {name for name, robot in robots if robot == values[0]}
            is_unused = _is_left_empty(store, ledger, path, names)
        if is_unused or (top.startswith("stream=") and len(values) == 2 and is_removed(values[0], values[1])):
            doomed.append(path)
    doomed += [
        path
        for path in sizes
        if path.startswith(f"{folder_of(MODELS)}/")
        and path.rpartition("/")[2].removesuffix(SUFFIX) not in models
    ]
    store.remove(doomed)
    return Removed(len(doomed), sum(sizes[path] for path in doomed))


def _is_left_empty(store: Store, ledger: Ledger, path: str, names: set[str]) -> bool:
    """Whether a table of writers has none of the imports ``names``; it keeps no others."""
    stem = path.rpartition("/")[2].removesuffix(SUFFIX)
    if not is_compacted(stem):
        return stem not in names
    rows = ledger.table(path).to_pylist()
    kept = [row for row in rows if row["import"] in names]
    if kept and len(kept) < len(rows):
        _replace(store, path, partial(_write, writers_schema(), kept))
    return not kept


def _write(schema: Any, rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    write_small(path, schema, rows)


def _replace(store: Store, path: str, write: Callable[[Path], None]) -> None:
    """Put what ``write`` writes into a file in place of ``path``."""
    with store.staging(Path(path).stem) as folder:
        write(folder / "table")
        store.put(folder / "table", path)
