"""Framing: from where all of a robot is seen, and which robots a camera sees."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, Mask, Poses

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
_NOTHING = np.empty((0, 3))


Point = tuple[float, float, float]


class Camera(NamedTuple):
    """Where the user puts a camera and where it looks, in the fixed frame [m]; None is at all robots."""

    position: Point
    look_at: Point | None = None


class CameraPose(NamedTuple):
    """Where a camera stands and where it looks, in the fixed frame [m].

    ``floor`` is how high the floor lies, and ``reach`` how far it goes around the fixed frame's origin, a
    whole number of metres.
    """

    position: Point
    look_at: Point
    floor: float
    reach: int


class Sight(NamedTuple):
    """Whether a robot is in a picture; ``reason`` is why it is not, or only a part of it.

    ``root`` is the frame that the tree of its frames stands on, empty where it has no frame.
    """

    robot: str
    is_seen: bool
    reason: str = ""
    root: str = ""


def fit_camera(
    moment: FramePoses, placed: Poses, aspect: float = 1.0, corners: NDArray[np.float64] = _NOTHING
) -> CameraPose | None:
    """What shows all robots of a moment at once; None where none has a place in the fixed frame.

    ``placed`` are its frames in the fixed one, and ``corners`` (N, 3) those of what is drawn; ``aspect`` is
    the width of the picture by its height. Frames that belong to no moving track are not looked at when
    there are others: a map may begin far away.
    """
    points = placed[_robots(moment), :3]
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    points = np.concatenate((points, corners))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    nearer, right, up = ((points - middle) @ _axes(-_DIRECTION) * (-1.0, 1.0, 1.0)).T
    aside = np.maximum(np.abs(up) + _FLESH_M, (np.abs(right) + _FLESH_M) / aspect)
    away = float(np.max(nearer + aside / math.tan(0.5 * FIELD_OF_VIEW), initial=_NEAREST_M))
    # Whoever is placed by its hip stands lower than that.
    floor = min(0.0, float(points[:, 2].min()))
    reach = _SMALLEST_FLOOR + math.ceil(float(np.abs(points[:, :2]).max()))
    return CameraPose(_vector(middle + _ROOM * away * _DIRECTION), _vector(middle), floor, reach)


def seen_by(framing: CameraPose, points: NDArray[np.float64], aspect: float) -> Mask:
    """Which of the points (N, 3) in the fixed frame are in the picture; NaN is in none."""
    position = np.array(framing.position)
    ahead, right, up = ((points - position) @ _axes(np.subtract(framing.look_at, position))).T
    half = ahead * math.tan(0.5 * FIELD_OF_VIEW)
    with np.errstate(invalid="ignore"):
        return (ahead > 0.0) & (np.abs(up) <= half) & (np.abs(right) <= half * aspect)


def sights(
    moment: FramePoses, placed: Poses, framing: CameraPose, aspect: float, robots: Iterable[str]
) -> Iterator[Sight]:
    """Which of the robots are in the picture. A robot is where one of its frames is."""
    tree = moment.tree
    seen = seen_by(framing, placed[:, :3], aspect)
    rows: dict[str, list[int]] = {}
    for row, name in enumerate(tree.names):
        if "/" in name:
            rows.setdefault(name.partition("/")[0], []).append(row)
    for robot in robots:
        own = rows.get(robot)
        if own is None:
            yield Sight(robot, False, "its description has not been received")
            continue
        root = tree.names[int(tree.roots[own[0]])]
        reason = next((moment.reasons[row] for row in own if row in moment.reasons), "")
        if not seen[own].any():
            reason = reason or _reason_above(moment, own[0]) or "it is outside of what the camera sees"
        yield Sight(robot, bool(seen[own].any()), reason, root)


def _reason_above(moment: FramePoses, row: int) -> str:
    """Why a frame that the one of that row stands on has no pose, if so."""
    while row >= 0 and row not in moment.reasons:
        row = int(moment.tree.parents[row])
    return moment.reasons.get(row, "")


def _axes(ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """The directions ahead, right and up of a camera that looks ``ahead``, as columns."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    length = float(np.linalg.norm(right))
    # Straight up or down, any side is right; viser's page turns a little and finds one.
    right = right / length if length > 1e-9 else np.array((0.0, 1.0, 0.0))
    return np.stack((ahead, right, np.cross(right, ahead)), axis=1)


def _robots(moment: FramePoses) -> NDArray[np.bool_]:
    """The frames of robots: those that are called robot/link."""
    named = np.array(["/" in name for name in moment.tree.names], dtype=np.bool_)
    return named if named.any() else np.ones_like(named)


def _vector(values: NDArray[np.float64]) -> Point:
    x, y, z = values.tolist()
    return (x, y, z)
