"""An open file as bytes at offsets; none of them beyond the size it had when it was opened."""

from __future__ import annotations

from pathlib import Path

from zstate.closing import Closing
from zstate.record.blocks import HEAD, MAGIC, Damaged


class ByteFile(Closing):
    """A file to read at offsets. What cannot be had raises Damaged, or OSError as Python does."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self.size = self._stream.seek(0, 2)

    def at(self, offset: int, length: int) -> bytes:
        """Exactly the bytes from ``offset`` on."""
        if offset + length > self.size:
            raise Damaged("the file ends within a record")
        self._stream.seek(offset)
        data = self._stream.read(length)
        if len(data) < length:
            raise Damaged("the file became shorter while it was read")
        return data

    def head(self, offset: int) -> tuple[int, int]:
        """Of the record at ``offset``: its opcode, and the offset at which it ends."""
        opcode, length = HEAD.unpack(self.at(offset, HEAD.size))
        return opcode, offset + HEAD.size + length

    def record(self, offset: int) -> tuple[int, bytes]:
        """Of the record at ``offset``: its opcode and its body."""
        opcode, end = self.head(offset)
        return opcode, self.body(offset, end)

    def body(self, offset: int, end: int) -> bytes:
        """The body of the record that stands between the two offsets."""
        return self.at(offset + HEAD.size, end - offset - HEAD.size)

    @property
    def starts_as_mcap(self) -> bool:
        return self.size >= len(MAGIC) and self.at(0, len(MAGIC)) == MAGIC

    def close(self) -> None:
        self._stream.close()
