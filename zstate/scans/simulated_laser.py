"""Laser scans without a sensor: rays cast through a Grid, on a robot too, and ROS 2's dummy_laser.

Rays are cast by a digital differential analyser (Amanatides and Woo, "A fast voxel traversal algorithm for
ray tracing", 1987), all rays at once. A step leaves the largest square of free cells around the present one
instead of that cell alone, so that rays cross a room in few steps: with the Chebyshev distance d of a cell to
the nearest occupied one, the cells less than d rows and columns away are free.
"""

from __future__ import annotations

import math
import operator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.checks import real_numbers
from zstate.errors import InvalidInput
from zstate.nodes.mounted_sensor import MountedSensor
from zstate.scans.grid import Grid
from zstate.scans.scan import Scan

OCCUPIED_FROM = 65
"""Cells from this value on stop a ray; unknown cells do not. The default of map_saver."""

DUMMY_RAY_COUNT = 1081
DUMMY_ANGLE_MIN = -math.radians(135.0)
DUMMY_ANGLE_INCREMENT = math.radians(0.25)
DUMMY_RANGE_MAX = 10.0
# dummy_laser adds 0.1 rad with each of 30 scans a second: 3 rad/s, and |sin| has a period of pi.
_DUMMY_PERIOD_NS = round(math.pi / 3.0 * 1e9)

_LEVEL_M = 1e-6
"""A laser up to this height is in the plane of the map, and measures no floor."""

_WALL_HEIGHT_M = 2.5
_FARTHEST = 1000  # cells; a smaller square is free as well

# The state of all rays while they are cast has these rows; the first five are pairs, along columns and rows.
_CELL, _BORDER, _START, _SPEED, _STRIDE = (slice(row, row + 2) for row in range(0, 10, 2))
_BASE, _WAY, _NUMBER = 10, 11, 12

_Array = NDArray[np.float64]


class SimulatedLaser:
    """A laser scanner that measures the occupied cells of ``grid``; outside of it all is free.

    ``angle_min`` and ``angle_increment`` [rad], ``ray_ns`` [ns], ``range_min`` and ``range_max`` [m] and
    ``frame`` are those of a Scan of ``ray_count`` rays, by default of ROS 2's dummy_laser. ``noise_m`` is
    the standard deviation of Gaussian noise on each measured range [m], drawn from ``seed``. Raises
    InvalidInput for a geometry that a Scan refuses, and for a grid whose origin is tilted or has a z.
    """

    def __init__(
        self,
        grid: Grid,
        *,
        angle_min: float = DUMMY_ANGLE_MIN,
        angle_increment: float = DUMMY_ANGLE_INCREMENT,
        ray_count: int = DUMMY_RAY_COUNT,
        ray_ns: int = 0,
        range_min: float = 0.0,
        range_max: float = DUMMY_RANGE_MAX,
        frame: str = "laser",
        noise_m: float = 0.0,
        seed: int | None = None,
    ) -> None:
        if operator.index(ray_count) < 1:
            raise InvalidInput(f"a laser has one ray or more; got ray_count={ray_count!r}")
        if not 0.0 <= noise_m < math.inf:
            raise InvalidInput(f"noise_m is a standard deviation [m], finite and 0 or more; got {noise_m!r}")
        # Checks the geometry.
        rays = Scan(0, angle_min, angle_increment, ray_ns, np.zeros(ray_count), range_min, range_max, frame)
        self._rays = rays
        self._angles = rays.angle_min + rays.angle_increment * np.arange(ray_count)
        self._resolution = grid.resolution
        self._origin = grid.planar_origin()
        self._grid = grid
        self._distances = free_distances(grid.cells >= OCCUPIED_FROM)
        self._noise_m = noise_m
        self._random = np.random.default_rng(seed)

    @property
    def sweep_ns(self) -> int:
        """The time from the first ray to the last [ns]."""
        return self._rays.end_stamp

    def is_on_map(self, x: float, y: float) -> bool:
        """Whether a sensor at x, y [m] in the grid's frame is inside the grid."""
        return self._grid.covers(x, y)

    def stamps(self, stamp: int) -> NDArray[np.int64]:
        """The instant of each ray [ns] of the scan that starts at ``stamp``: (ray_count,)."""
        return self._rays.stamps() + stamp

    def scan(self, stamp: int, x: ArrayLike, y: ArrayLike, yaw: ArrayLike) -> Scan:
        """The scan that starts at ``stamp`` [ns]; ``x``, ``y`` and ``yaw`` as of ``ranges``."""
        return replace(self._rays, stamp=stamp, ranges=self.ranges(x, y, yaw))

    def scan_in_space(self, stamp: int, poses: ArrayLike) -> Scan:
        """The scan that starts at ``stamp`` [ns] of a laser that may be tilted, as on an arm.

        ``poses`` (ray_count, 7), x y z [m], qx qy qz qw, are those of the sensor at each ray, in the grid's
        frame. Occupied cells are walls up to z = 2.5 m; a laser above z = 0 measures a floor there as well.
        """
        array = real_numbers(poses, "poses")
        if array.shape != (len(self._angles), 7):
            raise InvalidInput(
                f"poses of a laser have the shape ({len(self._angles)}, 7), one pose for each ray; got "
                f"{array.shape}"
            )
        x, y, z, *rotation = array.T
        qx, qy, qz, qw = rotation
        east, north, up = se3.rotate((qx, qy, qz, qw), (np.cos(self._angles), np.sin(self._angles), 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):  # vertical and level rays
            walls = self._cast(x, y, np.arctan2(north, east) - self._angles) / np.hypot(east, north)
            floor = np.where((z > _LEVEL_M) & (up < 0.0), -z / up, math.inf)
            walls[z + walls * up > _WALL_HEIGHT_M] = math.inf
        return replace(self._rays, stamp=stamp, ranges=self._measured(np.fmin(walls, floor)))

    def ranges(self, x: ArrayLike, y: ArrayLike, yaw: ArrayLike) -> NDArray[np.float32]:
        """The ranges [m] of a sensor at x, y [m], yaw [rad] in the grid's frame: (ray_count,).

        The pose is that of all rays, or an array (ray_count,) for a sensor that moves during the scan. As REP
        117 requires, a ray without a hit up to ``range_max`` is inf, one that hits below ``range_min`` is
        -inf. Raises InvalidInput for other shapes and for numbers that are not finite.
        """
        return self._measured(self._cast(x, y, yaw))

    def _cast(self, x: ArrayLike, y: ArrayLike, yaw: ArrayLike) -> _Array:
        """The horizontal distance to the wall [m] that each ray hits: (ray_count,), inf without one."""
        x, y, yaw = (self._by_ray(values, name) for values, name in ((x, "x"), (y, "y"), (yaw, "yaw")))
        corner_x, corner_y, corner_yaw = self._origin
        cosine, sine = math.cos(corner_yaw), math.sin(corner_yaw)
        east, north = (x - corner_x) / self._resolution, (y - corner_y) / self._resolution
        directions = self._angles + (yaw - corner_yaw)
        steps = cast_rays(
            self._distances,
            np.stack((cosine * east + sine * north, cosine * north - sine * east)),
            np.stack((np.cos(directions), np.sin(directions))),
            self._rays.range_max / self._resolution,
        )
        return steps * self._resolution

    def _measured(self, distances: _Array) -> NDArray[np.float32]:
        """What the sensor measures of ``distances`` [m] along its rays: with noise, within its limits."""
        ranges = distances.copy()
        if self._noise_m:
            ranges += self._random.normal(0.0, self._noise_m, len(ranges))
        ranges[ranges > self._rays.range_max] = math.inf
        ranges[ranges < self._rays.range_min] = -math.inf
        return ranges.astype(np.float32)

    def _by_ray(self, values: ArrayLike, name: str) -> _Array:
        array = real_numbers(values, name)
        count = len(self._angles)
        if array.shape not in ((), (count,)) or not np.isfinite(array).all():
            raise InvalidInput(
                f"{name} of a laser is one finite number, or {count} of them for {count} rays; got {values!r}"
            )
        return np.broadcast_to(array, (count,))


class MountedLaser(MountedSensor):
    """A RangeSource: the sweeps of ``laser`` on a robot whose transforms are in ``buffer``.

    Each ray is cast from the pose of the laser's frame ``frame`` at the ray's own stamp, in ``map_frame`` or
    in the root of the robot, see MountedSensor. The laser may be tilted, see ``scan_in_space``.
    """

    def __init__(self, laser: SimulatedLaser, buffer: TransformBuffer, frame: str, map_frame: str) -> None:
        super().__init__(buffer, frame, map_frame)
        self._laser = laser
        self._offsets = laser.stamps(0)
        self.is_off_map = False
        """Whether the laser was outside the map at its last sweep."""

    def read(self, stamp: int) -> Scan | None:
        """The sweep that ends at ``stamp`` [ns] at the latest, or None, as ``sweep`` returns it."""
        sweep = self.sweep(stamp, self._offsets)
        if sweep is None:
            return None
        self.is_off_map = not self._laser.is_on_map(*sweep.poses[-1, :2].tolist())
        return self._laser.scan_in_space(sweep.stamp, sweep.poses)


def free_distances(is_occupied: NDArray[np.bool_]) -> NDArray[np.int16]:
    """The Chebyshev distance of each cell to the nearest occupied one, at most 1000, with a border of zeros.

    (height + 2, width + 2), in two passes, down and up (Rosenfeld and Pfaltz, "Sequential operations in
    digital picture processing", 1966).
    """
    height, width = is_occupied.shape
    distances = np.where(is_occupied, 0, _FARTHEST).astype(np.int16)
    columns = np.arange(width, dtype=np.int32)
    for order in (range(height), range(height - 1, -1, -1)):
        previous = np.full(width, _FARTHEST, dtype=np.int16)
        for number in order:
            row = distances[number]
            np.minimum(row, previous + 1, out=row)
            np.minimum(row[1:], previous[:-1] + 1, out=row[1:])
            np.minimum(row[:-1], previous[1:] + 1, out=row[:-1])
            # Along the row, from the left and from the right.
            np.minimum(row, np.minimum.accumulate(row - columns) + columns, out=row)
            np.minimum(row, np.minimum.accumulate((row + columns)[::-1])[::-1] - columns, out=row)
            previous = row
    return np.pad(distances, 1)


def cast_rays(distances: NDArray[np.int16], start: _Array, direction: _Array, limit: float) -> _Array:
    """How far each ray goes until it enters an occupied cell, in cells: (N,), inf beyond ``limit``.

    ``start`` (2, N) has columns and rows with fractions, ``direction`` (2, N) unit vectors; ``distances`` as
    returned by ``free_distances``: rays stop in its border as they do in occupied cells.
    """
    flat = distances.reshape(-1)
    hits = np.full(start.shape[1], math.inf)
    rays = _started(start, direction, distances.shape)
    while rays.shape[1]:
        cell, border, start, speed, way = rays[_CELL], rays[_BORDER], rays[_START], rays[_SPEED], rays[_WAY]
        index = cell[0] * rays[_STRIDE][0] + cell[1] * rays[_STRIDE][1] + rays[_BASE]
        distance = flat[index.astype(np.intp)]
        is_going = (distance > 0) & (way <= limit)
        if 2 * np.count_nonzero(is_going) < len(is_going):
            is_hit = (distance == 0) & (way <= limit) & (cell < border).all(axis=0)
            hits[rays[_NUMBER][is_hit].astype(np.intp)] = way[is_hit]
            rays = rays[:, is_going]
            continue
        # The way to the end of the free square, along the axis where that is nearer. A ray in an occupied
        # cell has a square of size 0, and keeps its cell.
        edge = cell + distance
        leave = (edge - start) / speed
        nearer = np.minimum(leave[0], leave[1])
        np.copyto(way, nearer, where=distance > 0)
        along = np.maximum(np.minimum(np.floor(start + way * speed), edge - 1.0), cell)
        np.copyto(cell, np.where(leave == nearer, edge, along))
        np.minimum(cell, border, out=cell)
    return hits


def _started(start: _Array, direction: _Array, shape: tuple[int, ...]) -> _Array:
    """The state of rays where they start, or where they enter the grid: (13, N).

    Each axis is mirrored if the ray goes down it, so that all rays go up: cell i becomes cell -1 - i. The
    flat index of a cell, in an array of ``shape`` with the border, is _BASE + _CELL . _STRIDE.
    """
    is_mirrored = direction < 0.0
    height, width = shape
    sizes, strides = np.array([[width - 2], [height - 2]]), np.array([[1], [width]])
    rays = np.empty((13, start.shape[1]))
    rays[_START] = np.where(is_mirrored, -start, start)
    rays[_SPEED] = np.maximum(np.abs(direction), 1e-200)  # no division by zero
    rays[_BORDER] = np.where(is_mirrored, 0, sizes)
    rays[_STRIDE] = np.where(is_mirrored, -strides, strides)
    rays[_BASE] = strides.sum() - np.where(is_mirrored, strides, 0).sum(axis=0)
    rays[_NUMBER] = np.arange(start.shape[1])
    lowest = rays[_BORDER] - sizes
    ways = np.maximum(lowest - rays[_START], 0.0) / rays[_SPEED]
    rays[_WAY] = ways.max(axis=0)
    cells = np.floor(rays[_START] + rays[_WAY] * rays[_SPEED])
    rays[_CELL] = np.minimum(np.maximum(cells, lowest), rays[_BORDER])
    return rays


def dummy_scan(stamp: int, frame: str = "single_rrbot_hokuyo_link") -> Scan:
    """The scan of ROS 2's dummy_laser at ``stamp`` [ns], a function of the stamp alone.

    All rays have the range ``abs(sin(3 rad/s t))`` [m] and the stamp of the scan.
    """
    phase = math.pi * (stamp % _DUMMY_PERIOD_NS) / _DUMMY_PERIOD_NS
    ranges = np.full(DUMMY_RAY_COUNT, math.sin(phase))
    return Scan(stamp, DUMMY_ANGLE_MIN, DUMMY_ANGLE_INCREMENT, 0, ranges, 0.0, DUMMY_RANGE_MAX, frame)
