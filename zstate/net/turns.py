"""Turns: the order in which the requests to many writers are sent.

A listener of all robots requests the history and the clock of each writer that is announced, a few at a
time. An announced writer need not answer: in the order of arrival a thousand silent writers of one robot
would keep those of another robot waiting for minutes.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Turns(Generic[T]):
    """Items of several sources, each due at a time: one item of each source in turn (round robin).

    A source with a thousand items delays those of another source by one item, not by a thousand. Adding and
    taking cost O(log n). Times are seconds of one clock. Not safe from several threads.
    """

    def __init__(self) -> None:
        self._later: list[tuple[float, int, str, T]] = []
        """A heap; the number keeps the order of items that are due at the same time."""
        self._due: dict[str, deque[T]] = {}
        """By source; the first source is the next."""
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return len(self._later) + sum(map(len, self._due.values()))

    def add(self, source: str, item: T, due_s: float = 0.0) -> None:
        """Have ``item`` taken at ``due_s`` or later."""
        heapq.heappush(self._later, (due_s, next(self._numbers), source, item))

    def take(self, now_s: float) -> T | None:
        """The next item that is due; None if there is none."""
        while self._later and self._later[0][0] <= now_s:
            _, _, source, item = heapq.heappop(self._later)
            self._due.setdefault(source, deque()).append(item)
        if not self._due:
            return None
        source = next(iter(self._due))
        items = self._due.pop(source)
        item = items.popleft()
        if items:
            self._due[source] = items  # behind all other sources
        return item

    def next_s(self, now_s: float) -> float | None:
        """When the next item is due, ``now_s`` at the earliest; None if there is no item."""
        if self._due:
            return now_s
        return max(now_s, self._later[0][0]) if self._later else None

    def clear(self) -> None:
        """Drop all items."""
        self._later.clear()
        self._due.clear()
