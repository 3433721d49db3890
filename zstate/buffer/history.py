"""History of one track: a ring of stamps and rows of numbers that readers use without a lock.

A reader gets a ``HistoryView``; the rows that a view covers are never written again. A sample newer than
all others goes into spare capacity behind the view. Every other insert (a late sample, a second sample of
one stamp, no capacity left) writes a new copy. The new view is then published by one assignment.

``History`` is the class of the C extension if that is used, else ``ReferenceHistory``; both behave the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.history_view import HistoryView
from zstate.extension import kernel

if TYPE_CHECKING or kernel == "reference":
    from zstate.buffer import reference_history

    History = reference_history.ReferenceHistory
    FastPath = reference_history.ReferenceFastPath
    insert_together = reference_history.insert_together
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
