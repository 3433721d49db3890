"""Edges of meshes as a camera sees them: outlines of round parts, and sharp edges."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate import se3
from zstate.cameras.surfaces import Corners, simplified
from zstate.model.geometry import MeshFile, Shape
from zstate.model.mesh_paths import MeshPaths, MissingFile
from zstate.view.mesh_geometry import Mesh, directions, groups, primitive
from zstate.view.meshes import UnreadableFile, read_mesh
from zstate.view.scene.robot_meshes import RobotKind

_SHARP = np.cos(np.radians(35.0))

Lines = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """The edges of the meshes of one link, in its frame.

    ``ends`` (E, 2, 3) [m] are their points; ``faces`` (E, 2) the triangles beside each, the same one twice at
    a border. The plane of a triangle with the normal n and the distance d has the points n p = d: ``normals``
    (F, 3) and ``distances`` (F,) [m]. ``covers`` (C, 4, 3) [m] are the faces of the simplified meshes, which
    hide what is behind them.
    """

    ends: Lines
    faces: NDArray[np.intp]
    normals: NDArray[np.float64]
    distances: NDArray[np.float64]
    is_sharp: NDArray[np.bool_]
    covers: Corners

    def seen_from(self, eye: ArrayLike) -> Lines:
        """The outline and the sharp edges on the near side, as ``eye`` (3,) [m] sees them: (K, 2, 3)."""
        is_near = self.normals @ np.asarray(eye, np.float64) > self.distances
        one, other = is_near[self.faces].T
        return self.ends[(one != other) | (self.is_sharp & one)]


def mesh_edges(points: NDArray[np.float64], triangles: NDArray[np.integer]) -> MeshEdges:
    """The edges of ``triangles`` (F, 3), rows of ``points`` (V, 3). Points at the same place count as one."""
    first, places = groups([points.astype(np.float32)])
    points, triangles = points[first], places[triangles]
    corners = points[triangles]
    normals = directions(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    pairs = np.sort(
        np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1
    )
    owners = np.tile(np.arange(len(triangles)), 3)
    keys = pairs[:, 0] * len(points) + pairs[:, 1]
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    seconds = np.minimum(starts + 1, len(order) - 1)
    is_shared = keys[order[seconds]] == keys[order[starts]]
    faces = owners[np.stack([order[starts], order[np.where(is_shared, seconds, starts)]], axis=1)]
    cosines = np.einsum("ij,ij->i", normals[faces[:, 0]], normals[faces[:, 1]])
    is_sharp = (cosines < _SHARP) | (faces[:, 0] == faces[:, 1])
    distances = np.einsum("ij,ij->i", normals, corners[:, 0])
    covers = np.concatenate(
        [np.zeros((0, 4, 3), np.float32), *(one for one, _ in simplified([(points, triangles, None)]))]
    )
    return MeshEdges(points[pairs[order[starts]]], faces, normals, distances, is_sharp, covers)


class RobotEdges:
    """The edges of the visuals of a robot, by link; read in a thread, until when there are none."""

    def __init__(self, kind: RobotKind) -> None:
        self.kind = kind
        self.links: Mapping[str, MeshEdges] = {}
        self.is_loaded = False
        threading.Thread(target=self._load, name="zstate-edges", daemon=True).start()

    def _load(self) -> None:
        paths, corners = MeshPaths(self.kind.base), dict[str, list[NDArray[np.float64]]]()
        for shape in self.kind.shapes:
            if shape.role == "visual":
                corners.setdefault(shape.link, []).extend(
                    _corners(mesh, shape) for mesh in _meshes(shape, paths)
                )
        joined = {link: np.concatenate(some).reshape(-1, 3) for link, some in corners.items() if some}
        self.links = {
            link: mesh_edges(some, np.arange(len(some)).reshape(-1, 3)) for link, some in joined.items()
        }
        self.is_loaded = True


def _meshes(shape: Shape, paths: MeshPaths) -> Sequence[Mesh]:
    """The meshes of a shape; none of a file that cannot be read, which the scene reports."""
    geometry = shape.geometry
    if not isinstance(geometry, MeshFile):
        return [primitive(geometry, False)]
    path = paths.find(geometry.uri)
    try:
        return () if isinstance(path, MissingFile) else read_mesh(path)
    except (OSError, UnreadableFile):
        return ()


def _corners(mesh: Mesh, shape: Shape) -> NDArray[np.float64]:
    """The corners of the triangles of a mesh of ``shape``, in the frame of its link: (F, 3, 3) [m]."""
    scale = np.array(shape.geometry.scale if isinstance(shape.geometry, MeshFile) else (1.0, 1.0, 1.0))
    link_from_shape = se3.to_matrix(shape.origin)
    points = (mesh.points * scale) @ link_from_shape[:3, :3].T + link_from_shape[:3, 3]
    corners = points[mesh.triangles]
    is_mirrored = float(np.prod(scale)) < 0.0
    return corners[:, ::-1] if is_mirrored else corners
