"""Clouds without a sensor: a lidar that turns in a room with flat walls, on a robot too."""

from __future__ import annotations

import math
import operator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate import se3
from zstate.buffer.buffer import TransformBuffer
from zstate.checks import real_numbers
from zstate.clouds.cloud import Cloud
from zstate.errors import InvalidInput
from zstate.nodes.mounted_sensor import MountedSensor

_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")]
)
_BRIGHTEST = 255.0


class SimulatedLidar:
    """A lidar of ``rings`` lasers, which measure together ``columns`` times in a turn of ``turn_ns`` [ns].

    It turns counter-clockwise about the z axis of ``frame``, from the x axis on; its lasers have elevations
    from -22.5 to 22.5 degrees. It stands in a box of ``size`` [m], centred at x = y = 0 on the floor z = 0.
    ``noise_m`` is the standard deviation of Gaussian noise on each measured range [m], drawn from ``seed``.
    The intensity falls with the angle to the wall, from 255 to 0.
    """

    def __init__(
        self,
        *,
        rings: int = 128,
        columns: int = 1016,
        turn_ns: int = 100_000_000,
        size: tuple[float, float, float] = (12.0, 8.0, 3.0),
        frame: str = "lidar",
        noise_m: float = 0.0,
        seed: int | None = None,
    ) -> None:
        if min(operator.index(rings), operator.index(columns)) < 1:
            raise InvalidInput(f"a lidar has one laser and one column or more; got {rings} and {columns}")
        if not all(0.0 < length < math.inf for length in size) or not 0.0 <= noise_m < math.inf:
            raise InvalidInput(
                f"a room has a size, positive and finite [m], and noise_m is 0 or more; got {size}, {noise_m}"
            )
        self._frame, self._noise_m = frame, noise_m
        length, width, height = size
        self._lowest = np.array([-length / 2, -width / 2, 0.0])
        self._highest = np.array([length / 2, width / 2, height])
        self._random = np.random.default_rng(seed)
        azimuths = np.repeat(np.linspace(0.0, math.tau, columns, endpoint=False), rings)
        elevations = np.tile(np.linspace(-math.pi / 8, math.pi / 8, rings), columns)
        level = np.cos(elevations)
        self._rays = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), np.sin(elevations)])
        self._offsets = np.arange(columns, dtype=np.int64) * turn_ns // columns
        self._empty = np.zeros(rings * columns, _POINT)
        self._empty["ring"] = np.tile(np.arange(rings), columns)
        self._empty["t"] = np.repeat(self._offsets, rings)

    def stamps(self, stamp: int) -> NDArray[np.int64]:
        """The instant of each column [ns] of the cloud that starts at ``stamp``: (columns,)."""
        return self._offsets + stamp

    def cloud(self, stamp: int, poses: ArrayLike) -> Cloud:
        """The cloud that starts at ``stamp`` [ns], column by column.

        ``poses`` (columns, 7), x y z [m], qx qy qz qw, are those of the lidar at each column, in the frame of
        the room. Rays that start outside of the room measure nothing: their points are NaN.
        """
        array = real_numbers(poses, "poses")
        if array.shape != (len(self._offsets), 7):
            raise InvalidInput(
                f"poses of a lidar have the shape ({len(self._offsets)}, 7), one for each column; got "
                f"{array.shape}"
            )
        x, y, z, qx, qy, qz, qw = np.repeat(array, len(self._empty) // len(array), axis=0).T
        directions = np.stack(se3.rotate((qx, qy, qz, qw), tuple(self._rays)), axis=-1)
        ranges, cosines = self._measured(np.stack([x, y, z], axis=-1), directions)
        if self._noise_m:
            ranges += self._random.normal(0.0, self._noise_m, len(ranges))
        points = self._empty.copy()
        for name, ray in zip("xyz", self._rays, strict=True):
            points[name] = ray * ranges
        points["intensity"] = np.rint(_BRIGHTEST * cosines)
        return Cloud(stamp, self._frame, points)

    def _measured(
        self, starts: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far each ray goes, NaN from outside of the room, and the cosine of its angle to the normal."""
        walls = np.where(directions > 0.0, self._highest, self._lowest)
        with np.errstate(divide="ignore", invalid="ignore"):  # rays along a wall
            ways = (walls - starts) / directions
        ways[directions == 0.0] = np.inf
        first = ways.argmin(axis=1, keepdims=True)
        ranges = np.take_along_axis(ways, first, axis=1)[:, 0]
        is_inside = ((starts >= self._lowest) & (starts <= self._highest)).all(axis=1)
        return np.where(is_inside, ranges, np.nan), np.abs(
            np.take_along_axis(directions, first, axis=1)[:, 0]
        )


class MountedLidar(MountedSensor):
    """A CloudSource: the sweeps of ``lidar`` on a robot whose transforms are in ``buffer``.

    Each column is measured from the pose of ``frame`` at its own stamp. The room stands in ``room_frame`` or
    in the root of the robot, see MountedSensor.
    """

    def __init__(self, lidar: SimulatedLidar, buffer: TransformBuffer, frame: str, room_frame: str) -> None:
        super().__init__(buffer, frame, room_frame)
        self._lidar = lidar
        self._offsets = lidar.stamps(0)

    def read(self, stamp: int) -> Cloud | None:
        """The sweep that ends at ``stamp`` [ns] at the latest, or None, as ``sweep`` returns it."""
        sweep = self.sweep(stamp, self._offsets)
        return None if sweep is None else self._lidar.cloud(sweep.stamp, sweep.poses)
