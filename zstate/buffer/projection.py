"""Projection of points into the picture of a moving camera, each row of which has an instant of its own.

The row v in which a point appears follows from where the camera is at the instant of that row,
``stamp + v * line_time_ns``. The secant method finds it, from the row in the middle on: the difference of
the row of the pixel and that of the instant is nearly a line, so that three or four steps are enough.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from zstate.checks import Points

_CLOSE_PX = 1e-5
_STEPS = 30
_FLAT = 1e-3


class ProjectingCamera(Protocol):
    """What a projection needs of a camera: ``zstate.cameras.Camera``, or one of another model."""

    @property
    def frame(self) -> str:
        """The frame of the points that ``project`` takes."""
        ...

    @property
    def height(self) -> int:
        """The rows of a picture."""
        ...

    @property
    def line_time_ns(self) -> int:
        """The time between two rows; 0 if all have one instant."""
        ...

    def project(self, points: NDArray[np.float64], /) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The pixels u, v of points, (N, 2), and which are valid, (N,)."""
        ...


Place = Callable[[NDArray[np.int64]], tuple[Points, NDArray[np.bool_]]]
"""The points in the frame of the camera, each at its stamp, (N, 3); and which are valid, (N,)."""


def project_rows(
    place: Place, camera: ProjectingCamera, stamp: int, count: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The pixels of the ``count`` points that ``place`` moves, each at the instant of its row.

    A point beside the picture has the instant of the nearest row. One for which there is no such row, or
    whose row is not found, is not valid.
    """
    last_row = camera.height - 1
    rows = np.full(count, last_row / 2)
    pixels = np.full((count, 2), np.nan)
    valid: NDArray[np.bool_] = np.zeros(count, np.bool_)
    is_settled: NDArray[np.bool_] = valid
    rows_before, error_before = np.full(count, np.nan), np.full(count, np.nan)
    for _ in range(_STEPS):
        stamps = stamp + np.rint(rows * camera.line_time_ns).astype(np.int64)
        placed, is_placed = place(stamps)
        pixels, is_seen = camera.project(placed.astype(np.float64, copy=False))
        valid = is_seen & is_placed
        error = np.where(valid, np.clip(pixels[:, 1], 0.0, last_row) - rows, 0.0)
        is_settled = (np.abs(error) < _CLOSE_PX) | (camera.line_time_ns == 0)
        if is_settled.all():
            break
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = (error - error_before) / (rows - rows_before)
            step = np.where(np.abs(slope) > _FLAT, -error / slope, error)  # at first the row of the pixel
        rows_before, error_before = rows, error
        rows = np.clip(rows + step, 0.0, last_row)
    valid = valid & is_settled
    pixels[~valid] = np.nan
    return pixels, valid
