"""Fast path for payloads that differ only in their numbers.

From one sample to the next stamps and numbers change; names, counts and lengths stay. After a payload was
read value by value, the place of its numbers is known, and the next one is rearranged in one step: the fixed
bytes to the front, to be matched as a whole, the numbers behind them.
"""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np

from zstate.wire.ros2.cdr import HEADER_BYTES, LITTLE_ENDIAN, CdrReader

M = TypeVar("M")

_CACHE_BYTES = 2**20  # of payloads; in memory it takes about three times as much
_ENTRY_BYTES = 1024  # of an entry, without its payload's length; approximate
# With more templates of one length, trying them costs as much as reading value by value.
_MAX_TEMPLATES = 8

# Times, doubles and every value after a count start at a multiple of four bytes.
_UINT32 = np.dtype("<u4")
_UINT32_BYTES = 4


class CdrTemplate:
    """The place of the numbers in the payload that ``reader`` has read to the end."""

    def __init__(self, reader: CdrReader) -> None:
        self._count = reader.position // _UINT32_BYTES
        words = np.arange(self._count)
        spans = [*reader.stamps, *reader.blocks]
        numbers = [words[start // _UINT32_BYTES : end // _UINT32_BYTES] for start, end in spans]
        fixed = np.delete(words, np.concatenate([words[:0], *numbers]))
        self._fixed_bytes = fixed.size * _UINT32_BYTES
        self._order = np.concatenate([fixed, *numbers])
        self._places = np.argsort(self._order)
        mask = np.full(reader.position, 0xFF, np.uint8)
        for start, end in [(len(reader.order), HEADER_BYTES), *reader.gaps]:
            mask[start:end] = 0  # padding, and the two option bytes of the header
        self._mask = mask.view(_UINT32)[self._order]

    def split(self, payload: bytes) -> tuple[bytes, bytes]:
        """The fixed bytes of ``payload``, with zero padding, and its numbers: all stamps, then all blocks.

        ``payload`` is at least as long as the template's.
        """
        # Not ``buffer & mask`` first: rearranging makes the copy that is aligned.
        words = np.frombuffer(payload, _UINT32, self._count).take(self._order)
        data = (words & self._mask).tobytes()
        return data[: self._fixed_bytes], data[self._fixed_bytes :]

    def join(self, fixed: bytes, numbers: bytes) -> bytes:
        """The payload that ``split`` takes apart into these."""
        return np.frombuffer(fixed + numbers, _UINT32).take(self._places).tobytes()

    def is_like(self, other: CdrTemplate) -> bool:
        """Whether both split every payload in the same way."""
        return np.array_equal(self._order, other._order) and np.array_equal(self._mask, other._mask)


class TemplateCache(Generic[M]):
    """Decoded values by the fixed bytes of payloads, for any number of writers.

    The size is limited: a full cache is cleared, and payloads that still arrive are added again.
    """

    def __init__(self) -> None:
        self._clear()

    def find(self, payload: bytes) -> tuple[M, bytes] | None:
        """The value of an added payload that differs from this one only in numbers, and the numbers."""
        for template, values in self._by_length.get(len(payload), ()):
            fixed, numbers = template.split(payload)
            value = values.get(fixed)
            if value is not None:
                return value, numbers
        return None

    def add(self, reader: CdrReader, value: M) -> None:
        """Keep the ``value`` of the payload that ``reader`` has read to the end."""
        length = len(reader.payload)
        if reader.order != LITTLE_ENDIAN or length + _ENTRY_BYTES > _CACHE_BYTES:
            return
        self._free_bytes -= length + _ENTRY_BYTES
        if self._free_bytes < 0:
            self._clear()
        new = CdrTemplate(reader)
        fixed, _ = new.split(reader.payload)
        templates = self._by_length.get(length, ())
        for template, values in templates:
            if template.is_like(new):
                values[fixed] = value
                return
        if len(templates) < _MAX_TEMPLATES:
            self._by_length[length] = (*templates, (new, {fixed: value}))

    def _clear(self) -> None:
        self._by_length: dict[int, tuple[tuple[CdrTemplate, dict[bytes, M]], ...]] = {}
        self._free_bytes = _CACHE_BYTES
