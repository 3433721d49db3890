"""The past of joints, thin enough to be drawn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.tracks import JointTrack


class JointHistory(NamedTuple):
    """``positions[i]`` at ``stamps[i]`` [ns]: (T, nq), in the order of the model's ``joint_names``."""

    stamps: NDArray[np.int64]
    positions: NDArray[np.float64]


def joint_history(track: JointTrack, until: int, seconds: float, points: int = 240) -> JointHistory:
    """The samples of the last ``seconds`` before ``until`` [ns]; of more than ``points`` every n-th."""
    view = track.history.view
    stamps, rows = view.kept_stamps(), view.kept_rows()
    first, end = np.searchsorted(stamps, (until - round(seconds * 1e9), until + 1)).tolist()
    step = max(1, -(-(end - first) // points))
    # Counted from the first sample there is, or else every picture would show others than the last.
    begin = first + (-first) % step
    chosen = slice(begin, end, step)
    return JointHistory(stamps[chosen], rows[chosen, : track.model.position_count])
