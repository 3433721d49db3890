"""Camera poses that show all robots, and which robots a camera sees."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, Poses

FIELD_OF_VIEW = math.radians(45.0)
"""Vertical field of view of the camera [rad]."""

# Robots face along x: seen from the front, from their left, a little from above.
_DIRECTION = np.array([1.0, 0.75, 0.45]) / np.linalg.norm([1.0, 0.75, 0.45])
# Frames are where links begin; this is for meshes that are not loaded yet.
_MESH_MARGIN_M = 0.12
_MIN_DISTANCE_M = 0.6
_MIN_FLOOR_M = 3
# Room at the edges of the picture: a robot that touches them looks cut off.
_ROOM = 1.08
_AROUND_M = 2.5
"""How much of a map around the robots is in the picture [m]."""
_NO_POINTS = np.empty((0, 3))

Point = tuple[float, float, float]


class Camera(NamedTuple):
    """The user's camera: position and the point it looks at, in the fixed frame [m]; None: all robots."""

    position: Point
    look_at: Point | None = None


class CameraPose(NamedTuple):
    """Position of a camera and the point it looks at, in the fixed frame [m].

    ``floor`` is the height of the floor; it extends ``reach`` around the fixed frame's origin, a whole number
    of metres.
    """

    position: Point
    look_at: Point
    floor: float
    reach: int


class Visibility(NamedTuple):
    """Whether a robot is in a picture; ``reason`` is why it is not, or only a part of it.

    ``root`` is the root of its frame tree, empty if it has no frame.
    """

    robot: str
    is_visible: bool
    reason: str = ""
    root: str = ""


def fit_camera(
    snapshot: FramePoses,
    poses: Poses,
    aspect: float = 1.0,
    corners: NDArray[np.float64] = _NO_POINTS,
    maps: NDArray[np.float64] = _NO_POINTS,
) -> CameraPose | None:
    """The camera that shows all robots of a snapshot, or all maps if there is no frame at all.

    None if none has a pose in the fixed frame. ``poses`` are its frames in the fixed frame, ``corners``
    (N, 3) those of the robots' meshes; ``aspect`` is width by height of the picture. Frames without a robot
    count only if there is no robot: a map may begin far away. Of ``maps``, whose corners are (N, 3), the part
    around the robots is in the picture.
    """
    of_robots = np.array(["/" in name for name in snapshot.tree.names], dtype=np.bool_)
    points = poses[of_robots if of_robots.any() else slice(None), :3]
    points = points[np.isfinite(points).all(axis=1)]
    if not snapshot.tree.names:
        points = maps
    if not len(points):
        return None
    points = np.concatenate((points, corners))
    around = points.min(axis=0) - _AROUND_M, points.max(axis=0) + _AROUND_M
    points = np.concatenate((points, np.clip(maps, *around)))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    nearer, right, up = ((points - middle) @ _axes(-_DIRECTION) * (-1.0, 1.0, 1.0)).T
    half = np.maximum(np.abs(up) + _MESH_MARGIN_M, (np.abs(right) + _MESH_MARGIN_M) / aspect)
    away = float(np.max(nearer + half / math.tan(0.5 * FIELD_OF_VIEW), initial=_MIN_DISTANCE_M))
    # A robot whose root is its hip stands lower than the fixed frame.
    floor = min(0.0, float(points[:, 2].min()))
    reach = _MIN_FLOOR_M + math.ceil(float(np.abs(points[:, :2]).max()))
    return CameraPose(_point(middle + _ROOM * away * _DIRECTION), _point(middle), floor, reach)


def robot_visibility(
    snapshot: FramePoses, poses: Poses, camera: CameraPose, aspect: float, robots: Iterable[str]
) -> Iterator[Visibility]:
    """Whether each robot is in the picture, which it is if one of its frames is."""
    tree = snapshot.tree
    position = np.array(camera.position)
    ahead, right, up = ((poses[:, :3] - position) @ _axes(np.subtract(camera.look_at, position))).T
    half = ahead * math.tan(0.5 * FIELD_OF_VIEW)
    with np.errstate(invalid="ignore"):  # frames without a pose, which are not seen
        seen = (ahead > 0.0) & (np.abs(up) <= half) & (np.abs(right) <= half * aspect)
    for robot in robots:
        links = [row for row, name in enumerate(tree.names) if name.startswith(f"{robot}/")]
        if not links:
            yield Visibility(robot, False, "its description has not been received")
            continue
        is_visible = bool(seen[links].any())
        reason = next((snapshot.reasons[row] for row in links if row in snapshot.reasons), "")
        ancestor = links[0]
        while not (is_visible or reason) and ancestor >= 0:
            reason = snapshot.reasons.get(ancestor, "")
            ancestor = int(tree.parents[ancestor])
        if not is_visible:
            reason = reason or "it is outside the camera's view"
        yield Visibility(robot, is_visible, reason, tree.names[int(tree.roots[links[0]])])


def _axes(ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """The directions ahead, right and up of a camera that looks ``ahead``, as columns."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    length = float(np.linalg.norm(right))
    # Straight up or down, every side is right; viser's page turns a little and finds one.
    right = right / length if length > 1e-9 else np.array((0.0, 1.0, 0.0))
    return np.stack((ahead, right, np.cross(right, ahead)), axis=1)


def _point(values: NDArray[np.float64]) -> Point:
    x, y, z = values.tolist()
    return (x, y, z)
