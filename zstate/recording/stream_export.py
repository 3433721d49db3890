"""Export of a stream of a plugin as a table, one row for each message, in the order of recording.

===========  =========================================================================================
column       content
===========  =========================================================================================
``stamp``    nanoseconds, int64
``robot``    its name
``writer``   the name of the writer, empty on a stream without names
each field   a number or a text, also an optional one (NaN, or an empty text, without a value); others
             are in JSON
===========  =========================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from zstate._util.refusals import Refusals
from zstate.errors import InvalidInput
from zstate.plugins import stream_named
from zstate.recording.decode import DecodedMessage
from zstate.recording.export import TableFormat, new_table
from zstate.recording.recording import Recording
from zstate.streams import StreamName
from zstate.wire.json_form import json_text
from zstate.wire.messages import StampedMessage

_ROWS = 4096
"""Rows written together."""

_NUMBERS: dict[Any, type[Any]] = {float: np.float64, float | None: np.float64, int: np.int64, bool: np.bool_}


def export_stream(
    recording: Recording, stream: StreamName, path: Path, kind: TableFormat, *, overwrite: bool = False
) -> tuple[int, Mapping[str, int]]:
    """Write the messages of ``stream``; the number of rows, and of messages left out, by reason.

    The file appears when it is complete. Raises RecordingError and LibraryMissing as ``new_table`` does, and
    InvalidInput as ``Recording.measurements`` does, for messages with blocks of numbers, without a message,
    and for an integer beyond 64 bits.
    """
    refusals = Refusals(f"recorded {stream}")
    messages = recording.measurements(stream, refuse=refusals.count)
    hints = get_type_hints(stream_named(stream).type)
    if blocks := [name for name, hint in hints.items() if hint in (bytes, bytes | None)]:
        raise InvalidInput(
            f"{stream!r} has no columns: {', '.join(blocks)} of its messages are blocks of numbers; read "
            "them with zstate.Recording"
        )
    rows = 0
    with new_table(path, kind, recording, overwrite=overwrite) as table:
        while batch := list(islice(messages, _ROWS)):
            table.write(_columns(batch, hints))
            rows += len(batch)
        if not rows:
            reasons = ", ".join(f"{reason} {count}" for reason, count in refusals.counts.items())
            raise InvalidInput(f"no message of {stream!r} can be used: {reasons or 'there is none'}")
    return rows, refusals.counts


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


def _column(name: str, values: Sequence[Any], hint: Any) -> NDArray[Any]:
    if hint in _NUMBERS:
        try:
            return np.array([math.nan if value is None else value for value in values], _NUMBERS[hint])
        except OverflowError:
            raise InvalidInput(f"the field {name!r} has integers beyond 64 bits") from None
    if hint in (str, str | None):
        return np.array([value or "" for value in values], object)
    return np.array([json_text(value) for value in values], object)
