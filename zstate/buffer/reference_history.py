"""The reference in Python of histories and fast paths, used without the C extension."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.history_view import HistoryView

_MIN_CAPACITY = 16

W = TypeVar("W")


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


def insert_together(
    histories: Sequence[ReferenceHistory], stamp: int, rows: Sequence[NDArray[np.float64]]
) -> None:
    """Insert one instant into several histories, none of which it is too old for."""
    for history, row in zip(histories, rows, strict=True):
        history.insert(stamp, row)
