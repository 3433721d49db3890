"""An index: what is in an MCAP file, and where."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

from mcap.records import Channel, Header, Schema

from zstate.record.blocks import HEAD, Damaged, chunk, content, content_so_far
from zstate.record.byte_file import ByteFile


class Piece(NamedTuple):
    """A stretch of the file that holds messages: a chunk, a chunk that is cut off, or bare records.

    ``first`` and ``last`` are log times, both inclusive. ``channels`` are the numbers of those that
    occur, None where only reading tells.
    """

    kind: Literal["chunk", "cut chunk", "bare"]
    offset: int
    end: int
    first: int
    last: int
    channels: frozenset[int] | None
    compression: str

    def content(self, file: ByteFile) -> bytes:
        """Its records, without compression. Damaged where they are not whole."""
        if self.kind == "bare":
            return file.at(self.offset, self.end - self.offset)
        body = file.at(self.offset + HEAD.size, self.end - self.offset - HEAD.size)
        if self.kind == "chunk":
            try:
                return content(chunk(body))
            except Damaged as damage:
                raise Damaged(f"at byte {self.offset} there is {damage}") from damage
        return content_so_far(chunk(body, whole=False))


class Loss(NamedTuple):
    """Bytes of a file that cannot be read, and why."""

    offset: int
    length: int
    reason: str

    def __str__(self) -> str:
        return f"{self.length} bytes at {self.offset}: {self.reason}"


@dataclass(frozen=True)
class Index:
    """What an MCAP file holds. ``schemas``, ``channels`` and ``counts`` go by the file's numbers.

    ``span`` is the first and the last log time, None where there is no message. ``complete`` says that
    its writer closed it and that nothing of it is lost.
    """

    header: Header
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    counts: Mapping[int, int]
    span: tuple[int, int] | None
    pieces: tuple[Piece, ...]
    complete: bool
    losses: tuple[Loss, ...] = ()
