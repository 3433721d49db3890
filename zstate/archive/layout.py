"""Layout of an archive: plain Parquet, which other programs read without zstate.

=============================================  =======================================================
folder                                         a row
=============================================  =======================================================
``stream=joint_states/robot=R/date=D/``        a sample: ``stamp``, ``position.NAME``, ``velocity.NAME``,
                                               ``effort.NAME``, as `zstate export` names them
``stream=partial_joint_states/robot=R/...``    the same of drivers of some joints, a file for each
``stream=transforms/robot=R/date=D/``          a sample of a moving edge: ``stamp``, ``parent``, ``child``,
                                               ``x`` ``y`` ``z`` ``qx`` ``qy`` ``qz`` ``qw``, ``covariance``
``stream=STREAM/robot=R/date=D/``              a message of another stream: ``stamp``, ``log_time``, its
                                               ``number`` in the recording, ``name`` of its writer,
                                               ``encoding``, ``message``, and ``field.NAME`` of those of
                                               its fields that are numbers or texts
``frames/robot=R/``                            a static edge (``kind`` "static"), the model of the robot
                                               ("model"), or a joint of a driver of some ("part")
``writers/robot=R/``                           a writer of a recording, and the number of its messages
``models/``                                    a model by its ``digest``, with its ``urdf``
``imports/``                                   a file that the import of a recording has added
``compacted/``                                 the same of many imports (``zstate.archive.ledger``)
=============================================  =======================================================

``date`` is the UTC date of the stamps. Rows are sorted by stamp [ns]; those of messages within row groups. A
file of samples has one edge, or the joints of one writer, of one recording, and is named
``IMPORT.DIGEST.parquet``: by the digest of the recording, and that of its own bytes. It counts once
``imports/IMPORT.parquet`` lists it, which is written last. ``compacted-N.DIGEST.parquet`` has the samples of
several recordings, one after the other. ``message`` is the payload of the native wire (docs/wire.md), of the
type in ``encoding``. The metadata of each file have the version of this layout.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from zstate.archive.storage import arrow, file_digest
from zstate.recording.errors import RecordingError

VERSION = 1
"""Of the layout. Columns may be added within a version."""

VERSION_KEY = b"zstate.archive"
KEY = b"zstate.key"
"""Metadata key of what a file of samples is of: the child of an edge, or the names of a driver's joints."""

IMPORTS, COMPACTED, MODELS, FRAMES, WRITERS = TABLES = (
    *("imports/", "compacted/", "models/", "frames/", "writers/"),
)
JOINTS, PARTS, EDGES = "joint_states", "partial_joint_states", "transforms"
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
SUFFIX = ".parquet"

_GROUP_VALUES = 1_000_000
"""Numbers of a row group: less make larger footers, more make windows slower to read."""

_GROUP_BYTES = 32_000_000
_GROUPS_PER_FILE = 64

_TINY_BYTES = 4096
"""Of a table whose columns are read sooner than they are decompressed, and are no smaller compressed."""

_DAY_NS = 86_400 * 10**9
_FEW = 4
"""A column with one distinct number for each so many rows is encoded with a dictionary."""


def folder_of(stream: str, robot: str = "", day: str = "") -> str:
    """The folder of a stream, of one robot, at one date; or of one of ``TABLES``."""
    parts = [
        stream.rstrip("/") if stream in TABLES else f"stream={stream}",
        robot and f"robot={quote(robot, safe='')}",
        day and f"date={day}",
    ]
    return "/".join(filter(None, parts))


def value_of(folder: str) -> str:
    """``VALUE`` of a folder's name ``KEY=VALUE``."""
    return unquote(folder.partition("=")[2])


def date_of(stamp: int) -> str:
    """The UTC date of a stamp [ns]."""
    return str(date.fromordinal(date(1970, 1, 1).toordinal() + stamp // _DAY_NS))


def first_stamp_of(day: str) -> int:
    """The first stamp [ns] of a UTC date. Raises ValueError for a text that is none."""
    return round(datetime.fromisoformat(day).replace(tzinfo=UTC).timestamp()) * 10**9


def cuts_by_date(stamps: NDArray[np.int64]) -> list[tuple[str, slice]]:
    """The dates of ascending ``stamps``, and their rows."""
    days = stamps // _DAY_NS
    starts = [0, *(np.flatnonzero(np.diff(days)) + 1).tolist()]
    ends = [*starts[1:], len(stamps)]
    return [(date_of(int(stamps[one])), slice(one, end)) for one, end in zip(starts, ends, strict=True)]


@cache
def record_schema() -> Any:
    """The columns of ``imports`` and ``compacted``: ``columns`` are those of the file, with their types."""
    pa = arrow()
    texts = ("import", "path", "stream", "robot", "date", "key", "columns")
    numbers = ("rows", "bytes", "first", "last", "groups")
    return pa.schema(
        [
            *((name, pa.string()) for name in texts),
            *((name, pa.int64()) for name in numbers),
            ("frames", pa.string()),
            ("recording", pa.string()),
            ("recorded", pa.int64()),
            ("imported", pa.int64()),
        ],
        metadata={VERSION_KEY: str(VERSION).encode()},
    )


@cache
def frames_schema() -> Any:
    """The columns of ``frames``."""
    pa = arrow()
    texts = ("kind", "parent", "child", "writer", "model")
    columns = [*((name, pa.string()) for name in texts), *((name, pa.float64()) for name in POSE)]
    return pa.schema(columns, metadata={VERSION_KEY: str(VERSION).encode()})


@cache
def model_schema() -> Any:
    """The columns of ``models``."""
    pa = arrow()
    columns = [(name, pa.string()) for name in ("digest", "name", "urdf")]
    return pa.schema(columns, metadata={VERSION_KEY: str(VERSION).encode()})


@cache
def writers_schema() -> Any:
    """The columns of ``writers``."""
    pa = arrow()
    texts = [(name, pa.string()) for name in ("import", "stream", "name", "program")]
    columns = [*texts, ("session", pa.string()), ("messages", pa.int64())]
    return pa.schema(columns, metadata={VERSION_KEY: str(VERSION).encode()})


def check_version(metadata: Mapping[bytes, bytes] | None, where: str) -> None:
    """Raise RecordingError for a file of another program, or of a later version of the layout."""
    text = (metadata or {}).get(VERSION_KEY, b"").decode("utf-8", "replace")
    if not text.isdecimal():
        raise RecordingError(f"{where!r} is not a file of an archive of zstate; move it away", path=where)
    if int(text) > VERSION:
        raise RecordingError(
            f"{where!r} has version {text} of the layout of archives, and this zstate reads up to {VERSION}: "
            "pip install -U zstate",
            path=where,
        )


class WrittenFile(NamedTuple):
    """A file of samples that is ready: where it is, what the import lists of it."""

    staged: Path
    stream: str
    robot: str
    date: str
    key: str
    rows: int
    first: int
    last: int
    groups: int
    columns: str
    digest: str


class TableFile:
    """One file with rows of one date, written row group by row group."""

    def __init__(self, path: Path, stream: str, robot: str, day: str, key: str) -> None:
        self.path = path
        self._head = path, stream, robot, day, key
        self._writer: Any = None
        self._pending: list[Any] = []
        self._pending_rows = self._pending_bytes = self._groups = self._rows = 0
        self._first, self._last = (1 << 63) - 1, -(1 << 63)
        self._columns = ""

    @property
    def is_full(self) -> bool:
        """Whether the next rows belong into another file."""
        return self._groups >= _GROUPS_PER_FILE

    def write(self, table: Any) -> None:
        """Append the rows of a pyarrow.Table with the column ``stamp``."""
        stamps = table.column("stamp").to_numpy()
        self._first, self._last = min(self._first, int(stamps.min())), max(self._last, int(stamps.max()))
        self._rows += len(stamps)
        self._pending.append(table)
        self._pending_rows += table.num_rows
        self._pending_bytes += table.nbytes
        per_group = _rows_per_group(table.num_columns)
        if self._pending_rows >= per_group or self._pending_bytes >= _GROUP_BYTES:
            self._write_groups(per_group)

    def _write_groups(self, per_group: int) -> None:
        table = arrow().concat_tables(self._pending)
        self._pending, self._pending_rows, self._pending_bytes = [], 0, 0
        if "message" in table.column_names:
            table = table.sort_by([("stamp", "ascending"), ("number", "ascending")])
        writer = self._opened(table)
        writer.write_table(table, row_group_size=per_group)
        self._groups += -(-table.num_rows // per_group)

    def _opened(self, table: Any) -> Any:
        if self._writer is None:
            key = self._head[-1]
            metadata = {VERSION_KEY: str(VERSION).encode(), KEY: key.encode()}
            dictionary, encodings = _encodings(table)
            self._columns = json.dumps({field.name: str(field.type) for field in table.schema})
            self._writer = arrow().parquet.ParquetWriter(
                self.path,
                table.schema.with_metadata(metadata),
                compression="zstd",
                use_dictionary=dictionary,
                column_encoding=encodings,
                write_page_checksum=True,
            )
        return self._writer

    def finish(self) -> WrittenFile:
        """Close the file."""
        if self._pending:
            self._write_groups(self._pending_rows)
        self._writer.close()
        facts = self._rows, self._first, self._last, self._groups, self._columns
        return WrittenFile(*self._head, *facts, file_digest([self.path]))

    def abandon(self) -> None:
        """Remove the file."""
        if self._writer is not None:
            self._writer.close()
            self.path.unlink()


def _rows_per_group(columns: int) -> int:
    return max(1024, _GROUP_VALUES // columns)


def _encodings(table: Any) -> tuple[list[str], dict[str, str]]:
    """The columns with a dictionary, and the encodings of the others, by the numbers of the first row group.

    Integers are stored as differences. Numbers of which few are distinct, such as the steps of an encoder,
    and texts have a dictionary; of all others, the bytes of one significance stand together.
    """
    types = arrow().types
    dictionary: list[str] = []
    encodings: dict[str, str] = {}
    for field, column in zip(table.schema, table.columns, strict=True):
        if types.is_integer(field.type):
            encodings[field.name] = "DELTA_BINARY_PACKED"
        elif types.is_floating(field.type):
            if len(column.unique()) * _FEW <= len(column):
                dictionary.append(field.name)
            else:
                encodings[field.name] = "BYTE_STREAM_SPLIT"
        elif types.is_string(field.type):
            dictionary.append(field.name)
    return dictionary, encodings


def write_small(
    path: Path, schema: Any, rows: Sequence[Mapping[str, object]], per_group: int | None = None
) -> None:
    """Write a table that fits into memory, with so many rows in a row group."""
    pa = arrow()
    table = pa.Table.from_pylist(list(rows), schema=schema)
    compression = "zstd" if table.nbytes > _TINY_BYTES else "none"
    pa.parquet.write_table(table, path, per_group, compression=compression, write_page_checksum=True)
