"""Reads the records of a recording, in MCAP files or a ROS 2 bag, in the order of their log times.

The folder of a rosbag2 recording lists its files in metadata.yaml. Only that list is read from the YAML
(https://github.com/ros2/rosbag2, versions 1 to 9 of the format); the rest is in the files.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Collection, Generator, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any
from urllib.parse import quote

from zstate._util.closeable import Closeable
from zstate.recording.errors import RecordingError
from zstate.recording.mcap.file import McapFile, explain_unreadable, open_errors, split_files
from zstate.recording.mcap.records import MAGIC
from zstate.recording.storage import (
    Channel,
    Format,
    ReadFilter,
    Record,
    SortedPart,
    Storage,
    merge_by_log_time,
    merge_channels,
)

FORMATS: dict[str, Format] = {".mcap": "mcap", ".db3": "sqlite3"}
METADATA = "metadata.yaml"

_TOP = "rosbag2_bagfile_information"
_NEWEST = 9
_MAX_DEPTH = 50
"""Of YAML: libyaml composes nodes recursively, so deeper ones could overflow the stack of the process."""

_SQLITE_MAGIC = b"SQLite format 3\0"
_OPTIONAL = {"offered_qos_profiles": "offered_qos_profiles", "type_description_hash": "topic_type_hash"}
# A row takes more than four bytes and less than fifty steps of SQLite's virtual machine.
_STEPS, _STEPS_PER_BYTE = 100_000_000, 16
_STEPS_BETWEEN = 100_000
_STAMPS = (-(1 << 63), (1 << 63) - 1)


class RecordingReader(Closeable):
    """A recording, opened read-only.

    ``path`` is an MCAP file, the first file of a split recording (the others are found in its folder), a
    .db3 file, or the folder of a bag, with or without metadata.yaml. The format is decided by the first
    bytes of a file, not its name. With ``is_alone`` a file is read without the other parts. Raises
    RecordingError for other files and unreadable ones.

    A truncated or damaged file is read as far as possible: ``complete`` is then False, and ``losses``
    describes what is missing. Damage that is found only during a read raises RecordingError there.
    ``missing`` are the messages that the recorder did not get, by "robot/stream", if it has stated them.
    ``skipped`` are the channels that are not readable (see ``Channel``); their records are left out.
    """

    def __init__(self, path: str | os.PathLike[str], *, is_alone: bool = False) -> None:
        self.path = Path(path)
        files, missing = [self.path], list[str]()
        if self.path.is_dir():
            files = bag_files(self.path)
        elif not is_alone:
            files, missing = split_files(self.path)
        self.storages: list[Storage] = []
        self._is_open = True
        try:
            for file in files:
                self.storages.append(_open_storage(file))
        except RecordingError:
            self.close()
            raise
        channels = merge_channels(channel for storage in self.storages for channel in storage.channels)
        self._channels = tuple(channel for channel in channels if channel.is_readable)
        self.skipped = tuple(channel for channel in channels if not channel.is_readable)
        self.losses = (
            *(f"{storage.path.name}: {loss}" for storage in self.storages for loss in storage.losses),
            *(f"{name} is missing" for name in missing),
        )
        self.missing = {name: count for one in self.storages for name, count in one.missing.items()}
        self.complete = not self.losses and all(storage.complete for storage in self.storages)

    def channels(self) -> tuple[Channel, ...]:
        """The readable channels of all files without duplicates, with their record counts."""
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
        if not self._is_open:
            raise RecordingError(f"the recording {str(self.path)!r} is closed", path=str(self.path))
        read_filter = ReadFilter(
            None if topics is None else frozenset(topics),
            -(1 << 63) if begin is None else begin,
            1 << 64 if end is None else end,
        )
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


class SqliteFile:
    """A .db3 file, opened read-only; log and publish times are the same."""

    format: Format = "sqlite3"
    profile = "ros2"
    library = ""
    complete = True
    compressions: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()
    missing: Mapping[str, int] = MappingProxyType({})

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = self._steps = self._max_steps = 0
        with self._errors():
            self.size = path.stat().st_size
            self._max_steps = _STEPS + _STEPS_PER_BYTE * self.size
            uri = f"file:{quote(str(path.resolve()))}?mode=ro"
            journals = [path.with_name(path.name + ending) for ending in ("-wal", "-journal")]
            if not any(journal.exists() for journal in journals):
                # SQLite then creates no files of its own, which would need a writable folder. It would also
                # ignore the journal in which a killed recorder left the newest messages.
                uri += "&immutable=1"
            self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
            self._database.set_progress_handler(self._is_over_limit, _STEPS_BETWEEN)
        try:
            with self._errors():
                found = self._rows(
                    "SELECT name, type, rootpage FROM sqlite_master WHERE name IN ('topics', 'messages')"
                )
                for name, kind, page in found:  # views may have rows without end
                    if kind != "table" or not page:
                        found_kind = kind if page else "view or virtual table"
                        raise ValueError(f"{name!r} is a {found_kind}, not a table")
                self._channels = dict(self._read_channels())
                ((first, last),) = self._rows("SELECT min(timestamp), max(timestamp) FROM messages")
                self.span = None if first is None else (int(first), int(last))
        except RecordingError:
            self.close()
            raise
        self.channels = tuple(self._channels.values())

    @contextmanager
    def _errors(self) -> Generator[None, None, None]:
        try:
            yield
        except (sqlite3.Error, OSError, ValueError, TypeError, OverflowError) as error:
            reason = str(error)
            if self._steps > self._max_steps:
                reason = f"a query took more than {self._max_steps} steps, too many for {self.size} bytes"
            elif isinstance(error, sqlite3.OperationalError) and "interrupted" in reason:
                raise KeyboardInterrupt from None  # SQLite drops exceptions that signals raise in the handler
            text = (
                f"{str(self.path)!r} cannot be read as a rosbag2 database: {reason}; if it is damaged, "
                "`sqlite3 FILE .recover` may save a part of it"
            )
            raise RecordingError(text, path=str(self.path)) from error

    def _is_over_limit(self) -> bool:
        self._steps += _STEPS_BETWEEN
        return self._steps > self._max_steps

    def _read_channels(self) -> Iterator[tuple[int, Channel]]:
        counts = dict(self._rows("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        known = {str(name) for _, name, *_ in self._rows("PRAGMA table_info(topics)")}
        extra = [column for column in _OPTIONAL if column in known]
        columns = ", ".join(["id", "name", "type", "serialization_format", *extra])
        for number, *texts in self._rows(f"SELECT {columns} FROM topics ORDER BY id"):
            if not isinstance(number, int) or not all(isinstance(text, str) for text in texts):
                raise TypeError(f"the topic {number!r} is described by {texts!r}")
            topic, type_name, encoding, *rest = texts
            metadata = {_OPTIONAL[key]: text for key, text in zip(extra, rest, strict=True) if text}
            yield number, Channel(topic, type_name, encoding, metadata, int(counts.get(number, 0)))

    def _rows(self, query: str, values: tuple[Any, ...] = ()) -> Iterator[Any]:
        self._steps = 0
        return self._database.execute(query, values)

    def parts(self, read_filter: ReadFilter) -> list[SortedPart]:
        if self.span is None:
            return []
        return [SortedPart(self.span[0], partial(self._records, read_filter))]

    def _records(self, read_filter: ReadFilter) -> Iterator[Record]:
        selected = {
            number: channel for number, channel in self._channels.items() if read_filter.accepts(channel)
        }
        query = (
            "SELECT topic_id, timestamp, data FROM messages WHERE timestamp BETWEEN ? AND ? "
            f"AND topic_id IN ({', '.join(map(str, selected))}) ORDER BY timestamp, id"
        )
        first, last = _STAMPS
        limits = max(read_filter.begin, first), min(read_filter.end - 1, last)
        with self._errors():
            for number, stamp, data in self._rows(query, limits):
                if not isinstance(stamp, int) or not isinstance(data, bytes):
                    raise TypeError(f"a message at {stamp!r} is {type(data).__name__}")
                yield Record(selected[number], data, stamp, stamp, 0)

    def close(self) -> None:
        self._database.close()


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag, ordered by its metadata.yaml, or by their numbers if it has none."""
    metadata = folder / METADATA
    if not metadata.exists():
        return _numbered_files(folder)
    try:
        names = _listed_files(metadata.read_text("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{str(metadata)!r} cannot be read: {error}", path=str(metadata)) from error
    except ValueError as error:
        text = f"the bag of {str(metadata)!r} cannot be read: {error}"
        raise RecordingError(text, path=str(metadata)) from error
    files = [folder / PurePosixPath(name).name for name in names]
    if missing := [str(file) for file in files if not file.exists()]:
        text = f"{str(metadata)!r} names files that are not there: {', '.join(missing)}"
        raise RecordingError(text, path=str(metadata))
    return files


def _numbered_files(folder: Path) -> list[Path]:
    """The files of a bag without metadata.yaml, as a killed ``ros2 bag record`` leaves it."""
    try:
        files = [file for file in folder.iterdir() if file.suffix in FORMATS]
    except OSError as error:
        raise RecordingError(f"{str(folder)!r} cannot be read: {error.strerror}", path=str(folder)) from error
    kinds = {(re.sub(r"_\d+$", "", file.stem), file.suffix) for file in files}
    if len(kinds) == 1:
        # By the numbers at the ends of their names, so that 10 follows 9.
        numbers = {file: re.search(r"_(\d+)$", file.stem) for file in files}
        return sorted(files, key=lambda file: (int(n[1]) if (n := numbers[file]) else -1, file.name))
    found = "no .mcap or .db3 file" if not kinds else f"files of {len(kinds)} recordings"
    text = f"the folder {str(folder)!r} holds no {METADATA} and {found}; name a recording's file"
    raise RecordingError(text, path=str(folder))


def _listed_files(text: str) -> list[str]:
    """The files that a metadata.yaml lists. Raises ValueError if they cannot be read."""
    keys = _keys(_keys(_yaml_node(text), "it").get(_TOP), f"its {_TOP!r}")

    def word(key: str) -> str:
        return _scalar(keys.get(key), f"its {key!r}")

    version, storage = word("version"), word("storage_identifier")
    if not version.isdecimal() or not 1 <= int(version) <= _NEWEST:
        raise ValueError(f"its version is {version!r}, and 1 to {_NEWEST} are known")
    if storage not in FORMATS.values():
        raise ValueError(f"its storage is {storage!r}, and 'mcap' and 'sqlite3' are known")
    mode = word("compression_mode").lower() if "compression_mode" in keys else ""
    if mode not in {"", "none"}:
        raise ValueError(
            f"it is compressed by {mode}, on top of its storage; `ros2 bag convert` writes it "
            "without (a .zstd file alone: `zstd -d`)"
        )
    paths: Any = keys.get("relative_file_paths")
    if getattr(paths, "id", "") != "sequence" or not paths.value:
        raise ValueError("it has no list 'relative_file_paths'")
    return [_scalar(path, "a path in its 'relative_file_paths'") for path in paths.value]


def _yaml_node(text: str) -> Any:
    """The root node of the one document in ``text``; None if it is empty."""
    import yaml  # noqa: PLC0415 - only bags need it

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    library: Any = yaml
    try:
        depth = 0
        for event in library.parse(text, loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH:
                raise ValueError(f"its YAML is nested more than {_MAX_DEPTH} deep")
        return library.compose(text, loader)
    except yaml.YAMLError as error:
        raise ValueError(f"it is not YAML: {' '.join(str(error).split())}") from None


def _keys(node: Any, what: str) -> dict[str, Any]:
    """The values of a mapping's node by their keys. Raises ValueError for another node."""
    if getattr(node, "id", "") != "mapping":
        raise ValueError(f"{what} is not a mapping; a bag's metadata is one with the key {_TOP!r}")
    keys: dict[str, Any] = {}
    for key, value in node.value:
        name = _scalar(key, "a key")
        if name in keys:
            raise ValueError(f"it has the key {name!r} twice")
        keys[name] = value
    return keys


def _scalar(node: Any, what: str) -> str:
    if getattr(node, "id", "") != "scalar":
        raise ValueError(f"{what} is not one word")
    return node.value
