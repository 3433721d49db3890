"""Triangle meshes with a material: their normals, and meshes of boxes, cylinders and spheres.

A browser shades the triangles around a shared point as one smooth piece. Files of triangles without
normals (STL) share all points or none, and neither looks like the part: ``smooth_normals`` splits sharp edges
and joins round faces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.model.geometry import Box, Color, Cylinder, Sphere

_SMOOTHEST_EDGE = np.cos(np.radians(35.0))
_MAX_COMPARED = 256  # a point with more triangles is the middle of a disc
_STEPS = 512.0  # of a normal's component, so that rounding splits nothing
_SIDES = 32  # of a circle

Corners = NDArray[np.float64]


@dataclass(frozen=True)
class MeshMaterial:
    """The colour of a mesh (sRGB and opacity, 0..1), or its texture.

    ``image`` is the content of a JPEG or PNG file; the colour is multiplied with it.
    """

    color: Color
    image: bytes | None = None


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles between points [m]; triangles that share a point are shaded as one smooth piece.

    ``points`` (V, 3); ``triangles`` (F, 3) are rows of it; ``uv`` (V, 2) are texture coordinates from the
    lower left; ``colors`` (V, 4), 0..255, are those of the points. ``material`` is None if the file has none;
    the URDF may have one.
    """

    points: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    material: MeshMaterial | None = None
    uv: NDArray[np.float32] | None = None
    colors: NDArray[np.uint8] | None = None

    def normals(self) -> NDArray[np.float32]:
        """The normal of each point: the mean of its triangles, weighted by area."""
        rows, areas = self.triangles.ravel(), _areas(self.points.astype(np.float64), self.triangles)
        sums = np.zeros((len(self.points), 3))
        for k in range(3):
            sums[:, k] = np.bincount(rows, areas[:, k], len(self.points))
        return directions(sums).astype(np.float32)


def directions(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors (..., 3); +z for zero vectors."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(lengths > 0.0, vectors / lengths, (0.0, 0.0, 1.0))


def smooth_normals(
    points: NDArray[np.float64],
    triangles: NDArray[np.intp],
    material: MeshMaterial | None = None,
    *,
    normals: NDArray[np.float64] | None = None,
    uv: NDArray[np.float64] | None = None,
    colors: NDArray[np.uint8] | None = None,
) -> Mesh:
    """A mesh of ``points`` (V, 3) whose edges are sharp from 35 degrees on.

    ``normals`` (V, 3) of the file decide instead which triangles are one smooth piece, unless every triangle
    is flat. Triangles without area, or that are not finite, are left out.
    """
    with np.errstate(over="ignore"):
        points = points.astype(np.float32).astype(np.float64)  # as they will be drawn
    with np.errstate(invalid="ignore"):
        area = np.linalg.norm(_areas(points, triangles)[::3], axis=-1)
    triangles = triangles[np.isfinite(area) & (area > 0.0)]
    rows = triangles.ravel()
    areas = _areas(points, triangles)
    facing = None if normals is None else directions(normals[rows])
    if facing is not None:
        flat = np.einsum("ij,ij->i", directions(areas), facing) > 0.999
        facing = None if np.count_nonzero(flat) > 0.98 * len(flat) else facing
    if facing is None:
        facing = _normals(points[rows], areas)
    features: list[NDArray[Any]] = [points[rows].astype(np.float32), np.rint(facing * _STEPS)]
    features += [] if uv is None else [uv[rows].astype(np.float32)]
    features += [] if colors is None else [colors[rows]]
    first, shared = groups(features)
    kept = rows[first]
    return Mesh(
        points[kept].astype(np.float32),
        shared.reshape(-1, 3).astype(np.uint32),
        material,
        None if uv is None else uv[kept].astype(np.float32),
        None if colors is None else colors[kept],
    )


def _areas(points: Corners, triangles: NDArray[np.integer[Any]]) -> Corners:
    """Twice the area of each corner's triangle (3 F, 3), along its normal."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.repeat(np.cross(b - a, c - a), 3, axis=0)


def _normals(corners: Corners, areas: Corners) -> Corners:
    """The normal of each corner: the mean of the triangles at its point within 35 degrees."""
    _, places = groups([corners.astype(np.float32)])
    order = np.argsort(places, kind="stable")
    counts = np.bincount(places)
    starts = np.cumsum(counts) - counts
    sums = np.empty_like(areas)
    for count in np.unique(counts).tolist():
        around = order[starts[counts == count][:, None] + np.arange(count)]
        parts = areas[around]  # (P, K, 3): P points with K triangles each
        if count > _MAX_COMPARED:
            sums[around] = parts.sum(axis=1, keepdims=True)
        else:
            units = directions(parts)
            is_smooth = units @ units.transpose(0, 2, 1) > _SMOOTHEST_EDGE
            sums[around] = is_smooth.astype(np.float64) @ parts
    return directions(sums)


def groups(features: list[NDArray[Any]]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Groups of rows that are equal in all features: the first row of each, and the group of each row.

    Rows are compared by a 64-bit hash, because sorting rows takes ten times as long.
    """
    columns = np.concatenate([np.asarray(one, dtype=np.float64) + 0.0 for one in features], axis=1)
    bits = columns.view(np.uint64)
    mixed = np.zeros(len(bits), dtype=np.uint64)
    for k in range(bits.shape[1]):
        mixed = (mixed ^ bits[:, k]) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    _, first, kinds = np.unique(mixed, return_index=True, return_inverse=True)
    return first, kinds


def primitive(shape: Box | Cylinder | Sphere, textured: bool) -> Mesh:
    """The mesh of a shape, with texture coordinates if ``textured``.

    The image covers each side of a box; it goes once around a cylinder or a sphere, from the lower end
    to the upper.
    """
    if isinstance(shape, Box):
        return _box(shape, textured)
    if isinstance(shape, Cylinder):
        half = 0.5 * shape.length
        outline = [(0.0, -half), (shape.radius, -half), (shape.radius, half), (0.0, half)]
        return _revolved(outline, textured)
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _SIDES // 2 + 1)[1:-1]
    middle = [(shape.radius * np.cos(angle), shape.radius * np.sin(angle)) for angle in angles]
    return _revolved([(0.0, -shape.radius), *middle, (0.0, shape.radius)], textured)


def _box(box: Box, textured: bool) -> Mesh:
    """Two triangles for each side, counterclockwise from outside."""
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = np.array([(0, 1, 3, 2), (6, 7, 5, 4), (4, 5, 1, 0), (2, 3, 7, 6), (2, 6, 4, 0), (5, 7, 3, 1)])
    rows = np.arange(24).reshape(6, 4)
    triangles = np.concatenate([rows[:, [0, 1, 2]], rows[:, [0, 2, 3]]])
    uv = np.tile([(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)], (6, 1))
    return smooth_normals(corners[sides.ravel()] * box.size, triangles, uv=uv if textured else None)


def _revolved(outline: list[tuple[float, float]], textured: bool) -> Mesh:
    """The surface of revolution of an outline (radius, height), going up, about z."""
    radii, heights = np.array(outline).T
    turns = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    cosines, sines = np.cos(turns), np.sin(turns)
    cosines[-1], sines[-1] = cosines[0], sines[0]
    x, y = np.outer(radii, cosines), np.outer(radii, sines)
    points = np.stack([x, y, np.broadcast_to(heights[:, None], x.shape)], axis=-1).reshape(-1, 3)
    along = np.linspace(0.0, 1.0, len(outline))
    around = np.linspace(0.0, 1.0, _SIDES + 1)
    uv = np.stack(np.meshgrid(around, along), axis=-1).reshape(-1, 2)
    rows = np.arange(len(points)).reshape(x.shape)
    low, high, next_low, next_high = rows[:-1, :-1], rows[1:, :-1], rows[:-1, 1:], rows[1:, 1:]
    halves = [np.stack([low, next_low, next_high], axis=-1), np.stack([low, next_high, high], axis=-1)]
    triangles = np.concatenate([half.reshape(-1, 3) for half in halves])
    return smooth_normals(points, triangles, uv=uv if textured else None)
