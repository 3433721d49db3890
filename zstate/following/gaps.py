"""Gaps: samples that never came, as the sequence numbers of those that did tell."""

from __future__ import annotations

from collections.abc import Hashable

from zstate.following.tally import Tally


class Gaps:
    """Counts what is missing between the samples of each writer: "dropped" by us, or "missed" before."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._next: dict[Hashable, int] = {}
        self._overflowed: set[Hashable] = set()

    def note_overflow(self) -> None:
        """A ring of ours has just lost samples: of each writer the next gap is due to that."""
        self._overflowed = set(self._next)

    def note(self, writer: Hashable, seq: int) -> None:
        """A sample of ``writer`` has come."""
        expected = self._next.get(writer, seq)
        if seq > expected:
            self._tally.count("dropped" if writer in self._overflowed else "missed", seq - expected)
        self._overflowed.discard(writer)
        self._next[writer] = max(seq + 1, expected)
