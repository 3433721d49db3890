"""The storage "sqlite3": one .db3 file of a rosbag2 recording."""

from __future__ import annotations

import sqlite3
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from zstate.errors import RecordingError
from zstate.recording.storage import Channel, Format, ReadFilter, Record, SortedPart

_OPTIONAL = {"offered_qos_profiles": "offered_qos_profiles", "type_description_hash": "topic_type_hash"}
# A row takes more than four bytes and less than fifty steps of SQLite's virtual machine.
_STEPS, _STEPS_PER_BYTE = 100_000_000, 16
_STEPS_BETWEEN = 100_000
_STAMPS = (-(1 << 63), (1 << 63) - 1)


class SqliteFile:
    """A .db3 file, opened read-only; log and publish times are the same."""

    format: Format = "sqlite3"
    profile = "ros2"
    library = ""
    complete = True
    compressions: tuple[str, ...] = ()
    losses: tuple[str, ...] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = self._steps = 0
        with self._errors():
            self.size = path.stat().st_size
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
        except sqlite3.OperationalError as error:
            if "interrupted" in str(error) and self._steps <= self._max_steps:
                raise KeyboardInterrupt from None  # SQLite drops exceptions that signals raise in the handler
            raise self._unreadable(error) from error
        except (sqlite3.Error, OSError, ValueError, TypeError, OverflowError) as error:
            raise self._unreadable(error) from error

    def _unreadable(self, error: Exception) -> RecordingError:
        reason = str(error)
        if self._steps > self._max_steps:
            reason = f"a query took more than {self._max_steps} steps, too many for {self.size} bytes"
        text = (
            f"{str(self.path)!r} cannot be read as a rosbag2 database: {reason}; if it is damaged, "
            "`sqlite3 FILE .recover` may save a part of it"
        )
        return RecordingError(text, path=str(self.path))

    @property
    def _max_steps(self) -> int:
        return _STEPS + _STEPS_PER_BYTE * self.size

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
