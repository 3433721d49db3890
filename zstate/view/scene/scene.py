"""The scene of the page: robots, frames, trails and labels, and where unconnected robots are placed."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Mask, Poses
from zstate.model.findings import Finding
from zstate.model.geometry import Shape, read_shapes
from zstate.model.robot import RobotModel
from zstate.view.meshes import Meshes, MeshLoader
from zstate.view.scene.cameras import Cameras
from zstate.view.scene.clouds import Clouds
from zstate.view.scene.frames import (
    Axes,
    FrameLabels,
    FrameNodes,
    NodeLabels,
    ParentLines,
    Trails,
    in_frame,
)
from zstate.view.scene.odometry import OdometryPaths
from zstate.view.scene.robot_meshes import InstancedMeshes, RenderStyle, RobotKind, RobotMeshes
from zstate.view.scene.world import World

_MIN_INSTANCES = 4  # identical robots that are drawn by instances
_GAP_M = 0.3
_MARGIN_M = 0.12  # of meshes around their frames
# Width of the layout divided by its depth: pictures are wider than high.
_ASPECT = 1.6

Offset = tuple[float, float, float]


class Scene:
    """Draws robots and frames at one instant after the other.

    Attributes, used by the next ``show``: ``visuals`` and ``collisions`` of robots (the latter translucent),
    and ``axes``, ``names`` and ``parent_lines`` of frames. ``layout`` places unconnected trees; ``world``
    draws scans and maps, ``clouds`` those of lidars, ``cameras`` pictures on frustums, ``odometry`` the paths
    of bases. Meshes and maps are loaded in the background; the scene is ``busy`` until all are drawn. To be
    used by one thread.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self.visuals = True
        self.collisions = False
        self.axes = True
        self.names = False
        self.parent_lines = False
        scene = self._scene = server.scene
        self._loader = MeshLoader(Meshes())
        self._single: dict[str, RobotMeshes] = {}
        self._instanced: dict[RobotKind, InstancedMeshes] = {}
        self._instanced_count = 0
        self._faults: dict[str, list[tuple[str, str]]] = {}
        self._stale: dict[str, str] = {}
        self._tree: FrameTable | None = None
        self._node_rows_of: tuple[FrameTable, tuple[str, ...]] | None = None
        self._node_rows: Mask = np.empty(0, dtype=np.bool_)
        self._first_frames: dict[str, str] = {}
        self._roots: dict[str, str] = {}
        self._nodes = FrameNodes(scene)
        self._axes = Axes(scene)
        self._names = FrameLabels(scene)
        self._lines = ParentLines(scene)
        self._trails = Trails(scene)
        self.world = World(scene)
        self.clouds = Clouds(scene)
        self.cameras = Cameras(scene)
        self.odometry = OdometryPaths(scene)
        self.layout = TreeLayout()
        self._stale_labels = NodeLabels(scene, "stale", anchor="top-center")
        self._tree_labels = NodeLabels(scene, "tree", anchor="bottom-center")

    @property
    def busy(self) -> bool:
        """Whether meshes or maps are still being loaded."""
        return self.world.busy or any(meshes.pending for meshes in self._meshes())

    def set_robot(
        self, name: str, model: RobotModel, shapes: Sequence[Shape] | None = None, base: Path | None = None
    ) -> None:
        """Add or replace a robot; its links are the frames ``name/link``.

        ``shapes`` default to those of its model. ``base`` is the folder of its URDF file, if the user named
        one: then every file in it can be loaded, otherwise only those in packages.
        """
        self._roots[name] = f"{name}/{model.root}"
        faults: Sequence[Finding] = ()
        if shapes is None:
            shapes, faults = read_shapes(model)
        self._remove_meshes(name)
        self._faults[name] = [(f"{name}, line {one.line}", one.message) for one in faults]
        kind = RobotKind(tuple(shapes), base)
        alike = [robot for robot, meshes in self._single.items() if meshes.kind == kind]
        if kind not in self._instanced and len(alike) + 1 < _MIN_INSTANCES:
            self._single[name] = RobotMeshes(self._scene, self._loader, kind, name)
            return
        for robot in alike:
            self._single.pop(robot).remove(self._nodes)
        if kind not in self._instanced:
            self._instanced_count += 1
            path = f"/instanced/{self._instanced_count}"
            self._instanced[kind] = InstancedMeshes(self._scene, self._loader, kind, path)
        self._instanced[kind].robots |= dict.fromkeys([*alike, name])

    def remove_robot(self, name: str) -> None:
        """Remove a robot, if it exists."""
        self._remove_meshes(name)
        self._faults.pop(name, None)
        self._roots.pop(name, None)
        self._stale.pop(name, None)

    def _remove_meshes(self, name: str) -> None:
        single = self._single.pop(name, None)
        if single is not None:
            single.remove(self._nodes)
        for kind, group in list(self._instanced.items()):
            group.robots.pop(name, None)
            if not group.robots:
                group.remove()
                del self._instanced[kind]

    def set_stale(self, robot: str, text: str | None) -> None:
        """Draw a stale robot in translucent grey, with ``text`` at its root; with None, as usual.

        Without a model the text is at the first frame of the robot.
        """
        if text is None:
            self._stale.pop(robot, None)
        else:
            self._stale[robot] = text

    def set_trail(self, frame: str, on: bool) -> None:
        """Start or remove the trail of a frame."""
        self._trails.set_trail(frame, on)

    @property
    def kinds(self) -> Mapping[str, RobotKind]:
        """The shapes of each robot with a model."""
        return {robot: meshes.kind for meshes in self._meshes() for robot in meshes.robots}

    def missing_meshes(self, robot: str) -> tuple[tuple[str, str], ...]:
        """Files of a robot that cannot be drawn: the name in the URDF, and the reason."""
        missing = chain.from_iterable(meshes.missing for meshes in self._meshes() if robot in meshes.robots)
        return (*self._faults.get(robot, ()), *((one.uri, one.why) for one in missing))

    def show(self, snapshot: FramePoses, fixed: str) -> Poses:
        """Draw everything at one instant, relative to the frame ``fixed``.

        Returns the pose of each frame, as ``snapshot.poses_in(fixed)``; trees that are not connected to the
        fixed frame have the poses at which they are drawn. Raises UnknownFrame.
        """
        tree = snapshot.tree
        if tree is not self._tree:
            self._tree = tree
            # Parents come first.
            self._first_frames = {name.partition("/")[0]: name for name in reversed(tree.names)}
        # At the model, not at an odometry frame of the robot far from it.
        frames = self._first_frames | {name: root for name, root in self._roots.items() if root in tree.index}
        stale = {frames[robot]: f"{robot}: {text}" for robot, text in self._stale.items() if robot in frames}
        placed = self.layout.placed(snapshot, fixed)
        on_links = (meshes.frames for meshes in self._single.values())
        with_nodes = self._rows_with_nodes(tree) if self.axes else np.zeros(len(tree.names), dtype=np.bool_)
        with_axes = (tree.names[row] for row in np.flatnonzero(with_nodes).tolist())
        carriers = tree.names if self.names else chain(stale, self.layout.labels, with_axes, *on_links)
        self._nodes.show(snapshot, placed, frozenset(carriers))
        shown = self._nodes.shown
        self._nodes.show_axes(with_nodes)
        for name, meshes in self._single.items():
            meshes.show(self._nodes, self._styles(name))
        for group in self._instanced.values():
            group.show(tree, placed, {name: self._styles(name) for name in group.robots})
        self._axes.show(self.axes, placed, shown & ~with_nodes)
        self._lines.show(self.parent_lines, placed, shown, tree.parents)
        self._names.show(self.names, snapshot, self._nodes)
        self._trails.show(snapshot, fixed, placed)
        self._stale_labels.show(stale, self._nodes)
        self._tree_labels.show(self.layout.labels, self._nodes)
        return placed

    def _rows_with_nodes(self, tree: FrameTable) -> Mask:
        """The frames of robots whose meshes are on nodes: so are their axes, which move with the meshes."""
        of = tree, tuple(self._single)
        if of != self._node_rows_of:
            self._node_rows_of = of
            robots = [name.partition("/")[0] for name in tree.names]
            self._node_rows = np.array([robot in self._single for robot in robots], dtype=np.bool_)
        return self._node_rows

    def corners(self, tree: FrameTable, placed: Poses) -> NDArray[np.float64]:
        """The corners of the bounding boxes of all loaded visuals with a known pose: (N, 3) [m]."""
        boxes = [np.empty((0, 3))]
        for frame, corners in chain.from_iterable(meshes.corners() for meshes in self._meshes()):
            row = tree.index.get(frame)
            if row is not None and np.isfinite(placed[row, 0]):
                boxes.append(in_frame(placed[row].tolist(), corners))
        return np.concatenate(boxes)

    def _meshes(self) -> chain[RobotMeshes | InstancedMeshes]:
        return chain(self._single.values(), self._instanced.values())

    def _styles(self, robot: str) -> set[RenderStyle]:
        styles: set[RenderStyle] = {"collision"} if self.collisions else set()
        if self.visuals:
            styles.add("stale" if robot in self._stale else "visual")
        return styles


class _Box(NamedTuple):
    """The space of a tree around its root [m]: centre and half size along x, y; lowest z."""

    middle: NDArray[np.float64]
    half: NDArray[np.float64]
    low: float


class TreeLayout:
    """Places trees that are not connected to the fixed frame next to it; their relative poses are unknown.

    They stand in rows, on one floor, as far apart as their robots reach; ``labels`` mark them, by root. A
    tree keeps its place while robots move. The layout is computed again, and ``version`` grows, when a tree
    appears or disappears, or more of its frames have a pose.
    """

    def __init__(self) -> None:
        self._laid_out_for: tuple[FrameTable, int, int] | None = None
        # By root: the frames of the tree, the number of them with a pose, and their box.
        self._boxes: dict[str, tuple[list[str], int, _Box]] = {}
        self._offsets: dict[str, Offset] = {}
        self.labels: dict[str, str] = {}
        self.version = 0

    def placed(self, snapshot: FramePoses, fixed: str) -> Poses:
        """As ``snapshot.poses_in(fixed)``, with poses for every tree. Raises UnknownFrame."""
        tree = snapshot.tree
        root = int(tree.roots[tree.row(fixed)])
        laid_out_for = tree, root, int(np.count_nonzero(snapshot.known))
        if laid_out_for != self._laid_out_for:
            self._laid_out_for = laid_out_for
            self._lay_out(snapshot, root)
        if not self._offsets:
            return snapshot.poses_in(fixed)
        offsets = {tree.index[name]: offset for name, offset in self._offsets.items()}
        return snapshot.poses_side_by_side(fixed, offsets)

    def _lay_out(self, snapshot: FramePoses, first: int) -> None:
        names = snapshot.tree.names
        members: dict[int, list[int]] = {}
        for row, root in enumerate(snapshot.tree.roots.tolist()):
            members.setdefault(root, []).append(row)
        others = sorted((row for row in members if row != first), key=lambda row: _natural(names[row]))
        ordered = [first, *others]
        self._boxes = {names[row]: self._box(snapshot, row, members[row]) for row in ordered}
        offsets = _in_rows([box for _, _, box in self._boxes.values()])
        named = {names[row]: offset for row, offset in zip(others, offsets[1:], strict=True)}
        self.version += named != self._offsets
        self._offsets = named
        self.labels = {}
        for row in ordered if others else ():
            robots = {names[k].partition("/")[0] for k in members[row] if "/" in names[k]}
            title = robots.pop() if len(robots) == 1 else names[row]
            self.labels[names[row]] = title if row == first else f"{title} (position unknown)"

    def _box(self, snapshot: FramePoses, root: int, rows: list[int]) -> tuple[list[str], int, _Box]:
        """The largest box of the tree so far: it does not shrink while samples are missing."""
        names = [snapshot.tree.names[row] for row in rows]
        tops, poses = snapshot.tops
        known = [row for row in rows if tops[row] == root]
        before = self._boxes.get(names[0])
        if before is not None and before[0] == names and before[1] >= len(known):
            return before
        box = _bounding_box([snapshot.tree.names[row] for row in known], poses[known, :3])
        return names, len(known), box


def _bounding_box(names: Sequence[str], points: NDArray[np.float64]) -> _Box:
    """The box that the robots can reach in all directions; other frames count only without a robot."""
    robots: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        robots.setdefault(name.partition("/")[0] if "/" in name else "", []).append(row)
    if len(robots) > 1:
        robots.pop("", None)
    corners: list[NDArray[np.float64]] = []
    for rows in robots.values():
        reach = float(np.linalg.norm(points[rows] - points[rows[0]], axis=1).max()) + _MARGIN_M
        corners += [points[rows[0], :2] - reach, points[rows[0], :2] + reach]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return _Box(0.5 * (low + high), 0.5 * (high - low), min(0.0, float(points[:, 2].min())))


def _in_rows(boxes: Sequence[_Box]) -> list[Offset]:
    """The offset of each box in a layout of rows along y on one floor; the first is not moved."""
    columns = math.ceil(math.sqrt(_ASPECT * len(boxes)))
    widths = [max(float(box.half[1]) for box in boxes[k::columns]) for k in range(min(columns, len(boxes)))]
    starts = range(0, len(boxes), columns)
    depths = [max(float(box.half[0]) for box in boxes[start : start + columns]) for start in starts]
    across, behind = _middles(widths), _middles(depths)
    first = boxes[0]
    offsets: list[Offset] = []
    for k, box in enumerate(boxes):
        x = first.middle[0] - behind[k // columns] - box.middle[0]
        y = first.middle[1] + across[k % columns] - box.middle[1]
        offsets.append((float(x), float(y), first.low - box.low))
    return offsets


def _middles(halves: Sequence[float]) -> list[float]:
    """The centres of adjacent intervals, relative to the first."""
    middles = [0.0]
    for before, half in pairwise(halves):
        middles.append(middles[-1] + before + _GAP_M + half)
    return middles


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that puts bot2 before bot10."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", name[:200])]
