"""Export of a stream of a plugin as a table, in the order of recording; and as files of points.

A message is one row; one of a stream with ``columns`` (``zstate.streams``) is several, with these in place of
its fields.

===========  =========================================================================================
column       content
===========  =========================================================================================
``stamp``    nanoseconds, int64
``robot``    its name
``writer``   the name of the writer, empty on a stream without names
each field   a number or a text, also an optional one (NaN, or an empty text, without a value); others
             are in JSON
===========  =========================================================================================

A file of points is PLY (Turk, "The PLY polygon file format", 1994), binary, with the columns of one message
that PLY has types for, as the properties of its vertices.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from zstate._util.lazy_names import loaded
from zstate._util.refusals import Refusals
from zstate.errors import InvalidInput
from zstate.recording.decode import DecodedMessage
from zstate.recording.errors import RecordingError
from zstate.recording.export import TableFormat, new_table
from zstate.recording.recording import Recording
from zstate.stream_registry import stream_named
from zstate.streams import StreamName
from zstate.wire.json_form import json_text
from zstate.wire.keys import full_name
from zstate.wire.messages import Message, StampedMessage

_ROWS = 4096
"""Rows written together."""

_NUMBERS: dict[Any, type[Any]] = {float: np.float64, float | None: np.float64, int: np.int64, bool: np.bool_}
_PLY_TYPES = {
    **{"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"},
    **{"f4": "float", "f8": "double"},
}


def export_stream(
    recording: Recording,
    stream: StreamName,
    path: Path,
    kind: TableFormat,
    *,
    frame: str | None = None,
    overwrite: bool = False,
) -> tuple[int, Mapping[str, int]]:
    """Write the messages of ``stream``; returns the number of rows, and of messages left out, by reason.

    With ``frame`` points are placed in it, as ``_placed_in`` does. The file appears when it is complete.
    Raises RecordingError and LibraryMissing as ``new_table`` does, and InvalidInput as
    ``Recording.measurements`` does, for messages with blocks of numbers, without a message, and for an
    integer beyond 64 bits.
    """
    refusals = Refusals(f"recorded {stream}")
    messages = recording.measurements(stream, refuse=refusals.count)
    tables = _tables_of_rows(messages, stream)
    if stream_named(stream).columns:
        found = _placed_in(frame, recording, _tables(messages, stream, refusals), refusals)
        tables = (_with_writer(decoded, columns) for decoded, columns in found)
    elif frame is not None:
        raise InvalidInput(f"the messages of {stream!r} are no points, and have no place in {frame!r}")
    count, names = 0, list[str]()
    with new_table(path, kind, recording, overwrite=overwrite) as table:
        for columns in tables:
            if names and list(columns) != names:
                raise InvalidInput(
                    f"the messages of {stream!r} have the columns {', '.join(names)} and later "
                    f"{', '.join(columns)}, and a table has one set; export one robot, or record one sensor"
                )
            names = list(columns)
            table.write(columns)
            count += len(columns["stamp"])
        _check_has_any(count, stream, refusals)
    return count, refusals.counts


def export_points(
    recording: Recording,
    stream: StreamName,
    folder: Path,
    *,
    frame: str | None = None,
    overwrite: bool = False,
) -> tuple[int, Mapping[str, int]]:
    """Write each message of ``stream`` into a file of ``folder``, ROBOT.WRITER.STAMP.ply; returns as above.

    Raises RecordingError if the folder exists (unless ``overwrite``) or cannot be written, and InvalidInput
    for a stream whose messages are no points, and without a message.
    """
    if not stream_named(stream).columns:
        raise InvalidInput(f"the messages of {stream!r} are no points: export them with --csv or --parquet")
    refusals = Refusals(f"recorded {stream}")
    messages = recording.measurements(stream, refuse=refusals.count)
    count = 0
    try:
        folder.mkdir(parents=True, exist_ok=overwrite)
        tables = _placed_in(frame, recording, _tables(messages, stream, refusals), refusals)
        for decoded, columns in tables:
            stamp = getattr(decoded.message, "stamp")  # noqa: B009 - of measurements
            name = f"{decoded.writer.robot}.{decoded.writer.edge_writer or stream}.{stamp}.ply"
            write_ply(folder / name, columns)
            count += 1
    except FileExistsError as error:
        text = f"{str(folder)!r} exists; choose another name, or pass overwrite=True"
        raise RecordingError(text, path=str(folder)) from error
    except OSError as error:
        text = f"{str(folder)!r} cannot be written: {error.strerror or error}"
        raise RecordingError(text, path=str(folder)) from error
    _check_has_any(count, stream, refusals)
    return count, refusals.counts


def write_ply(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write points with ``columns`` into a file; columns of types that PLY does not have are left out."""
    kept = {name: column for name, column in columns.items() if column.dtype.str[1:] in _PLY_TYPES}
    count = len(next(iter(columns.values())))
    points = np.zeros(count, [(name, f"<{column.dtype.str[1:]}") for name, column in kept.items()])
    for name, column in kept.items():
        points[name] = column
    properties = (f"property {_PLY_TYPES[column.dtype.str[1:]]} {name}" for name, column in kept.items())
    header = ("ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header")
    path.write_bytes("".join(f"{line}\n" for line in header).encode() + points.tobytes())


def _tables(
    messages: Iterable[DecodedMessage], stream: StreamName, refusals: Refusals
) -> Iterator[tuple[DecodedMessage, dict[str, NDArray[Any]]]]:
    """Each message with its columns, without those that have none."""
    make = loaded(stream_named(stream).columns)
    for decoded in messages:
        try:
            yield decoded, make(decoded.message, decoded.writer.robot)
        except InvalidInput as error:
            refusals.count("malformed", str(error))


def _placed_in(
    frame: str | None,
    recording: Recording,
    tables: Iterator[tuple[DecodedMessage, dict[str, NDArray[Any]]]],
    refusals: Refusals,
) -> Iterator[tuple[DecodedMessage, dict[str, NDArray[Any]]]]:
    """``tables`` with x, y, z in ``frame``, each point by the pose of its sensor at its own stamp.

    A point without a pose then is NaN; a cloud of such points only is left out. Without ``frame`` they are as
    measured. Raises LookupFailed for a frame without a path to that of the sensor.
    """
    buffer = None if frame is None else recording.buffer()
    for decoded, columns in tables:
        if frame is not None and buffer is not None:
            own: str = getattr(decoded.message, "frame")  # noqa: B009 - of points
            points = np.stack([columns[name] for name in "xyz"], axis=-1)
            source = full_name(decoded.writer.robot, own)
            placed, valid = buffer.place(points, columns["stamp"], source, frame)
            if not valid.any():
                refusals.count("no pose", f"{source!r} has no pose in {frame!r} at the stamps of a cloud")
                continue
            columns |= dict(zip("xyz", placed.T, strict=True))
        yield decoded, columns


def _with_writer(decoded: DecodedMessage, columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """``columns`` with those of robot and writer behind the stamps."""
    count = len(columns["stamp"])
    writer = decoded.writer
    names = {"robot": writer.robot, "writer": writer.edge_writer or ""}
    return {
        "stamp": columns["stamp"],
        **{name: np.full(count, text, object) for name, text in names.items()},
        **{name: column for name, column in columns.items() if name != "stamp"},
    }


def _tables_of_rows(
    messages: Iterator[DecodedMessage], stream: StreamName
) -> Iterator[dict[str, NDArray[Any]]]:
    """The columns of many messages, a row each."""
    hints = get_type_hints(stream_named(stream).type)
    if blocks := [name for name, hint in hints.items() if hint in (bytes, bytes | None)]:
        raise InvalidInput(
            f"{stream!r} has no columns: {', '.join(blocks)} of its messages are blocks of numbers; read "
            "them with zstate.Recording"
        )
    while batch := list(islice(messages, _ROWS)):
        yield _columns(batch, hints)


def _check_has_any(count: int, stream: StreamName, refusals: Refusals) -> None:
    if not count:
        reasons = ", ".join(f"{reason} {number}" for reason, number in refusals.counts.items())
        raise InvalidInput(f"no message of {stream!r} can be used: {reasons or 'there is none'}")


def _columns(batch: Sequence[DecodedMessage], hints: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    messages = [decoded.message for decoded in batch if isinstance(decoded.message, StampedMessage)]
    writers = [decoded.writer for decoded in batch]
    columns: dict[str, NDArray[Any]] = {
        "stamp": np.array([message.stamp for message in messages], np.int64),
        "robot": np.array([writer.robot for writer in writers], object),
        "writer": np.array([writer.edge_writer or "" for writer in writers], object),
    }
    for name in messages[0].__struct_fields__[len(StampedMessage.__struct_fields__) :]:
        column = name if name not in columns else f"message.{name}"
        columns[column] = _column(name, [getattr(message, name) for message in messages], hints[name])
    return columns


def plain_columns(messages: Sequence[Message]) -> dict[str, NDArray[Any]]:
    """The fields of ``messages`` of one class that are numbers or texts, but stamp and number, as columns."""
    hints = get_type_hints(type(messages[0]))
    head = StampedMessage.__struct_fields__
    plain = [name for name in messages[0].__struct_fields__ if name not in head and _is_plain(hints[name])]
    return {name: _column(name, [getattr(one, name) for one in messages], hints[name]) for name in plain}


def _is_plain(hint: Any) -> bool:
    return hint in _NUMBERS or hint in (str, str | None)


def _column(name: str, values: Sequence[Any], hint: Any) -> NDArray[Any]:
    if hint in _NUMBERS:
        try:
            return np.array([math.nan if value is None else value for value in values], _NUMBERS[hint])
        except OverflowError:
            raise InvalidInput(f"the field {name!r} has integers beyond 64 bits") from None
    if hint in (str, str | None):
        return np.array([value or "" for value in values], object)
    return np.array([json_text(value) for value in values], object)
