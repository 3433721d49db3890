"""Surfaces that a simulated camera sees: shapes of links, a floor and the walls of a grid.

They are flat faces, small enough that sorting them by their distance shows the near ones in front.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.checks import real_numbers
from zstate.errors import InvalidInput
from zstate.model.geometry import Box, Color, Cylinder, MeshFile, Shape, Sphere, read_shapes
from zstate.model.robot import RobotModel
from zstate.se3 import to_matrix

Floats = NDArray[np.float64]
Corners = NDArray[np.float32]

_FACE_M, _MOST_FACES = 0.05, 16
"""Sides are cut into faces of this length, but not into more than so many."""
_SIDES = 16
_MOST_MESH_FACES = 400
_MESH_STEPS = (32, 24, 16, 12, 8, 6)
"""A mesh file with more faces is simplified: its longest side has so many steps, the most that suffice."""

_FLOOR_TILE_M, _WALL_TILE_M, _WALL_HEIGHT_M = 0.25, 0.5, 2.5
_GREY = (189, 191, 196)
_FLOOR_TONES, _WALL_TONES = ((214, 210, 200), (150, 152, 156)), ((222, 205, 176), (196, 178, 150))


@dataclass(frozen=True, eq=False)
class Surface:
    """Flat faces of one colour each, in the frame of a body.

    ``corners`` (N, 4, 3) [m] are counterclockwise from the side that is seen; a triangle has one of them
    twice. ``colors`` (N, 3) are RGB, 0 to 255. A ``is_ground`` surface is below all others.
    """

    corners: Corners
    colors: NDArray[np.uint8]
    is_ground: bool = False

    def __post_init__(self) -> None:
        count = len(self.corners)
        if self.corners.shape != (count, 4, 3) or self.colors.shape != (count, 3):
            raise InvalidInput(
                "a surface has corners (N, 4, 3) and colors (N, 3); got "
                f"{self.corners.shape} and {self.colors.shape}"
            )

    def __len__(self) -> int:
        return len(self.corners)


_EMPTY = (Surface(np.zeros((0, 4, 3), np.float32), np.zeros((0, 3), np.uint8)),)


class MeshPart(NamedTuple):
    """Triangles of a mesh file: ``points`` (V, 3) [m], ``triangles`` (F, 3), rows of them.

    ``color`` is None if the file has none: then it is that of the URDF.
    """

    points: ArrayLike
    triangles: ArrayLike
    color: Color | None


MeshReader: TypeAlias = Callable[[MeshFile], Sequence[MeshPart]]
"""Returns the parts of a mesh file of a URDF, scaled; none if it cannot be read."""


def robot_surfaces(model: RobotModel, read_mesh: MeshReader = lambda _: ()) -> dict[str, Surface]:
    """What is seen of each link of a robot, by its name: its <visual> shapes.

    Mesh files are left out unless ``read_mesh`` reads them, see MeshReader. A mesh of more than 400
    faces is simplified to fewer. Textures are not drawn.
    """
    shapes = [shape for shape in read_shapes(model)[0] if shape.role == "visual"]
    parts = {link: [*_EMPTY] for link in model.links}
    for shape in shapes:
        parts[shape.link] += _shape_surfaces(shape, read_mesh)
    return {
        link: Surface(
            np.concatenate([one.corners for one in found]), np.concatenate([one.colors for one in found])
        )
        for link, found in parts.items()
    }


def floor_surface(x: tuple[float, float], y: tuple[float, float]) -> Surface:
    """A checkered floor at z = 0 between two x and two y [m], with squares of 0.5 m from the origin on."""
    low = np.floor(np.array([x[0], y[0]]) / _FLOOR_TILE_M).astype(int)
    high = np.ceil(np.array([x[1], y[1]]) / _FLOOR_TILE_M).astype(int)
    columns: Floats = np.arange(low[0], high[0] + 1, dtype=np.float64)
    rows: Floats = np.arange(low[1], high[1] + 1, dtype=np.float64)
    points = np.stack(np.meshgrid(columns, rows, [0], indexing="ij"), axis=-1)[:, :, 0] * _FLOOR_TILE_M
    middles = points[:-1, :-1, :2].reshape(-1, 2) + _FLOOR_TILE_M / 2
    is_odd = np.floor(middles / (2 * _FLOOR_TILE_M)).astype(int).sum(axis=1) % 2
    return Surface(_patch(points), np.array(_FLOOR_TONES, np.uint8)[is_odd], is_ground=True)


def wall_surface(
    is_occupied: ArrayLike, resolution: float, corner: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Surface:
    """The walls of a grid, 2.5 m high: where a cell of ``is_occupied`` (height, width) meets a free one.

    Cells are ``resolution`` [m] wide; ``corner`` is x, y [m], yaw [rad] of cell (0, 0), as of a map.
    """
    cells = np.asarray(is_occupied, dtype=np.bool_)
    if cells.ndim != 2 or not 0.0 < resolution < math.inf:
        raise InvalidInput(
            f"a grid has cells (height, width) and a resolution [m]; got {cells.shape} and {resolution!r}"
        )
    most = max(1, round(_WALL_TILE_M / resolution))
    across = np.array(list(_borders(cells, most)), np.float64).reshape(-1, 2, 2)
    along = np.array(list(_borders(cells.T, most)), np.float64).reshape(-1, 2, 2)
    ends = np.concatenate([across, along[:, ::-1, ::-1]]) * resolution  # a mirror turns them around
    x, y, yaw = corner
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    ends = ends @ turn + (x, y)
    heights = np.linspace(0.0, _WALL_HEIGHT_M, round(_WALL_HEIGHT_M / _WALL_TILE_M) + 1)
    floors = np.broadcast_to(heights[:, None, None], (len(heights), *ends.shape[:2]))
    lines = np.concatenate(
        [np.broadcast_to(ends, (len(heights), *ends.shape)), floors[..., None]], axis=-1
    )  # (heights, N, ends, xyz)
    corners = np.stack([lines[:-1, :, 0], lines[:-1, :, 1], lines[1:, :, 1], lines[1:, :, 0]], axis=2)
    is_odd = np.add.outer(np.arange(len(heights) - 1), np.arange(len(ends))) % 2
    return Surface(
        corners.reshape(-1, 4, 3).astype(np.float32), np.array(_WALL_TONES, np.uint8)[is_odd.ravel()]
    )


def _borders(
    cells: NDArray[np.bool_], most: int
) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """The ends of the walls along y, up to ``most`` cells long, in cells; the wall is on their left."""
    padded = np.pad(cells, ((0, 0), (1, 1)))
    left, right = padded[:, :-1], padded[:, 1:]
    for mask, is_facing_x in ((left & ~right, True), (~left & right, False)):
        changes = np.diff(np.pad(mask, ((1, 1), (0, 0))).astype(np.int8), axis=0)
        for column in np.flatnonzero(mask.any(axis=0)).tolist():
            starts, stops = (np.flatnonzero(changes[:, column] == sign).tolist() for sign in (1, -1))
            for start, stop in zip(starts, stops, strict=True):
                for first in range(start, stop, most):
                    one, other = (column, first), (column, min(first + most, stop))
                    yield (one, other) if is_facing_x else (other, one)


def _shape_surfaces(shape: Shape, read_mesh: MeshReader) -> Iterator[Surface]:
    geometry = shape.geometry
    if isinstance(geometry, MeshFile):
        parts = [
            (real_numbers(points, "points"), np.asarray(triangles, dtype=np.intp), color)
            for points, triangles, color in read_mesh(geometry)
        ]
        for corners, color in simplified(parts):
            yield _placed(shape, corners, shape.color if color is None else color)
    else:
        yield _placed(shape, _primitive(geometry), shape.color)


def _placed(shape: Shape, corners: Corners, color: Color | None) -> Surface:
    matrix = to_matrix(shape.origin)
    placed = corners @ matrix[:3, :3].T + matrix[:3, 3]
    rgb = np.array(_GREY if color is None else np.array(color[:3]) * 255.0 + 0.5, dtype=np.uint8)
    return Surface(placed.astype(np.float32), np.broadcast_to(rgb, (len(corners), 3)))


def _primitive(shape: Box | Cylinder | Sphere) -> Corners:
    if isinstance(shape, Box):
        return _box(shape)
    if isinstance(shape, Cylinder):
        half, radius = 0.5 * shape.length, shape.radius
        steps = np.linspace(-half, half, _steps(shape.length) + 1).tolist()
        return _revolved([(0.0, -half), *((radius, height) for height in steps), (0.0, half)])
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _SIDES // 2 + 1)
    outline = np.stack([np.cos(angles), np.sin(angles)], axis=1) * shape.radius
    return _revolved(outline.tolist())


def _box(box: Box) -> Corners:
    sides: list[Corners] = []
    halves = [0.5 * length for length in box.size]
    for axis in range(3):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        along = np.linspace(-halves[one], halves[one], _steps(box.size[one]) + 1)
        across = np.linspace(-halves[other], halves[other], _steps(box.size[other]) + 1)
        points = np.zeros((len(along), len(across), 3))
        points[:, :, one], points[:, :, other] = along[:, None], across[None, :]
        for sign in (1.0, -1.0):
            points[:, :, axis] = sign * halves[axis]
            sides.append(_patch(points if sign > 0.0 else points[::-1]))
    return np.concatenate(sides)


def _revolved(outline: list[tuple[float, float]]) -> Corners:
    """The surface of revolution of an outline (radius, height), going up, about z."""
    radii, heights = np.array(outline).T
    turns = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    x, y = np.outer(np.cos(turns), radii), np.outer(np.sin(turns), radii)
    return _patch(np.stack([x, y, np.broadcast_to(heights, x.shape)], axis=-1))


def _patch(points: Floats) -> Corners:
    """The faces of a net of points (rows, columns, 3), counterclockwise if rows turn left into columns."""
    corners = [points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]]
    return np.stack(corners, axis=2).reshape(-1, 4, 3).astype(np.float32)


def _steps(length: float) -> int:
    return min(max(round(length / _FACE_M), 1), _MOST_FACES)


def simplified(
    parts: Sequence[tuple[Floats, NDArray[np.intp], Color | None]],
) -> list[tuple[Corners, Color | None]]:
    """The faces of the parts of a mesh and their colours, as fine as 400 faces allow."""
    longest = max((float(np.ptp(points, axis=0).max()) for points, _, _ in parts if len(points)), default=0.0)
    faces: list[tuple[Corners, Color | None]] = []
    for steps in _MESH_STEPS if longest else ():
        faces = [
            (_clustered(points, triangles, longest / steps), color) for points, triangles, color in parts
        ]
        if sum(len(corners) for corners, _ in faces) <= _MOST_MESH_FACES:
            break
    return faces


def _clustered(points: Floats, triangles: NDArray[np.intp], cell: float) -> Corners:
    """The triangles that are left if the points in each cube of a grid become one, which is their mean.

    Vertex clustering (Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex
    scenes", 1993).
    """
    _, group = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
    group = group.ravel()
    counts = np.bincount(group)
    means = np.stack([np.bincount(group, column) / counts for column in points.T], axis=1)
    rows = group[triangles]
    a, b, c = rows.T
    rows = rows[(a != b) & (b != c) & (c != a)]
    turns = rows.argmin(axis=1)[:, None] + np.arange(3)  # the same triangle begins with the same point
    rows = np.unique(np.take_along_axis(rows, turns % 3, axis=1), axis=0)
    return means[rows[:, [0, 1, 2, 2]]].astype(np.float32)
