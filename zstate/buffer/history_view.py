"""Views of histories: the samples of a track at one moment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


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
