"""Upkeep of an archive: what is damaged in it, and what is to be removed."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import NamedTuple

from zstate.archive.files import Entry, Files
from zstate.archive.layout import (
    FRAMES,
    IMPORTS,
    MODELS,
    SUFFIX,
    TABLES,
    WRITERS,
    check_version,
    folder_of,
    record_schema,
    value_of,
    write_small,
)
from zstate.archive.storage import STAGING, Store, arrow, bytes_digest
from zstate.errors import InvalidInput
from zstate.recording.errors import RecordingError


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
    files = Files(store)
    listed: dict[str, Entry] = {}
    for name in files.imports():
        with suppress(RecordingError):  # it is found below
            listed |= {one.path: one for one in files.record(name)}
    present: set[str] = set()
    for path, _ in store.files():
        present.add(path)
        if problem := _problem(files, path, listed.get(path)):
            yield Finding(path, problem)
    for path in sorted(listed.keys() - present):
        yield Finding(path, f"missing; {_repair(listed[path])}")


def _repair(entry: Entry) -> str:
    return f"remove {folder_of(IMPORTS)}/{entry.name}{SUFFIX} and add {entry.recording!r} again"


def _problem(files: Files, path: str, entry: Entry | None) -> str:
    """What is wrong with a file, which an import lists as ``entry``; empty for nothing."""
    top, _, name = path.partition("/")
    if top.startswith(STAGING):
        return "left by an import that was interrupted: add its recording again, or remove the folder"
    if path.endswith(SUFFIX):
        try:
            if f"{top}/" in TABLES:
                files.table(path)
                return ""
            if top.startswith("stream="):
                return _problem_of_samples(files, path, name.rpartition("/")[2], entry)
        except (RecordingError, OSError) as error:
            return f"{error}; remove it, and add its recording again"
        except ValueError:  # also ArrowInvalid
            pass
    return "not a file of an archive of zstate; move it away"


def _problem_of_samples(files: Files, path: str, name: str, entry: Entry | None) -> str:
    _, digest, _ = name.split(".")
    content = files.store.read(path)
    if entry is None:
        check_version(arrow().parquet.read_metadata(arrow().BufferReader(content)).metadata, path)
        return "of an import that was interrupted: add its recording again, or remove the file"
    is_whole = bytes_digest(content) == digest
    return "" if is_whole else f"damaged: its bytes have another digest than its name; {_repair(entry)}"


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
    files = Files(store)
    kept: list[Entry] = []
    doomed: list[str] = []
    for name in files.imports():
        path = f"{folder_of(IMPORTS)}/{name}{SUFFIX}"
        entries = files.record(name)
        rest = [one for one in entries if not is_removed(one.robot, one.date)]
        kept += rest
        if not rest:
            store.remove([path])
        elif len(rest) < len(entries):
            rows = [row for row in files.table(path).to_pylist() if not is_removed(row["robot"], row["date"])]
            with store.staging(name) as folder:
                write_small(folder / "record", record_schema(), rows)
                store.put(folder / "record", path)
    robots = {(one.name, one.robot) for one in kept}
    scenes = {(one.robot, one.frames) for one in kept}
    models: set[str] = set()
    sizes = dict(store.files())
    for path in sizes:
        top, *folders, name = path.split("/")
        values = [value_of(folder) for folder in folders]
        stem = name.removesuffix(SUFFIX)
        if top == folder_of(FRAMES) and (values[0], stem) in scenes:
            models |= {row["model"] for row in files.table(path).to_pylist() if row["kind"] == "model"}
            continue
        is_unused = top == folder_of(FRAMES)
        is_unused |= top == folder_of(WRITERS) and (stem, values[0]) not in robots
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
