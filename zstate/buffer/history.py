"""One stamp column, and rows of numbers beside it.

Readers take ``view`` and never a lock: rows that a view covers are never written again. A sample
at the end goes into spare room behind the view; everything else (a late sample, a second sample of
one stamp, room running out) writes a new copy. Then the new view is published by one assignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_SMALLEST_CAPACITY = 16


class View(NamedTuple):
    """What a reader may rely on: rows ``first`` up to, not including, ``end``; ascending stamps."""

    stamps: NDArray[np.int64]
    rows: NDArray[np.float64]
    first: int
    end: int

    @property
    def size(self) -> int:
        """How many samples there are."""
        return self.end - self.first

    @property
    def oldest(self) -> int:
        """The first stamp [ns]; only for views that are not empty."""
        return int(self.stamps[self.first])

    @property
    def newest(self) -> int:
        """The last stamp [ns]; only for views that are not empty."""
        return int(self.stamps[self.end - 1])

    def kept_stamps(self) -> NDArray[np.int64]:
        """The stamp column without spare room: (size,)."""
        return self.stamps[self.first : self.end]

    def kept_rows(self) -> NDArray[np.float64]:
        """The rows without spare room: (size, width)."""
        return self.rows[self.first : self.end]


class History:
    """Samples of ``width`` numbers each, kept until ``span_ns`` older than the newest.

    One writer at a time (the buffer's lock); readers at any time, through ``view``.
    """

    def __init__(self, width: int, span_ns: int) -> None:
        self.width = width
        self.span_ns = span_ns
        self.view = self._empty(_SMALLEST_CAPACITY)

    def _empty(self, capacity: int) -> View:
        stamps = np.empty(capacity, dtype=np.int64)
        return View(stamps, np.empty((capacity, self.width)), 0, 0)

    @property
    def newest(self) -> int | None:
        """The last stamp [ns]; None without any."""
        view = self.view
        return view.newest if view.size else None

    @property
    def oldest(self) -> int | None:
        """The first stamp [ns]; None without any."""
        view = self.view
        return view.oldest if view.size else None

    def replace(self, stamps: NDArray[np.int64], rows: NDArray[np.float64]) -> None:
        """Hold a copy of these samples, ascending and already within the span, and no others."""
        fresh = self._empty(max(_SMALLEST_CAPACITY, len(stamps)))
        fresh.stamps[: len(stamps)] = stamps
        fresh.rows[: len(stamps)] = rows
        self.view = fresh._replace(end=len(stamps))

    def clear(self) -> None:
        """Forget every sample."""
        self.view = self._empty(_SMALLEST_CAPACITY)

    def reaches(self, stamp: int) -> bool:
        """Whether a sample of that stamp would be kept: at most ``span_ns`` older than the newest."""
        return not self.view.size or stamp >= self.view.newest - self.span_ns

    def take(self, stamp: object, positions: object, velocities: object, position_count: int) -> bool | None:
        """Insert unchecked input, where that can be done and checked in one go. None: it cannot, ever."""

    def insert(self, stamp: int, row: NDArray[np.float64]) -> bool:
        """Take a sample; False when it is older than the history reaches."""
        view = self.view
        if view.end == view.first or stamp > view.stamps[view.end - 1]:
            self._append(stamp, row)
        elif not self.reaches(stamp):
            return False
        else:
            self._splice(stamp, row)
        return True

    def _append(self, stamp: int, row: NDArray[np.float64]) -> None:
        view = self.view
        if view.end == len(view.stamps):
            view = self._with_room(view)
        stamps, rows, first, end = view
        stamps[end] = stamp
        rows[end] = row
        limit = stamp - self.span_ns
        if stamps[first] < limit:
            first += int(stamps[first:end].searchsorted(limit))
        self.view = View(stamps, rows, first, end + 1)

    def _with_room(self, view: View) -> View:
        """The same samples at the front of arrays with room for an eighth more.

        Both copies live for a moment, and a long history of a large robot is megabytes.
        """
        fresh = self._empty(_SMALLEST_CAPACITY + view.size + view.size // 8)
        fresh.stamps[: view.size] = view.kept_stamps()
        fresh.rows[: view.size] = view.kept_rows()
        return fresh._replace(end=view.size)

    def _splice(self, stamp: int, row: NDArray[np.float64]) -> None:
        stamps, rows = self.view.kept_stamps(), self.view.kept_rows()
        at = int(stamps.searchsorted(stamp))
        after = at + 1 if stamps[at] == stamp else at
        fresh = self._empty(self.view.size + 1 + self.view.size // 8)
        end = at + 1 + len(stamps) - after
        fresh.stamps[:at], fresh.stamps[at], fresh.stamps[at + 1 : end] = stamps[:at], stamp, stamps[after:]
        fresh.rows[:at], fresh.rows[at], fresh.rows[at + 1 : end] = rows[:at], row, rows[after:]
        self.view = fresh._replace(end=end)


def insert_together(histories: Sequence[History], stamp: int, rows: Sequence[NDArray[np.float64]]) -> None:
    """One instant of several histories, none of which it is too old for."""
    for history, row in zip(histories, rows, strict=True):
        history.insert(stamp, row)


def thin(history: History, stamps: NDArray[np.int64]) -> None:
    """Keep the first sample, the last, and of each of ``stamps`` [ns] those around it."""
    view = history.view
    kept = view.kept_stamps()
    after, before = kept.searchsorted(stamps), kept.searchsorted(stamps, "right") - 1
    needed = np.unique(np.concatenate((after, before, (0, view.size - 1))))
    needed = needed[(needed >= 0) & (needed < view.size)]
    history.replace(kept[needed], view.kept_rows()[needed])
