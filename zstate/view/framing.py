"""Framing: from where all of a robot is seen."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.view.moment import Moment, Poses

FIELD_OF_VIEW = math.radians(45.0)
"""Of the camera, from the upper to the lower edge of the picture [rad]."""

# A robot looks along its x: it is seen from the front, from its left, a little from above.
_DIRECTION = np.array([1.0, 0.75, 0.45]) / np.linalg.norm([1.0, 0.75, 0.45])
# Frames are where links begin; how far their meshes go beyond, nobody asked yet.
_FLESH_M = 0.12
_NEAREST_M = 0.6
_SMALLEST_FLOOR = 3
# What is cut off by a hair looks like a mistake.
_ROOM = 1.08


class Framing(NamedTuple):
    """Where a camera stands and where it looks, in the fixed frame [m].

    ``floor`` is how high the floor lies, and ``reach`` how far it goes around the fixed frame's origin, a
    whole number of metres.
    """

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    floor: float
    reach: int


def framing_of(moment: Moment, placed: Poses) -> Framing | None:
    """What shows all robots of a moment at once; None where none has a place in the fixed frame.

    ``placed`` are its frames in the fixed one. Frames that belong to no moving track are not looked at
    when there are others: a map may begin far away.
    """
    points = placed[_robots(moment), :3]
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    nearer = (points - middle) @ _DIRECTION
    aside = np.linalg.norm(points - middle - nearer[:, None] * _DIRECTION, axis=1) + _FLESH_M
    away = float(np.max(nearer + aside / math.tan(0.5 * FIELD_OF_VIEW), initial=_NEAREST_M))
    # Whoever is placed by its hip stands lower than that.
    floor = min(0.0, float(points[:, 2].min()))
    reach = _SMALLEST_FLOOR + math.ceil(float(np.abs(points[:, :2]).max()))
    return Framing(_vector(middle + _ROOM * away * _DIRECTION), _vector(middle), floor, reach)


def _robots(moment: Moment) -> NDArray[np.bool_]:
    """The frames of robots: those that are called robot/link."""
    named = np.array(["/" in name for name in moment.tree.names], dtype=np.bool_)
    return named if named.any() else np.ones_like(named)


def _vector(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)
