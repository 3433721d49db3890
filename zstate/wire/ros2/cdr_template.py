"""Payloads that differ in nothing but their numbers: taken apart and put together at once.

From one sample to the next only stamps and numbers change, while names, counts and lengths stay. Once
a payload was read value by value, it is known where its numbers stand, and the next is rearranged in
one step: what is fixed to the front, to be recognised as a whole, the numbers behind it.
"""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from zstate.wire.ros2.cdr import HEADER_BYTES, LITTLE_ENDIAN, CdrReader

M = TypeVar("M")

# What is remembered, in bytes of payloads; in memory it takes about three times as much.
ROOM = 2**20
# What an entry takes beside its payload's length, about.
_ENTRY = 1024
# Beyond so many arrangements of one length, trying them costs as much as reading value by value.
_ALTERNATIVES = 8

# Times, doubles and everything behind a count start at a multiple of four bytes.
_WORD = np.dtype("<u4")
_WORD_BYTES = 4


class CdrTemplate:
    """Where the numbers stand in the payload that ``reader`` has read to the end."""

    def __init__(self, reader: CdrReader) -> None:
        self._count = reader.position // _WORD_BYTES
        words = np.arange(self._count)
        spans = [*reader.stamps, *reader.blocks]
        numbers = [words[start // _WORD_BYTES : end // _WORD_BYTES] for start, end in spans]
        fixed = np.delete(words, np.concatenate([words[:0], *numbers]))
        self._fixed_bytes = fixed.size * _WORD_BYTES
        self._order = np.concatenate([fixed, *numbers])
        self._places = np.argsort(self._order)
        self._mask = _meaningful(reader)[self._order]

    def split(self, payload: bytes) -> tuple[bytes, bytes]:
        """What is fixed in ``payload``, with zeros in the gaps, and its numbers: all stamps, then all blocks.

        ``payload`` is at least as long as the one this layout was made of.
        """
        # Not ``buffer & mask`` first: rearranging makes the copy that is aligned.
        words = np.frombuffer(payload, _WORD, self._count).take(self._order)
        data = (words & self._mask).tobytes()
        return data[: self._fixed_bytes], data[self._fixed_bytes :]

    def join(self, fixed: bytes, numbers: bytes) -> bytes:
        """The payload that ``split`` takes apart into these."""
        return np.frombuffer(fixed + numbers, _WORD).take(self._places).tobytes()

    def is_like(self, other: CdrTemplate) -> bool:
        """Whether both take every payload apart in the same way."""
        return np.array_equal(self._order, other._order) and np.array_equal(self._mask, other._mask)


def _meaningful(reader: CdrReader) -> NDArray[np.uint32]:
    """Ones where the bits of a word mean something: not in the gaps, nor in the header's two options."""
    mask = np.full(reader.position, 0xFF, np.uint8)
    for start, end in [(len(reader.order), HEADER_BYTES), *reader.gaps]:
        mask[start:end] = 0
    return mask.view(_WORD)


class TemplateCache(Generic[M]):
    """Remembers what payloads mean beside their numbers, for any number of writers that take turns.

    The room is limited: when it is used up, all is forgotten, and what still comes is learned again.
    """

    def __init__(self) -> None:
        self._forget()

    def find(self, payload: bytes) -> tuple[M, bytes] | None:
        """The meaning of a payload that differs from one learned in numbers only, and the numbers."""
        for layout, meanings in self._by_length.get(len(payload), ()):
            fixed, numbers = layout.split(payload)
            meaning = meanings.get(fixed)
            if meaning is not None:
                return meaning, numbers
        return None

    def add(self, reader: CdrReader, meaning: M) -> None:
        """Remember what the payload means that ``reader`` has read to the end."""
        length = len(reader.payload)
        if reader.order != LITTLE_ENDIAN or length + _ENTRY > ROOM:
            return
        self._left -= length + _ENTRY
        if self._left < 0:
            self._forget()
        layout = CdrTemplate(reader)
        fixed, _ = layout.split(reader.payload)
        known = self._by_length.get(length, ())
        for one, meanings in known:
            if one.is_like(layout):
                meanings[fixed] = meaning
                return
        if len(known) < _ALTERNATIVES:
            self._by_length[length] = (*known, (layout, {fixed: meaning}))

    def _forget(self) -> None:
        self._by_length: dict[int, tuple[tuple[CdrTemplate, dict[bytes, M]], ...]] = {}
        self._left = ROOM
