"""Rebuilds the index of an MCAP file by reading all of it.

For files without a summary, as a killed recorder leaves them, and for damaged ones. The scan leaves out
unreadable bytes, reports them in ``losses``, and continues at the next whole chunk.
"""

from __future__ import annotations

import re
from collections import Counter
from contextlib import suppress

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Metadata, Schema

from zstate.recording.mcap.index import (
    DataLoss,
    DataRange,
    Index,
    RecordContents,
    Summary,
    read_footer,
    read_header,
)
from zstate.recording.mcap.records import (
    FIRST_PRIVATE_OPCODE,
    HEAD,
    BoundedFile,
    CorruptData,
    check_message_index,
    decompress,
    parse_chunk,
    parse_record,
)

_BARE = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_BARE_RANGE = 1 << 20  # bytes of messages outside of chunks that are read at once

# A chunk's compression as it stands in the file, behind the record's head and 28 bytes of numbers.
_SIGNATURE = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_BEFORE_SIGNATURE = HEAD.size + 28
_WINDOW = 1 << 22
_OVERLAP = 8


class Scan:
    """Contents of a file: its rebuilt ``index``, ``metadata`` and ``attachments``.

    Raises CorruptData if not even its header can be read.
    """

    def __init__(self, file: BoundedFile) -> None:
        self._file = file
        header, at = read_header(file)
        self._end = file.size
        self._summary: Summary | None = None
        with suppress(CorruptData):
            self._summary = Summary(file)
            self._end = self._summary.start
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._ranges: list[DataRange] = []
        self._losses: list[DataLoss] = []
        self._has_data_end = False
        self.metadata: list[Metadata] = []
        self.attachments: list[Attachment] = []
        self._bare_start: int | None = None
        while at < self._end and not self._has_data_end:
            at = self._step(at)
        self._add_bare_range(at)
        schemas, channels = self._schemas, self._channels
        if self._summary is not None:  # its copy describes the channels whose chunk is lost
            schemas = {**self._summary.contents.schemas, **schemas}
            channels = {**self._summary.contents.channels, **channels}
        for number, count in self._counts.items():
            if number not in channels:
                reason = f"{count} messages of channel {number}, whose description is lost"
                self._losses.append(DataLoss(self._ranges[0].offset, 0, reason))
        counts = {number: count for number, count in self._counts.items() if number in channels}
        ranges = tuple(one for one in self._ranges if one.channels)
        span = (min(one.first for one in ranges), max(one.last for one in ranges)) if ranges else None
        complete = False
        if self._has_data_end and not self._losses:
            with suppress(CorruptData):
                read_footer(file)
                complete = True
        losses = tuple(self._losses)
        self.index = Index(header, schemas, channels, counts, span, ranges, complete, losses)

    def _step(self, at: int) -> int:
        """Read the record at ``at``; the offset to continue at."""
        end: int | None = None
        opcode = 0
        try:
            opcode, stated = self._file.record_head(at)
            end = stated if stated <= self._end else None
            self._add_record(opcode, at, end)
        except CorruptData as damage:
            self._add_bare_range(at)
            return self._resume(at, opcode, end, str(damage))
        return stated

    def _add_record(self, opcode: int, at: int, end: int | None) -> None:
        if end is None:
            is_cut = self._summary is None
            raise CorruptData("the file is cut off there" if is_cut else "a record's length is wrong")
        if opcode == Opcode.DATA_END and self._summary is not None and end < self._end:
            raise CorruptData("a DataEnd record with more data behind it")
        if opcode in _BARE:
            self._bare_start = at if self._bare_start is None else self._bare_start
            if end - self._bare_start >= _BARE_RANGE:
                self._add_bare_range(end)
            return
        self._add_bare_range(at)
        body = self._file.body(at, end)
        if opcode == Opcode.DATA_END:
            parse_record(DataEnd, body)
            self._has_data_end = True
        elif opcode == Opcode.CHUNK:
            chunk = parse_chunk(body)
            self._add(DataRange("chunk", at, end, compression=chunk.compression), decompress(chunk))
        elif opcode == Opcode.METADATA:
            self.metadata.append(parse_record(Metadata, body))
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.append(parse_record(Attachment, body))
        elif opcode == Opcode.MESSAGE_INDEX:
            check_message_index(body)
        elif opcode < FIRST_PRIVATE_OPCODE:
            raise CorruptData(f"no record begins with the byte {opcode}")

    def _add_bare_range(self, end: int) -> None:
        """Add the records outside of chunks that end here as one range."""
        if self._bare_start is None:
            return
        start, self._bare_start = self._bare_start, None
        try:
            self._add(DataRange("bare", start, end), self._file.read(start, end - start))
        except CorruptData as damage:
            self._losses.append(DataLoss(start, end - start, str(damage)))

    def _add(self, data_range: DataRange, data: bytes) -> None:
        contents = RecordContents(data)
        for number, schema in contents.schemas.items():
            self._schemas.setdefault(number, schema)
        for number, channel in contents.channels.items():
            self._channels.setdefault(number, channel)
        self._counts += contents.counts
        times = {"first": contents.first, "last": contents.last}
        self._ranges.append(data_range._replace(**times, channels=frozenset(contents.counts)))

    def _resume(self, at: int, opcode: int, end: int | None, reason: str) -> int:
        """The offset to continue at after damage at ``at``, in a record that ends at ``end`` if known."""
        found = _next_chunk(self._file, at + 1, self._end if end is None else end) or end
        if found is None and opcode == Opcode.CHUNK:
            # The file ends within this chunk; its beginning may be readable.
            before = self._counts.total()
            cut = DataRange("cut chunk", at, self._end)
            with suppress(CorruptData):
                self._add(cut, cut.content(self._file))
            reason = f"{reason}, but for {self._counts.total() - before} messages"
        next_at = self._end if found is None else found
        self._losses.append(DataLoss(at, next_at - at, reason))
        return next_at


def _next_chunk(file: BoundedFile, start: int, stop: int) -> int | None:
    """Offset of the first whole compressed chunk that begins in [start, stop), found by its compression."""
    at = start
    while at < stop:
        window = file.read(at, min(_WINDOW, file.size - at))
        for match in _SIGNATURE.finditer(window):
            candidate = at + match.start() - _BEFORE_SIGNATURE
            if start <= candidate < stop:
                with suppress(CorruptData):
                    opcode, body = file.record(candidate)
                    if opcode == Opcode.CHUNK:
                        decompress(parse_chunk(body))
                        return candidate
        at += _WINDOW - _OVERLAP
    return None
