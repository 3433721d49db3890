"""The scene of the page: robots, frames, trails and labels."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Poses
from zstate.model.findings import Finding
from zstate.model.geometry import Shape, read_shapes
from zstate.model.robot import RobotModel
from zstate.view.meshes import Meshes, MeshLoader
from zstate.view.scene.frame_markers import Axes, FrameLabels, NodeLabels, ParentLines, Trails
from zstate.view.scene.frame_nodes import FrameNodes, in_frame
from zstate.view.scene.robot_meshes import InstancedMeshes, RenderStyle, RobotMeshes
from zstate.view.scene.tree_layout import TreeLayout

_MIN_INSTANCES = 4  # identical robots that are drawn by instances


class Scene:
    """Draws robots and frames at one instant after the other.

    Attributes, used by the next ``show``: ``visuals`` and ``collisions`` of robots (the latter translucent),
    and ``axes``, ``names`` and ``parent_lines`` of frames. Meshes are loaded in the background; the scene is
    ``busy`` until all are drawn. To be used by one thread.
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
        # Identical robots have the same shapes, and the same folder of the URDF file if the user named one.
        self._instanced: dict[tuple[tuple[Shape, ...], Path | None], InstancedMeshes] = {}
        self._instanced_count = 0
        self._faults: dict[str, list[tuple[str, str]]] = {}
        self._stale: dict[str, str] = {}
        self._tree: FrameTable | None = None
        self._first_frames: dict[str, str] = {}
        self._nodes = FrameNodes(scene)
        self._axes = Axes(scene)
        self._names = FrameLabels(scene)
        self._lines = ParentLines(scene)
        self._trails = Trails(scene)
        self._layout = TreeLayout()
        self._stale_labels = NodeLabels(scene, "stale", anchor="top-center")
        self._tree_labels = NodeLabels(scene, "tree", anchor="bottom-center")

    @property
    def busy(self) -> bool:
        """Whether meshes are still being loaded."""
        return any(meshes.busy for meshes in self._meshes())

    @property
    def layout_version(self) -> int:
        """Grows when trees that are not connected to the fixed frame are moved."""
        return self._layout.version

    def set_robot(
        self, name: str, model: RobotModel, shapes: Sequence[Shape] | None = None, base: Path | None = None
    ) -> None:
        """Add or replace a robot; its links are the frames ``name/link``.

        ``shapes`` default to those of its model. ``base`` is the folder of its URDF file, if the user named
        one: then every file in it can be loaded, otherwise only those in packages.
        """
        faults: Sequence[Finding] = ()
        if shapes is None:
            shapes, faults = read_shapes(model)
        self._remove_meshes(name)
        self._faults[name] = [(f"{name}, line {one.line}", one.message) for one in faults]
        kind = tuple(shapes), base
        alike = [robot for robot, meshes in self._single.items() if meshes.kind == kind]
        if kind not in self._instanced and len(alike) + 1 < _MIN_INSTANCES:
            self._single[name] = RobotMeshes(self._scene, self._loader, name, *kind)
            return
        for robot in alike:
            self._single.pop(robot).remove(self._nodes)
        if kind not in self._instanced:
            self._instanced_count += 1
            path = f"/instanced/{self._instanced_count}"
            self._instanced[kind] = InstancedMeshes(self._scene, self._loader, path, *kind)
        self._instanced[kind].robots |= dict.fromkeys([*alike, name])

    def remove_robot(self, name: str) -> None:
        """Remove a robot, if it exists."""
        self._remove_meshes(name)
        self._faults.pop(name, None)
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
        """Draw a stale robot in translucent grey, with ``text`` at its root; with None, as usual."""
        if text is None:
            self._stale.pop(robot, None)
        else:
            self._stale[robot] = text

    def set_trail(self, frame: str, on: bool) -> None:
        """Start or remove the trail of a frame."""
        self._trails.set_trail(frame, on)

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
        first = self._first_frames
        stale = {first[robot]: f"{robot}: {text}" for robot, text in self._stale.items() if robot in first}
        placed = self._layout.placed(snapshot, fixed)
        on_links = (meshes.frames for meshes in self._single.values())
        carriers = tree.names if self.names else chain(stale, self._layout.labels, *on_links)
        self._nodes.show(snapshot, placed, frozenset(carriers))
        shown = self._nodes.shown
        for name, meshes in self._single.items():
            meshes.show(self._nodes, self._styles(name))
        for group in self._instanced.values():
            group.show(tree, placed, {name: self._styles(name) for name in group.robots})
        self._axes.show(self.axes, placed, shown)
        self._lines.show(self.parent_lines, placed, shown, tree.parents)
        self._names.show(self.names, snapshot, self._nodes)
        self._trails.show(snapshot, fixed, placed)
        self._stale_labels.show(stale, self._nodes)
        self._tree_labels.show(self._layout.labels, self._nodes)
        return placed

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
