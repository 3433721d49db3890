"""Odometry: the path of each base whose pose has a covariance, and the ellipse that it is in."""

from __future__ import annotations

import math

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FrameTable
from zstate.buffer.tracks import PoseTrack
from zstate.errors import LookupFailed
from zstate.view.scene.world import DrawnFrames, move_node

_PERIOD_NS = 100_000_000
_ELLIPSE_SEGMENTS = 64
_LIFT_M = 0.005
_WIDTH_PX = 2.0
_LABEL = "position, 95 %"
_LABEL_SCALE = 0.85
_COLORS = ((25, 113, 194), (232, 89, 12), (47, 158, 68), (174, 62, 201))
_CHI_SQUARE_95 = -2.0 * math.log(0.05)
"""5.991, the 95 % quantile of chi-square with two degrees of freedom."""

Edge = tuple[str, str]


class OdometryPaths:
    """Draws every moving edge whose samples have covariances, such as odom -> base_link.

    The line is the path of the child's origin in the parent. The ellipse contains the true x and y with a
    probability of 95 %; it is drawn on the plane z = 0 of the parent, the ground of an odometry frame.
    ``show`` uses ``is_on`` and ``path_s``, the length of the line [s], which the page changes. To be used by
    one thread.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self.is_on = True
        self.path_s = 10.0
        self._scene = scene
        self._tree: FrameTable | None = None
        self._edges: list[Edge] = []
        self._paths: dict[Edge, EdgePath] = {}
        self._count = 0

    def show(self, buffer: TransformBuffer, place: DrawnFrames, at: int | None) -> None:
        """Draw the paths until ``at`` [ns]; None: until the newest samples."""
        if place.tree is not self._tree:
            self._tree, self._edges = place.tree, _uncertain_edges(place.tree)
            for edge in self._paths.keys() - set(self._edges):
                self._paths.pop(edge).remove()
        for edge in self._edges:
            if edge not in self._paths:
                color = _COLORS[self._count % len(_COLORS)]
                self._paths[edge] = EdgePath(self._scene, f"/odometry/{self._count}", edge, color)
                self._count += 1
            self._paths[edge].show(buffer, place, at, self.path_s if self.is_on else 0.0)


def _uncertain_edges(tree: FrameTable) -> list[Edge]:
    """The moving edges whose samples have covariances: (parent, child)."""
    return [
        (tree.names[int(tree.parents[row])], tree.names[row])
        for row, track in enumerate(tree.tracks)
        if isinstance(track, PoseTrack) and track.has_covariances
    ]


class EdgePath:
    """The drawn path and ellipse of ``edge``, (parent, child), in a node that is at the parent.

    A label at the ellipse shows what it is.
    """

    def __init__(self, scene: viser.SceneApi, path: str, edge: Edge, color: tuple[int, int, int]) -> None:
        self._scene = scene
        self._path = path
        self._edge = edge
        self._color = color
        self._root = scene.add_frame(path, show_axes=False)
        self._line: viser.LineSegmentsHandle | None = None
        self._ellipse: viser.LineSegmentsHandle | None = None
        self._label: viser.LabelHandle | None = None
        self._drawn: tuple[int, float] | None = None

    def show(self, buffer: TransformBuffer, place: DrawnFrames, at: int | None, path_s: float) -> None:
        """Draw the last ``path_s`` seconds until ``at``; nothing without, or if it has no pose."""
        pose, newest = place.pose(self._edge[0]), _newest(buffer, self._edge)
        if pose is None or newest is None or path_s <= 0.0:
            self._root.visible = False
            return
        self._root.visible = True
        move_node(self._root, pose)
        end = newest if at is None else min(at, newest)
        if (end, path_s) != self._drawn:
            self._drawn = end, path_s
            self._line = self._drawn_line(self._line, "path", _path(buffer, self._edge, end, path_s))
            ellipse = _ellipse(buffer, self._edge, end)
            self._ellipse = self._drawn_line(self._ellipse, "ellipse", ellipse)
            self._show_label(ellipse)

    def _drawn_line(
        self, line: viser.LineSegmentsHandle | None, name: str, points: NDArray[np.float64]
    ) -> viser.LineSegmentsHandle | None:
        """Draw the line through ``points``, (N, 3), in the place of ``line``; none for fewer than two."""
        if line is not None:
            line.visible = len(points) > 1
        if len(points) < 2:
            return line
        segments = np.stack((points[:-1], points[1:]), axis=1).astype(np.float32)
        if line is not None and line.points.shape == segments.shape:
            line.points = segments
            return line
        if line is not None:
            line.remove()
        return self._scene.add_line_segments(
            f"{self._path}/{name}", segments, self._color, thickness=_WIDTH_PX, thickness_units="screen"
        )

    def _show_label(self, ellipse: NDArray[np.float64]) -> None:
        """Label the ellipse where its x is largest; hide the label of none."""
        if self._label is not None:
            self._label.visible = len(ellipse) > 0
        if len(ellipse) == 0:
            return
        if self._label is None:
            name = f"{self._path}/label"
            self._label = self._scene.add_label(
                name, _LABEL, font_screen_scale=_LABEL_SCALE, anchor="center-left"
            )
        x, y, z = ellipse[ellipse[:, 0].argmax()].tolist()
        self._label.position = (x, y, z)

    def remove(self) -> None:
        """Remove it from the scene."""
        self._root.remove()


def _newest(buffer: TransformBuffer, edge: Edge) -> int | None:
    try:
        return buffer.latest(*edge)
    except LookupFailed:  # its samples were dropped, or the tree has changed since
        return None


def _path(buffer: TransformBuffer, edge: Edge, end: int, path_s: float) -> NDArray[np.float64]:
    """The positions of an edge's child until ``end``, ten a second: (N, 3).

    N depends on ``path_s`` alone, so that the browser keeps one line: unknown positions are the oldest known.
    """
    begin = end - round(path_s * 1e9)
    stamps = np.arange(begin + -begin % _PERIOD_NS, end, _PERIOD_NS)
    poses, valid = buffer.lookup_many(*edge, np.append(stamps, end))
    oldest = int(valid.argmax())
    positions = poses[:, :3]
    positions[:oldest] = positions[oldest]
    return positions[valid | (np.arange(len(valid)) < oldest)]


def _ellipse(buffer: TransformBuffer, edge: Edge, at: int) -> NDArray[np.float64]:
    """Points around the ellipse of an edge's child on the ground: (65, 3), (0, 3) if it is not known.

    The true x and y are inside with a probability of 95 %: with the covariance S of x and y, and L L^T = S,
    it is the image of the circle with radius sqrt(5.991) under L.
    """
    try:
        transform = buffer.lookup(*edge, at)
    except LookupFailed:
        return np.empty((0, 3))
    if transform.covariance is None:
        return np.empty((0, 3))
    variances, axes = np.linalg.eigh(transform.covariance[:2, :2])
    half_axes = axes * np.sqrt(_CHI_SQUARE_95 * np.maximum(variances, 0.0))
    angles = np.linspace(0.0, math.tau, _ELLIPSE_SEGMENTS + 1)
    points = np.full((_ELLIPSE_SEGMENTS + 1, 3), _LIFT_M)
    points[:, :2] = (
        transform.translation[:2] + np.stack((np.cos(angles), np.sin(angles)), axis=1) @ half_axes.T
    )
    return points
