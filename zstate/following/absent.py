"""Absent: which samples of a writer a listener has not heard."""

from __future__ import annotations

import sys
from collections import deque

_MOST_GAPS = 64


class Absent:
    """The sequence numbers that are missing, of the present session."""

    def __init__(self) -> None:
        self._ranges: deque[range] = deque([range(sys.maxsize)], maxlen=_MOST_GAPS)

    def __bool__(self) -> bool:
        return bool(self._ranges)

    def __contains__(self, seq: int) -> bool:
        return any(seq in missing for missing in self._ranges)

    def add(self, first: int, end: int) -> None:
        """The samples from ``first`` up to ``end`` were lost."""
        self._ranges.append(range(first, end))

    def stop_at(self, seq: int) -> None:
        """What is said from ``seq`` on need not be learned again: it has been, or is being, heard."""
        kept = [range(one.start, min(one.stop, seq)) for one in self._ranges]
        self._ranges = deque([one for one in kept if one], maxlen=_MOST_GAPS)
