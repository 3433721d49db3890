"""Counter of the samples that are missing between the sequence numbers of writers."""

from __future__ import annotations

from collections.abc import Hashable

from zstate._util.bounded import BoundedDict
from zstate.ingest.counters import Counters


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

    def add(self, writer: Hashable, seq: int) -> int:
        """Count what is missing before sample ``seq`` of ``writer``, and return how many these are."""
        expected = self._next.get(writer, seq)
        missing = max(seq - expected, 0)
        if missing:
            is_own = self._is_overflowed or writer in self._overflowed
            self._counters.count("dropped" if is_own else "missed", missing)
        self._overflowed.discard(writer)
        self._next[writer] = max(seq + 1, expected)
        return missing
