"""Surface: triangles with one look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zstate.model.shapes import Color


@dataclass(frozen=True)
class Look:
    """What a surface looks like: its colour (sRGB and opacity, 0..1), or an image laid over it.

    ``image`` are the bytes of a JPEG or PNG file; the colour is multiplied with it.
    """

    color: Color
    image: bytes | None = None


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles between points [m]; neighbours that share a point are shaded as one smooth piece.

    ``points`` are (V, 3), ``triangles`` (F, 3) rows of them. ``uv`` (V, 2) says where in an image each
    point lies, counted from the lower left; ``colors`` (V, 4), 0..255, colour each point. ``look`` is
    None where the file does not say, and the URDF may.
    """

    points: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    look: Look | None = None
    uv: NDArray[np.float32] | None = None
    colors: NDArray[np.uint8] | None = None

    def normals(self) -> NDArray[np.float32]:
        """The direction in which each point faces: the mean of its triangles, large ones counting more."""
        corners = self.points[self.triangles].astype(np.float64)
        facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        rows = self.triangles.ravel()
        sums = np.zeros((len(self.points), 3))
        for k in range(3):
            sums[:, k] = np.bincount(rows, np.repeat(facing[:, k], 3), len(self.points))
        return directions(sums).astype(np.float32)


def directions(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each vector (..., 3) at length one; +z where it has none."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(lengths > 0.0, vectors / lengths, (0.0, 0.0, 1.0))
