"""The surfaces of boxes, cylinders and spheres, about their middle."""

from __future__ import annotations

import numpy as np

from zstate.model.shapes import Box, Cylinder, Sphere
from zstate.view.geometry.smoothing import smooth
from zstate.view.geometry.surface import Surface

_SIDES = 32  # of a circle


def primitive(shape: Box | Cylinder | Sphere, *, textured: bool = False) -> Surface:
    """The shape as triangles; ``textured`` when an image is to be laid over it.

    The image covers each side of a box; it goes once around a cylinder or a sphere, from the lower end
    to the upper.
    """
    if isinstance(shape, Box):
        return _box(shape, textured)
    if isinstance(shape, Cylinder):
        half = 0.5 * shape.length
        outline = [(0.0, -half), (shape.radius, -half), (shape.radius, half), (0.0, half)]
        return _turned(outline, textured)
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _SIDES // 2 + 1)[1:-1]
    middle = [(shape.radius * np.cos(angle), shape.radius * np.sin(angle)) for angle in angles]
    return _turned([(0.0, -shape.radius), *middle, (0.0, shape.radius)], textured)


def _box(box: Box, textured: bool) -> Surface:
    """Each side is two triangles, seen counterclockwise from outside."""
    corners = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = np.array([(0, 1, 3, 2), (6, 7, 5, 4), (4, 5, 1, 0), (2, 3, 7, 6), (2, 6, 4, 0), (5, 7, 3, 1)])
    rows = np.arange(24).reshape(6, 4)
    triangles = np.concatenate([rows[:, [0, 1, 2]], rows[:, [0, 2, 3]]])
    uv = np.tile([(0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)], (6, 1))
    return smooth(corners[sides.ravel()] * box.size, triangles, uv=uv if textured else None)


def _turned(outline: list[tuple[float, float]], textured: bool) -> Surface:
    """What an outline of radius and height, going up, becomes when it is turned about z."""
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
    return smooth(points, triangles, uv=uv if textured else None)
