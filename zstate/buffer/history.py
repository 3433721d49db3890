"""History of one track: a ring of stamps and rows of numbers that readers use without a lock.

A reader gets a ``HistoryView``; the rows that a view covers are never written again. A sample newer than
all others goes into spare capacity behind the view. Every other insert (a late sample, a second sample of
one stamp, no capacity left) writes a new copy. The new view is then published by one assignment.

``History`` is the class of the C extension if that is used, else ``ReferenceHistory``; both behave the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from zstate.extension import kernel

_MIN_CAPACITY = 16

W = TypeVar("W")


class HistoryView(NamedTuple):
    """Rows ``first`` up to, not including, ``end`` of a history; stamps [ns] ascend."""

    stamps: NDArray[np.int64]
    rows: NDArray[np.float64]
    first: int
    end: int

    @property
    def size(self) -> int:
        """The number of samples."""
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
        """The stamp column without spare capacity: (size,)."""
        return self.stamps[self.first : self.end]

    def kept_rows(self) -> NDArray[np.float64]:
        """The rows without spare capacity: (size, width)."""
        return self.rows[self.first : self.end]


class ReferenceHistory:
    """Samples of ``width`` numbers each, kept until ``span_ns`` older than the newest.

    One writer at a time (the buffer's lock); readers at any time, through ``view``.
    """

    def __init__(self, width: int, span_ns: int) -> None:
        self.width = width
        self.span_ns = span_ns
        # The stamps of a view, and how many slots at its front never had a sample: no reader sees them.
        self._unused: tuple[NDArray[np.int64] | None, int] = None, 0
        self.view = self._empty(_MIN_CAPACITY)

    def _empty(self, capacity: int) -> HistoryView:
        stamps = np.empty(capacity, dtype=np.int64)
        return HistoryView(stamps, np.empty((capacity, self.width)), 0, 0)

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
        """Replace all samples by a copy of these, which ascend and are within the span."""
        fresh = self._empty(max(_MIN_CAPACITY, len(stamps)))
        fresh.stamps[: len(stamps)] = stamps
        fresh.rows[: len(stamps)] = rows
        self.view = fresh._replace(end=len(stamps))

    def clear(self) -> None:
        """Remove every sample."""
        self.view = self._empty(_MIN_CAPACITY)

    def close(self) -> None:
        """Refuse samples of a ``FastPath``: another history takes the place of this one."""

    def reaches(self, stamp: int) -> bool:
        """Whether a sample of that stamp would be kept: at most ``span_ns`` older than the newest."""
        return not self.view.size or stamp >= self.view.newest - self.span_ns

    def try_insert(
        self, stamp: object, positions: object, velocities: object, position_count: int
    ) -> bool | None:
        """Insert unchecked input if it can be checked and inserted in one call. None here: it never can."""

    def try_insert_poses(self, stamp: object, block: object) -> bool | None:
        """The same for a block of poses, quaternions normalised and further columns NaN. None here."""

    def insert(self, stamp: int, row: NDArray[np.float64]) -> bool:
        """Insert a sample; False if it is older than the history reaches."""
        view = self.view
        if view.size and stamp <= view.newest:
            if not self.reaches(stamp):
                return False
            if stamp < view.oldest:
                self._insert_before(stamp, row)
                return True
            kept, old = view.kept_stamps(), view.kept_rows()
            at = int(kept.searchsorted(stamp))
            after = at + 1 if kept[at] == stamp else at
            new = self._empty(view.size + 1 + view.size // 8)
            end = at + 1 + len(kept) - after
            new.stamps[:at], new.stamps[at], new.stamps[at + 1 : end] = kept[:at], stamp, kept[after:]
            new.rows[:at], new.rows[at], new.rows[at + 1 : end] = old[:at], row, old[after:]
            self.view = new._replace(end=end)
            return True
        if view.end == len(view.stamps):
            # An eighth more: both copies exist for a moment; a long history of a large robot is megabytes.
            fresh = self._empty(_MIN_CAPACITY + view.size + view.size // 8)
            fresh.stamps[: view.size] = view.kept_stamps()
            fresh.rows[: view.size] = view.kept_rows()
            view = fresh._replace(end=view.size)
        stamps, rows, first, end = view
        stamps[end] = stamp
        rows[end] = row
        limit = stamp - self.span_ns
        if stamps[first] < limit:
            first += int(stamps[first:end].searchsorted(limit))
        self.view = HistoryView(stamps, rows, first, end + 1)
        return True

    def _insert_before(self, stamp: int, row: NDArray[np.float64]) -> None:
        """Insert the oldest sample: a writer's past arrives newest first."""
        view, size = self.view, self.view.size
        if self._unused[0] is not view.stamps or self._unused[1] != view.first or not view.first:
            spare = _MIN_CAPACITY + size // 8
            fresh = self._empty(2 * spare + size + 1)
            fresh.stamps[spare + 1 : spare + 1 + size] = view.kept_stamps()
            fresh.rows[spare + 1 : spare + 1 + size] = view.kept_rows()
            view = fresh._replace(first=spare + 1, end=spare + 1 + size)
        at = view.first - 1
        view.stamps[at], view.rows[at] = stamp, row
        self._unused = view.stamps, at
        self.view = view._replace(first=at)


class ReferenceFastPath(Generic[W]):
    """Inserts the usual next message of one writer into a history, in one call of the extension.

    The usual next message is the last one, byte for byte, but for a newer stamp, the next sequence number and
    other numbers of the same count: what was checked of the last message holds for it. Each other message
    ends this, until ``expect`` is called again. The reference inserts none. A message is a payload of the
    native wire, or a JointState of the ros2 wire with its attachment behind it.

    ``waiters`` are the waiting threads and tasks by track. ``counts["received"]`` grows with each message.
    ``sources`` are objects whose ``version`` is compared with that of the last message.

    Calls are atomic and take no lock: code that changes what a fast path depends on calls ``stop`` or
    ``History.close`` first, or raises a version.
    """

    def __init__(
        self, waiters: Mapping[Any, tuple[W, ...]], counts: dict[str, int], sources: tuple[object, ...]
    ) -> None:
        pass

    def expect(
        self,
        message: bytes,
        track: object,
        history: ReferenceHistory,
        position_count: int,
        versions: tuple[int, ...],
    ) -> bool:
        """Expect the message after ``message``, whose sample was inserted into ``history`` of ``track``.

        ``position_count`` is the number of joint positions, -1 for poses. False if none can be expected.
        """
        return False

    def insert(self, message: bytes | None, earliest: int, latest: int) -> tuple[W, ...] | None:
        """Insert a message with a stamp from ``earliest`` to ``latest`` [ns]; the waiters for its track.

        None if it is not the usual next message; then nothing was changed.
        """
        return None

    def stop(self) -> tuple[int, int] | None:
        """Expect no message. The sequence number after the last message, and its stamp; None without one."""
        return None


if TYPE_CHECKING or kernel == "reference":
    History = ReferenceHistory
    FastPath = ReferenceFastPath

    def insert_together(
        histories: Sequence[History], stamp: int, rows: Sequence[NDArray[np.float64]]
    ) -> None:
        """Insert one instant into several histories, none of which it is too old for."""
        for history, row in zip(histories, rows, strict=True):
            history.insert(stamp, row)

else:
    from zstate import _kernel

    insert_together = _kernel.insert_together
    FastPath = _kernel.FastPath

    class History(_kernel.History):
        """``ReferenceHistory`` over memory of the extension."""

        __slots__ = ("_arrays",)

        def replace(self, stamps: NDArray[np.int64], rows: NDArray[np.float64]) -> None:
            super().replace(np.ascontiguousarray(stamps), np.ascontiguousarray(rows))

        @property
        def view(self) -> HistoryView:
            """The samples for readers in Python; these arrays cannot be written to."""
            return self.view_of(self.window)

        def view_of(self, window: _kernel.Window) -> HistoryView:
            """The samples that the extension read: they stay, whatever is inserted or removed since."""
            block, first, end = window
            arrays = getattr(self, "_arrays", (None,))
            if arrays[0] is not block:
                # Made once for each block, because waiters read after every insert.
                stamps = np.frombuffer(block, np.int64, block.capacity)
                rows = np.frombuffer(block, np.float64, offset=stamps.nbytes)
                arrays = self._arrays = (block, stamps, rows.reshape(block.capacity, block.width))
            return HistoryView(arrays[1], arrays[2], first, end)


def merged(history: History, stamps: NDArray[np.int64], rows: NDArray[np.float64]) -> History:
    """A history of the same samples and of these, whose stamps ascend: one copy of all.

    It takes the place of ``history``, which refuses samples of a ``FastPath`` from now on. A sample of a
    stamp that ``history`` has replaces the one there. Those older than the span of the newest are left out.
    """
    history.close()
    view = history.view
    both = np.concatenate((view.kept_stamps(), stamps))
    order = np.argsort(both, kind="stable")  # of two samples of one stamp, the one of ``rows`` is behind
    is_last = np.append(np.diff(both[order]) > 0, [True])
    order = order[is_last]
    order = order[both[order] >= int(both[order[-1]]) - history.span_ns]
    fresh = History(history.width, history.span_ns)
    fresh.replace(both[order], np.concatenate((view.kept_rows(), rows))[order])
    return fresh


def keep_only_around(history: History, stamps: NDArray[np.int64]) -> None:
    """Keep the first sample, the last, and those around each of ``stamps`` [ns]."""
    view = history.view
    kept = view.kept_stamps()
    after, before = kept.searchsorted(stamps), kept.searchsorted(stamps, "right") - 1
    needed = np.unique(np.concatenate((after, before, (0, view.size - 1))))
    needed = needed[(needed >= 0) & (needed < view.size)]
    history.replace(kept[needed], view.kept_rows()[needed])
