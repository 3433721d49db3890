"""Finding the next whole chunk in a damaged file, by the name of its compression."""

from __future__ import annotations

import re

from mcap.opcode import Opcode

from zstate.record.blocks import HEAD, Damaged, chunk, content
from zstate.record.byte_file import ByteFile

# A chunk's compression as it stands in the file, behind the record's head and 28 bytes of numbers.
_SIGNATURE = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")
_BEFORE_SIGNATURE = HEAD.size + 28
_WINDOW = 1 << 22
_OVERLAP = 8


def next_chunk(file: ByteFile, start: int, stop: int) -> int | None:
    """The offset of the first whole compressed chunk that begins at ``start`` or later, before ``stop``."""
    at = start
    while at < stop:
        window = file.at(at, min(_WINDOW, file.size - at))
        for match in _SIGNATURE.finditer(window):
            candidate = at + match.start() - _BEFORE_SIGNATURE
            if start <= candidate < stop and _is_chunk(file, candidate):
                return candidate
        at += _WINDOW - _OVERLAP
    return None


def _is_chunk(file: ByteFile, offset: int) -> bool:
    try:
        opcode, body = file.record(offset)
        if opcode == Opcode.CHUNK:
            content(chunk(body))
    except Damaged:
        return False
    return opcode == Opcode.CHUNK
