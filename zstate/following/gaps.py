"""Gaps: samples that never came, as the sequence numbers of those that did tell."""

from __future__ import annotations

from collections.abc import Hashable

from zstate.following.bounded import remember
from zstate.following.tally import Tally


class Gaps:
    """Counts what is missing between the samples of each writer: "dropped" by us, or "missed" before."""

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._next: dict[Hashable, int] = {}
        self._is_overflowed = False
        self._overflowed: set[Hashable] = set()

    def begin(self, *, overflowed: bool) -> None:
        """A batch begins; ``overflowed`` says that a ring of ours has lost samples before it, or in it.

        Then gaps in it are due to that, and so is the next one of each writer that is not in it.
        """
        self._is_overflowed = overflowed
        if overflowed:
            self._overflowed = set(self._next)

    def note(self, writer: Hashable, seq: int) -> None:
        """A sample of ``writer`` has come."""
        expected = self._next.get(writer, seq)
        if seq > expected:
            ours = self._is_overflowed or writer in self._overflowed
            self._tally.count("dropped" if ours else "missed", seq - expected)
        self._overflowed.discard(writer)
        if writer in self._next:
            self._next[writer] = max(seq + 1, expected)
        else:
            remember(self._next, writer, seq + 1)
