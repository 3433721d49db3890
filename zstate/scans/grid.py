"""Grid: an occupancy grid, as in nav_msgs/OccupancyGrid, and its files.

Cell (row, column) covers the square [column, column + 1) x [row, row + 1) times ``resolution``, in axes
whose pose in the grid's frame is ``origin``: the corner of cell (0, 0), rows along y, columns along x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import check_names, real_numbers
from zstate.clock import check_stamp
from zstate.errors import InvalidInput
from zstate.transform import Transform

UNKNOWN = -1
FREE = 0
OCCUPIED = 100

CORNER = "corner"
"""The source frame of ``origin``, if it is given as numbers."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Grid:
    """An occupancy grid: ``cells`` (height, width) of square cells with sides of ``resolution`` [m].

    A cell is -1 if unknown, else its occupancy from 0 (free) to 100. ``origin`` is the pose of the corner of
    cell (0, 0) in ``frame``: a Transform with target ``frame``, or x, y [m], yaw [rad], or x y z qx qy qz
    qw. Columns are along its x axis, rows along its y axis, so a yaw turns the whole grid. ``stamp`` [ns] is
    the time when the map was made, 0 if not known.

    ``cells`` is int8, a read-only copy of the argument, which has integers. ``origin`` becomes a Transform.
    Raises InvalidInput if the values are no grid.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: Transform
    frame: str = "map"
    stamp: int = 0

    def __init__(
        self,
        cells: ArrayLike,
        resolution: float,
        origin: Transform | ArrayLike,
        frame: str = "map",
        stamp: int = 0,
    ) -> None:
        check_names(frame)
        fields = self.__dict__  # a frozen dataclass; only the constructor sets its fields
        fields["cells"] = _checked_cells(cells)
        fields["resolution"] = _checked_resolution(resolution)
        fields["origin"] = _checked_origin(origin, frame)
        fields["frame"] = frame
        fields["stamp"] = check_stamp(stamp)

    @property
    def size(self) -> tuple[float, float]:
        """Width along x and height along y of the grid's own axes [m]."""
        height, width = self.cells.shape
        return width * self.resolution, height * self.resolution

    def at(self, points: ArrayLike) -> NDArray[np.int8]:
        """The cells under ``points``, (N, 2) or (N, 3) in ``frame`` [m]: (N,), -1 outside the grid.

        A point with NaN is outside. z matters only if ``origin`` is tilted. Raises InvalidInput for other
        shapes.
        """
        columns, rows = self._cell_coordinates(points)
        height, width = self.cells.shape
        # As floats: far points have no int64 coordinates. NaN fails each comparison.
        is_inside = (columns >= 0.0) & (columns < width) & (rows >= 0.0) & (rows < height)
        found = np.full(len(columns), UNKNOWN, dtype=np.int8)
        inside = rows[is_inside].astype(np.intp), columns[is_inside].astype(np.intp)
        found[is_inside] = self.cells[inside]
        return found

    def _cell_coordinates(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Columns and rows of points in ``frame``, with fractions."""
        array = real_numbers(points, "points")
        if array.ndim != 2 or array.shape[1] not in (2, 3):
            raise InvalidInput(f"points in a grid have the shape (N, 2) or (N, 3); got {array.shape}")
        if array.shape[1] == 2:
            array = np.column_stack((array, np.zeros(len(array))))
        with np.errstate(invalid="ignore"):
            columns, rows, _ = self.origin.inverse().apply(array).T / self.resolution
        return columns, rows

    def to_image(self) -> NDArray[np.uint8]:
        """The grid as RGBA, (height, width, 4), the row of the largest y first.

        From white (0) to black (100); cells that are unknown are transparent grey.
        """
        colors = np.take(_COLORS, self.cells[::-1].view(np.uint8))
        return colors.view(np.uint8).reshape(*self.cells.shape, 4)

    def __repr__(self) -> str:
        height, width = self.cells.shape
        return f"<Grid of {width} x {height} cells of {self.resolution:g} m in {self.frame!r}>"


def _colors() -> NDArray[np.uint32]:
    """RGBA in the four bytes of an integer, by the cell as uint8, so that -1 is 255: (256,)."""
    colors = np.zeros((256, 4), dtype=np.uint8)
    colors[: OCCUPIED + 1, :3] = np.rint(np.linspace(255.0, 0.0, OCCUPIED + 1))[:, None]
    colors[: OCCUPIED + 1, 3] = 255
    colors[UNKNOWN] = (128, 128, 128, 0)
    return colors.view(np.uint32)[:, 0]


_COLORS = _colors()


def _checked_cells(cells: ArrayLike) -> NDArray[np.int8]:
    array: NDArray[Any] = np.asarray(cells)
    if array.dtype.kind not in "iu":
        raise InvalidInput(
            f"cells of a grid are integers, -1 or 0 to 100; got an array of {array.dtype}: round it first"
        )
    if array.ndim != 2 or not array.size:
        raise InvalidInput(
            f"cells of a grid have the shape (height, width), both 1 or more; got {array.shape}: "
            "cells.reshape(height, width) makes rows of a flat array"
        )
    lowest, highest = int(array.min()), int(array.max())
    if lowest < UNKNOWN or highest > OCCUPIED:
        wrong = lowest if lowest < UNKNOWN else highest
        row, column = np.argwhere(array == wrong)[0].tolist()
        raise InvalidInput(
            f"cells of a grid are -1 (unknown) or 0 to 100; cell ({row}, {column}) is {wrong}: scale other "
            "costs to this range"
        )
    copy = array.astype(np.int8, order="C")
    copy.flags.writeable = False
    return copy


def _checked_resolution(resolution: Any) -> float:
    number = real_numbers(resolution, "the resolution of a grid")
    if number.ndim or not 0.0 < float(number) < math.inf:
        raise InvalidInput(
            f"the resolution of a grid is the side of a cell [m], finite and above zero; got {resolution!r}"
        )
    return float(number)


def _checked_origin(origin: Transform | ArrayLike, frame: str) -> Transform:
    if isinstance(origin, Transform):
        if origin.target != frame:
            raise InvalidInput(
                f"the origin of a grid in {frame!r} is a pose in {frame!r}; got one in {origin.target!r}: "
                f"pass frame={origin.target!r}, or look up the pose in {frame!r}"
            )
        return origin
    numbers = real_numbers(origin, "the origin of a grid")
    if numbers.shape == (7,):
        return Transform.from_pose7(frame, CORNER, numbers)
    if numbers.shape == (3,):
        x, y, yaw = numbers.tolist()
        return Transform.from_rpy(frame, CORNER, (x, y, 0.0), (0.0, 0.0, yaw))
    raise InvalidInput(
        "the origin of a grid is a Transform, x y yaw, or x y z qx qy qz qw; got an array of shape "
        f"{numbers.shape}"
    )
