"""The laser_geometry of ROS 1 in this process: a scan placed by the poses of its first and its last ray.

``compile_library`` needs g++ and Debian's ``liblaser-geometry-dev``.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zstate import Transform

SOURCE = Path(__file__).with_suffix(".cpp")
PACKAGE = "liblaser-geometry-dev"


def version() -> str | None:
    """The version that is installed, None without it or without a compiler."""
    if not (shutil.which("pkg-config") and shutil.which("g++")):
        return None
    found = subprocess.run(
        ["pkg-config", "--modversion", "laser_geometry"], capture_output=True, text=True, check=False
    )
    return found.stdout.strip() if found.returncode == 0 else None


def compile_library(folder: Path) -> ctypes.CDLL:
    """The functions of laser_geometry.cpp, compiled in ``folder`` with the options of Debian's packages."""
    asked = ["pkg-config", "--cflags", "--libs", "laser_geometry"]
    options = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.split()
    library = folder / "laser_geometry_bench.so"
    command = ["g++", "-O3", "-shared", "-fPIC", "-o", str(library), str(SOURCE), *options]
    subprocess.run(command, check=True)
    functions = ctypes.CDLL(str(library))
    functions.projector_new.restype = ctypes.c_void_p
    functions.projector_points.restype = ctypes.c_int64
    return functions


class Projector:
    """A ``LaserProjection`` and a tf2 buffer."""

    def __init__(self, functions: ctypes.CDLL) -> None:
        self._functions = functions
        self._self = ctypes.c_void_p(functions.projector_new())

    def insert(self, transform: Transform, *, is_static: bool = False) -> None:
        """Add ``transform`` to the buffer."""
        names = transform.target.encode(), transform.source.encode()
        stamp = ctypes.c_int64(transform.stamp or 0)
        pose = np.ascontiguousarray(transform.pose7)
        self._functions.projector_add(self._self, *names, stamp, _pointer(pose), int(is_static))

    def set_scan(self, frame: str, stamp: int, turn_s: float, ranges: NDArray[np.float32]) -> None:
        """A full turn of rays from ``stamp`` [ns] on, the last of them ``turn_s`` after the first."""
        angles = np.array([-np.pi, 2.0 * np.pi / len(ranges)])
        times = ctypes.c_int64(stamp), ctypes.c_double(turn_s), ctypes.c_int64(len(ranges))
        self._functions.projector_set_scan(
            self._self, frame.encode(), *times, _pointer(ranges), _pointer(angles)
        )

    def place(self, target: str) -> None:
        """``transformLaserScanToPointCloud``: what is measured."""
        self._functions.projector_place(self._self, target.encode())

    def points(self, count: int) -> NDArray[np.float32]:
        """The points that ``place`` has placed, (N, 3), at most ``count``."""
        points = np.empty((count, 3), np.float32)
        placed = self._functions.projector_points(self._self, ctypes.c_int64(count), _pointer(points))
        return points[:placed]

    def close(self) -> None:
        """Free the memory."""
        self._functions.projector_delete(self._self)


def _pointer(array: NDArray[np.float32 | np.float64]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
