"""The scan: what an MCAP file holds, found by walking through all of it.

For files without a summary, as a killed recorder leaves them, and for damaged ones. The walk leaves out
what it cannot read, says so in ``losses``, and goes on at the next chunk.
"""

from __future__ import annotations

from collections import Counter
from contextlib import suppress

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Metadata, Schema

from zstate.record.blocks import (
    FIRST_PRIVATE_OPCODE,
    Damaged,
    check_message_index,
    chunk,
    content,
    parsed,
)
from zstate.record.byte_file import ByteFile
from zstate.record.contents import Contents
from zstate.record.index import Index, Loss, Piece
from zstate.record.resync import next_chunk
from zstate.record.summary import Summary, footer_of, header_of

_BARE = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
_BARE_PIECE = 1 << 20  # bytes of messages outside of chunks that are read at once


class Scan:
    """What is in a file. Damaged when not even its header can be read."""

    def __init__(self, file: ByteFile) -> None:
        self._file = file
        self._header, at = header_of(file)
        self._end = file.size
        self._known = self._summary()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._pieces: list[Piece] = []
        self._losses: list[Loss] = []
        self._ended = False
        self.metadata: list[Metadata] = []
        self.attachments: list[Attachment] = []
        self._run: int | None = None
        while at < self._end and not self._ended:
            at = self._step(at)
        self._end_run(at)
        self._describe_the_lost()

    def _summary(self) -> Summary | None:
        try:
            known = Summary(self._file)
        except Damaged:
            return None
        self._end = known.start
        return known

    def index(self) -> Index:
        """What was found."""
        schemas, channels = self._schemas, self._channels
        counts = {number: count for number, count in self._counts.items() if number in channels}
        complete = self._ended and not self._losses and self._is_closed()
        held = [piece for piece in self._pieces if piece.channels]
        span = (min(piece.first for piece in held), max(piece.last for piece in held)) if held else None
        losses = tuple(self._losses)
        return Index(self._header, schemas, channels, counts, span, tuple(held), complete, losses)

    def _is_closed(self) -> bool:
        try:
            footer_of(self._file)
        except Damaged:
            return False
        return True

    def _step(self, at: int) -> int:
        """Take the record at ``at``; return where to go on."""
        end: int | None = None
        opcode = 0
        try:
            opcode, stated = self._file.head(at)
            end = self._within(stated)
            self._take(opcode, at, end)
        except Damaged as damage:
            self._end_run(at)
            return self._resume(at, opcode, end, str(damage))
        return end

    def _within(self, end: int) -> int:
        if end <= self._end:
            return end
        raise Damaged("the file is cut off there" if self._known is None else "a record's length is wrong")

    def _take(self, opcode: int, at: int, end: int) -> None:
        if opcode == Opcode.DATA_END and self._known is not None and end < self._end:
            raise Damaged("it says that the data ends, where more follows")
        if opcode in _BARE:
            self._run = at if self._run is None else self._run
            if end - self._run >= _BARE_PIECE:
                self._end_run(end)
            return
        self._end_run(at)
        if opcode == Opcode.DATA_END:
            parsed(DataEnd, self._file.body(at, end))
            self._ended = True
        elif opcode == Opcode.CHUNK:
            body = chunk(self._file.body(at, end))
            self._add(Piece("chunk", at, end, 0, 0, None, body.compression), content(body))
        else:
            self._take_other(opcode, self._file.body(at, end))

    def _take_other(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.METADATA:
            self.metadata.append(parsed(Metadata, body))
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.append(parsed(Attachment, body))
        elif opcode == Opcode.MESSAGE_INDEX:
            check_message_index(body)
        elif opcode < FIRST_PRIVATE_OPCODE:
            raise Damaged(f"no record begins with the byte {opcode}")

    def _end_run(self, end: int) -> None:
        """The records outside of chunks that end here are one piece."""
        if self._run is None:
            return
        start, self._run = self._run, None
        try:
            self._add(Piece("bare", start, end, 0, 0, None, ""), self._file.at(start, end - start))
        except Damaged as damage:
            self._losses.append(Loss(start, end - start, str(damage)))

    def _add(self, piece: Piece, data: bytes) -> None:
        held = Contents(data)
        for number, schema in held.schemas.items():
            self._schemas.setdefault(number, schema)
        for number, channel in held.channels.items():
            self._channels.setdefault(number, channel)
        self._counts += held.counts
        times = {"first": held.first, "last": held.last}
        self._pieces.append(piece._replace(**times, channels=frozenset(held.counts)))

    def _resume(self, at: int, opcode: int, end: int | None, reason: str) -> int:
        """Where to go on after damage at ``at``, in a record that ends at ``end`` if that is known."""
        found = next_chunk(self._file, at + 1, self._end if end is None else end) or end
        if found is None and opcode == Opcode.CHUNK:
            reason = f"{reason}, but for {self._add_cut_chunk(at)} messages"
        going_on = self._end if found is None else found
        self._losses.append(Loss(at, going_on - at, reason))
        return going_on

    def _add_cut_chunk(self, at: int) -> int:
        """Add what can be had of the chunk in whose middle the file ends; say how many messages."""
        before = self._counts.total()
        piece = Piece("cut chunk", at, self._end, 0, 0, None, "")
        with suppress(Damaged):
            self._add(piece, piece.content(self._file))
        return self._counts.total() - before

    def _describe_the_lost(self) -> None:
        """Give channels and schemas whose chunk is lost the description that the summary repeats."""
        if self._known is not None:
            self._schemas = {**self._known.schemas, **self._schemas}
            self._channels = {**self._known.channels, **self._channels}
        for number, count in self._counts.items():
            if number not in self._channels:
                reason = f"{count} messages of channel {number}, whose description is lost"
                self._losses.append(Loss(self._pieces[0].offset, 0, reason))
