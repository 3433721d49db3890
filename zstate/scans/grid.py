"""Grid: an occupancy grid, as in nav_msgs/OccupancyGrid, and its files.

Cell (row, column) covers the square [column, column + 1) x [row, row + 1) times ``resolution``, in axes
whose pose in the grid's frame is ``origin``: the corner of cell (0, 0), rows along y, columns along x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import check_names, real_numbers, reduced_to_fields
from zstate.clock import check_stamp
from zstate.errors import InvalidInput
from zstate.scans.map_files import read_cells, scale_image, write_map
from zstate.scans.map_metadata import Mode, read_metadata
from zstate.scans.messages import OccupancyGrid, cells_of
from zstate.transform import Transform
from zstate.wire.keys import full_name
from zstate.wire.messages import from_block, to_block

UNKNOWN = -1
OCCUPIED = 100

_LEVEL = 1e-9
"""z [m], roll and pitch [rad] up to this are rounding."""

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

    __reduce__ = reduced_to_fields

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
        columns, rows, is_inside = self._cell_coordinates(points)
        found = np.full(len(columns), UNKNOWN, dtype=np.int8)
        inside = rows[is_inside].astype(np.intp), columns[is_inside].astype(np.intp)
        found[is_inside] = self.cells[inside]
        return found

    def covers(self, x: float, y: float) -> bool:
        """Whether the point x, y in ``frame`` [m] is inside the grid, over a known cell or not."""
        return bool(self._cell_coordinates([(x, y)])[2][0])

    def _cell_coordinates(
        self, points: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Columns and rows of points in ``frame``, with fractions, and whether each is inside."""
        array = real_numbers(points, "points")
        if array.ndim != 2 or array.shape[1] not in (2, 3):
            raise InvalidInput(f"points in a grid have the shape (N, 2) or (N, 3); got {array.shape}")
        if array.shape[1] == 2:
            array = np.column_stack((array, np.zeros(len(array))))
        with np.errstate(invalid="ignore"):
            columns, rows, _ = self.origin.inverse().apply(array).T / self.resolution
        height, width = self.cells.shape
        # As floats: far points have no int64 coordinates. NaN fails each comparison.
        return columns, rows, (columns >= 0.0) & (columns < width) & (rows >= 0.0) & (rows < height)

    def to_image(self) -> NDArray[np.uint8]:
        """The grid as RGBA, (height, width, 4), the row of the largest y first.

        From white (0) to black (100); cells that are unknown are transparent grey.
        """
        return scale_image(self.cells)

    def save(self, path: str | Path, mode: Mode = "trinary") -> None:
        """Write the map files ``path`` (.yaml) and, with the same name, its image.

        "trinary", as map_saver's default, is a .pgm in which cells from 65 are occupied, those up to 25
        free, and all others unknown. "scale" (a .png) and "raw" (a .pgm) keep every cell. map_server's files
        have no frame. Raises InvalidInput if the origin is tilted or has a z, or if a file cannot be written.
        """
        write_map(Path(path), self.cells, self.resolution, self.planar_origin(), mode)

    def planar_origin(self) -> tuple[float, float, float]:
        """x, y [m] and yaw [rad] of ``origin``. Raises InvalidInput if it is tilted or has a z."""
        x, y, z = self.origin.translation.tolist()
        roll, pitch, yaw = self.origin.rpy.tolist()
        if max(abs(z), abs(roll), abs(pitch)) > _LEVEL:
            raise InvalidInput(
                f"the origin of {self!r} is not in the x-y plane: z {z:g} m, roll {roll:g} rad, "
                f"pitch {pitch:g} rad; make a Grid with an origin x, y, yaw"
            )
        return x, y, yaw

    def __repr__(self) -> str:
        height, width = self.cells.shape
        return f"<Grid of {width} x {height} cells of {self.resolution:g} m in {self.frame!r}>"


def load_map(path: str | Path, frame: str = "map") -> Grid:
    """The map of map_server whose YAML file is ``path``, placed in ``frame``.

    All modes, as in ``zstate.scans.map_files``; ~ is the home folder. Raises InvalidInput with every finding
    in the YAML file, or the reason why its image cannot be read, and LibraryMissing without PyYAML and Pillow
    (``pip install 'zstate[maps]'``).
    """
    metadata = read_metadata(Path(path).expanduser())
    return Grid(read_cells(metadata), metadata.resolution, metadata.origin, frame)


def grid_to_message(grid: Grid, session: int) -> OccupancyGrid:
    """``grid`` on the wire."""
    height, width = grid.cells.shape
    origin = to_block(grid.origin.pose7)
    where = grid.frame, grid.resolution, width, height
    return OccupancyGrid(session, grid.stamp, *where, origin, grid.cells.tobytes())


def grid_from_message(message: OccupancyGrid, robot: str) -> Grid:
    """The grid of ``robot`` in ``message``; its frame has the full name.

    Raises InvalidInput if it has no cells, or an origin that is no pose.
    """
    frame = full_name(robot, message.frame)
    return Grid(cells_of(message), message.resolution, from_block(message.origin), frame, message.stamp)


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
