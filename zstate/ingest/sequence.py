"""Sequence numbers of the samples of a writer: which ones are missing."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Hashable

from zstate._util.bounded_dict import BoundedDict
from zstate.ingest.counters import Counters

_MAX_GAPS = 64


class MissingSamples:
    """The missing sequence numbers of the current session; of more than 64 gaps the newest are kept."""

    def __init__(self) -> None:
        self._ranges: deque[range] = deque([range(sys.maxsize)], maxlen=_MAX_GAPS)

    def __bool__(self) -> bool:
        return bool(self._ranges)

    def __contains__(self, seq: int) -> bool:
        return any(seq in missing for missing in self._ranges)

    def add(self, first: int, end: int) -> None:
        """Add the samples from ``first`` up to, without, ``end``."""
        self._ranges.append(range(first, end))

    def stop_at(self, seq: int) -> None:
        """Remove the samples from ``seq`` on: they were received, or will be."""
        kept = [range(one.start, min(one.stop, seq)) for one in self._ranges]
        self._ranges = deque([one for one in kept if one], maxlen=_MAX_GAPS)


class GapCounter:
    """Counts the samples missing from each writer: "dropped" by this process, or "missed" before it."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._next: BoundedDict[Hashable, int] = BoundedDict()
        self._is_overflowed = False
        self._overflowed: set[Hashable] = set()

    def start_batch(self, *, overflowed: bool) -> None:
        """Start a batch; ``overflowed`` if the receiver's ring lost samples before it, or in it.

        If so, gaps in this batch count as "dropped", and so does the next gap of each writer that has no
        sample in it.
        """
        self._is_overflowed = overflowed
        if overflowed:
            self._overflowed = set(self._next)

    def add(self, writer: Hashable, seq: int) -> None:
        """Count what is missing before sample ``seq`` of ``writer``."""
        expected = self._next.get(writer, seq)
        if seq > expected:
            is_own = self._is_overflowed or writer in self._overflowed
            self._counters.count("dropped" if is_own else "missed", seq - expected)
        self._overflowed.discard(writer)
        self._next[writer] = max(seq + 1, expected)
