"""Fewer points of clouds, as many as are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.clouds.cloud import Cloud

Rows = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ThinnedCloud:
    """Points of one cloud, spread evenly over its measurement.

    ``xyz`` (N, 3) [m] are finite, in ``frame``. ``stamps`` [ns] are those of the points (N,), or one for all;
    ``stamp`` is that of the cloud, ``end_stamp`` that of its last point. ``intensity``, ``ring`` (N,) and
    ``rgb`` (N, 3) are None if the cloud does not have them.
    """

    stamp: int
    end_stamp: int
    frame: str
    xyz: NDArray[np.float32]
    stamps: NDArray[np.int64] | int
    intensity: NDArray[np.float32] | None
    ring: NDArray[np.float32] | None
    rgb: NDArray[np.uint8] | None

    def __len__(self) -> int:
        """How many points it has."""
        return len(self.xyz)

    @property
    def nbytes(self) -> int:
        """The bytes of its arrays."""
        arrays = self.xyz, self.stamps, self.intensity, self.ring, self.rgb
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def thinned(self, most: int) -> ThinnedCloud:
        """At most ``most`` of its points."""
        if len(self) <= most:
            return self
        rows = spread_rows(len(self), most, self.stamp)
        return ThinnedCloud(
            self.stamp,
            self.end_stamp,
            self.frame,
            self.xyz[rows],
            self.stamps if isinstance(self.stamps, int) else self.stamps[rows],
            _selected(self.intensity, rows),
            _selected(self.ring, rows),
            _selected(self.rgb, rows),
        )


def thinned_cloud(cloud: Cloud, most: int) -> ThinnedCloud:
    """At most ``most`` of the points of ``cloud``, without those that are not finite.

    Raises InvalidInput for times of points that are no stamps.
    """
    stamps = cloud.stamps
    rows = np.flatnonzero(cloud.valid)
    rows = rows[spread_rows(len(rows), most, cloud.stamp)]
    return ThinnedCloud(
        cloud.stamp,
        cloud.end_stamp,
        cloud.frame,
        cloud.xyz[rows].astype(np.float32, copy=False),
        cloud.stamp if stamps is None else stamps[rows],
        _numbers(cloud.intensity, rows),
        _numbers(cloud.ring, rows),
        _selected(cloud.rgb, rows),
    )


def spread_rows(count: int, most: int, seed: int) -> Rows:
    """At most ``most`` of ``count`` rows: one in each of as many equal intervals, at random.

    Every n-th point would be one of the same few lasers, and the same one in each turn.
    """
    if count <= most:
        return np.arange(count)
    places = np.arange(most) + np.random.default_rng(abs(seed)).random(most)
    return np.minimum(places * (count / most), count - 1).astype(np.intp)


def _selected(values: NDArray[np.generic] | None, rows: Rows) -> Any:
    return None if values is None else values[rows]


def _numbers(values: NDArray[Any] | None, rows: Rows) -> NDArray[np.float32] | None:
    """One number for each of ``rows``; None if a field has several."""
    return None if values is None or values.ndim != 1 else values[rows].astype(np.float32)
