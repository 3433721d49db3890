"""Which corners of triangles share a point: those that are one smooth piece, and look the same.

A browser shades the triangles around a shared point as one. Files of triangles without normals (STL)
share all points or none, and neither looks like the part: edges must be split, and round faces joined.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.view.geometry.surface import Look, Surface, directions

_SMOOTHEST_EDGE = np.cos(np.radians(35.0))
_MOST_COMPARED = 256  # so many triangles around one point are the middle of a disc
_STEPS = 512.0  # of a normal's component, so that rounding splits nothing

Corners = NDArray[np.float64]


def smooth(
    points: NDArray[np.float64],
    triangles: NDArray[np.intp],
    look: Look | None = None,
    *,
    normals: NDArray[np.float64] | None = None,
    uv: NDArray[np.float64] | None = None,
    colors: NDArray[np.uint8] | None = None,
) -> Surface:
    """A surface of ``points`` (V, 3), whose edges are sharp from 35 degrees on.

    ``normals`` (V, 3) say instead which triangles belong together, where the file knows; those of an
    exporter that made every triangle flat say nothing. Triangles that are none (of no area, or not
    finite) are left out.
    """
    with np.errstate(over="ignore"):
        points = points.astype(np.float32).astype(np.float64)  # as they will be drawn
    triangles = triangles[_proper(points, triangles)]
    rows = triangles.ravel()
    areas = _areas(points, triangles)
    facing = None if normals is None else directions(normals[rows])
    if facing is None or _is_faceted(areas, facing):
        facing = _facing(points[rows], areas)
    features: list[NDArray[Any]] = [points[rows].astype(np.float32), np.rint(facing * _STEPS)]
    features += [] if uv is None else [uv[rows].astype(np.float32)]
    features += [] if colors is None else [colors[rows]]
    first, shared = _same(features)
    kept = rows[first]
    return Surface(
        points[kept].astype(np.float32),
        shared.reshape(-1, 3).astype(np.uint32),
        look,
        None if uv is None else uv[kept].astype(np.float32),
        None if colors is None else colors[kept],
    )


def _proper(points: Corners, triangles: NDArray[np.intp]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        area = np.linalg.norm(_areas(points, triangles)[::3], axis=-1)
    return np.isfinite(area) & (area > 0.0)


def _areas(points: Corners, triangles: NDArray[np.intp]) -> Corners:
    """The area of each corner's triangle (3 F, 3), twice, pointing where it faces."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.repeat(np.cross(b - a, c - a), 3, axis=0)


def _is_faceted(areas: Corners, facing: Corners) -> bool:
    flat = np.einsum("ij,ij->i", directions(areas), facing) > 0.999
    return int(np.count_nonzero(flat)) > 0.98 * len(flat)


def _facing(corners: Corners, areas: Corners) -> Corners:
    """Where each corner faces: the mean of the triangles at its point that bend away little."""
    _, places = _same([corners.astype(np.float32)])
    order = np.argsort(places, kind="stable")
    counts = np.bincount(places)
    starts = np.cumsum(counts) - counts
    sums = np.empty_like(areas)
    for count in np.unique(counts).tolist():
        around = order[starts[counts == count][:, None] + np.arange(count)]
        sums[around] = _sums(areas[around])
    return directions(sums)


def _sums(areas: Corners) -> Corners:
    """Of points with as many triangles each: (P, K, 3) in and out."""
    if areas.shape[1] > _MOST_COMPARED:
        return np.broadcast_to(areas.sum(axis=1, keepdims=True), areas.shape)
    units = directions(areas)
    together = units @ units.transpose(0, 2, 1) > _SMOOTHEST_EDGE
    return together.astype(np.float64) @ areas


def _same(features: list[NDArray[Any]]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows that are equal in all features: the first of each kind, and the kind of each row.

    Compared by 64 bits made of each row, because sorting rows takes ten times as long.
    """
    columns = np.concatenate([np.asarray(one, dtype=np.float64) + 0.0 for one in features], axis=1)
    bits = columns.view(np.uint64)
    mixed = np.zeros(len(bits), dtype=np.uint64)
    for k in range(bits.shape[1]):
        mixed = (mixed ^ bits[:, k]) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    _, first, kinds = np.unique(mixed, return_index=True, return_inverse=True)
    return first, kinds
