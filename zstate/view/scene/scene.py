"""The scene of the page: robots, frames, trails and labels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TypeAlias

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Poses
from zstate.model.findings import Finding
from zstate.model.geometry import Shape, read_shapes
from zstate.model.robot import RobotModel
from zstate.view.mesh_loader import MeshLoader
from zstate.view.mesh_paths import MissingFile
from zstate.view.meshes import Meshes
from zstate.view.scene.frame_markers import Axes, FrameLabels, ParentLines, StaleLabels, Trails
from zstate.view.scene.frame_nodes import FrameNodes, in_frame
from zstate.view.scene.robot_meshes import InstancedMeshes, RenderStyle, RobotMeshes
from zstate.view.scene.tree_layout import TreeLayout

# Identical robots have the same shapes, and the same folder of the URDF file if the user named one.
_Kind: TypeAlias = tuple[tuple[Shape, ...], Path | None]

_MIN_INSTANCES = 4  # identical robots that are drawn by instances


class Scene:
    """Draws robots and frames at one instant after the other.

    Attributes, used by the next ``show``: ``visuals`` and ``collisions`` of robots (the latter translucent),
    and ``axes``, ``names`` and ``parent_lines`` of frames. Meshes are loaded in the background; the scene is
    ``busy`` until all are drawn. To be used by one thread.
    """

    def __init__(self, server: viser.ViserServer, meshes: Meshes | None = None) -> None:
        self.visuals = True
        self.collisions = False
        self.axes = True
        self.names = False
        self.parent_lines = False
        self._scene = server.scene
        self._loader = MeshLoader(meshes or Meshes())
        self._robots = _Robots(server.scene, self._loader)
        self._faults: dict[str, tuple[tuple[str, str], ...]] = {}
        self._nodes = FrameNodes(server.scene)
        self._axes = Axes(server.scene)
        self._names = FrameLabels(server.scene)
        self._lines = ParentLines(server.scene)
        self._trails = Trails(server.scene)
        self._stale_labels = StaleLabels(server.scene)
        self._layout = TreeLayout(server.scene)

    @property
    def busy(self) -> bool:
        """Whether meshes are still being loaded."""
        return self._loader.busy

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
        faults: tuple[Finding, ...] = ()
        if shapes is None:
            shapes, faults = read_shapes(model)
        self._faults[name] = tuple((f"{name}, line {one.line}", one.message) for one in faults)
        self._robots.set(name, tuple(shapes), self._nodes, base)

    def remove_robot(self, name: str) -> None:
        """Remove a robot, if it exists."""
        self._robots.remove(name, self._nodes)
        self._faults.pop(name, None)
        self._stale_labels.set(name, None)

    def set_stale(self, robot: str, text: str | None) -> None:
        """Draw a stale robot in translucent grey, with ``text`` at its root; with None, as usual."""
        self._stale_labels.set(robot, text)

    def set_trail(self, frame: str, on: bool) -> None:
        """Start or remove the trail of a frame."""
        self._trails.set_trail(frame, on)

    def missing_meshes(self, robot: str) -> tuple[tuple[str, str], ...]:
        """Files of a robot that cannot be drawn: the name in the URDF, and the reason."""
        missing = tuple((one.uri, one.why) for one in self._robots.missing(robot))
        return self._faults.get(robot, ()) + missing

    def show(self, snapshot: FramePoses, fixed: str) -> Poses:
        """Draw everything at one instant, relative to the frame ``fixed``.

        Returns the pose of each frame, as ``snapshot.poses_in(fixed)``; trees that are not connected to the
        fixed frame have the poses at which they are drawn. Raises UnknownFrame.
        """
        placed = self._layout.placed(snapshot, fixed)
        frames = self._robots.frames | self._stale_labels.frames(snapshot.tree) | self._layout.frames
        self._nodes.show(snapshot, placed, frozenset(snapshot.tree.names) if self.names else frames)
        shown = self._nodes.shown
        self._robots.show(self._nodes, snapshot.tree, placed, self._styles)
        self._axes.show(self.axes, placed, shown)
        self._lines.show(self.parent_lines, placed, shown, snapshot.tree.parents)
        self._names.show(self.names, snapshot, self._nodes)
        self._trails.show(snapshot, fixed, placed)
        self._stale_labels.show(self._nodes)
        self._layout.show(self._nodes)
        return placed

    def corners(self, tree: FrameTable, placed: Poses) -> NDArray[np.float64]:
        """The corners of the bounding boxes of all loaded visuals with a known pose: (N, 3) [m]."""
        boxes = [np.empty((0, 3))]
        for frame, corners in self._robots.corners():
            row = tree.index.get(frame)
            if row is not None and np.isfinite(placed[row, 0]):
                boxes.append(in_frame(placed[row].tolist(), corners))
        return np.concatenate(boxes)

    def _styles(self, robot: str) -> set[RenderStyle]:
        styles: set[RenderStyle] = {"collision"} if self.collisions else set()
        if self.visuals:
            styles.add("stale" if self._stale_labels.is_stale(robot) else "visual")
        return styles


class _Robots:
    """The meshes of all robots. ``frames`` are those whose nodes carry some."""

    def __init__(self, scene: viser.SceneApi, loader: MeshLoader) -> None:
        self._scene = scene
        self._loader = loader
        self._single: dict[str, RobotMeshes] = {}
        self._instanced: dict[_Kind, InstancedMeshes] = {}
        self._instanced_count = 0
        self.frames: frozenset[str] = frozenset()

    def set(self, name: str, shapes: tuple[Shape, ...], nodes: FrameNodes, base: Path | None = None) -> None:
        """Add or replace a robot; ``base`` as for RobotMeshes."""
        self.remove(name, nodes)
        kind = shapes, base
        alike = [robot for robot, meshes in self._single.items() if (meshes.shapes, meshes.base) == kind]
        if kind in self._instanced or len(alike) + 1 >= _MIN_INSTANCES:
            for robot in alike:
                self._single.pop(robot).remove(nodes)
            if kind not in self._instanced:
                self._instanced_count += 1
                path = f"/instanced/{self._instanced_count}"
                self._instanced[kind] = InstancedMeshes(self._scene, self._loader, shapes, path, base)
            self._instanced[kind].robots |= dict.fromkeys([*alike, name])
        else:
            self._single[name] = RobotMeshes(self._scene, self._loader, name, shapes, base)
        self._find_frames()

    def remove(self, name: str, nodes: FrameNodes) -> None:
        """Remove a robot, if it exists."""
        meshes = self._single.pop(name, None)
        if meshes is not None:
            meshes.remove(nodes)
        for kind, group in list(self._instanced.items()):
            group.robots.pop(name, None)
            if not group.robots:
                group.remove()
                del self._instanced[kind]
        self._find_frames()

    def missing(self, name: str) -> Sequence[MissingFile]:
        """Files of a robot that cannot be drawn."""
        if name in self._single:
            return self._single[name].meshes.missing
        groups = [group for group in self._instanced.values() if name in group.robots]
        return groups[0].meshes.missing if groups else ()

    def show(
        self, nodes: FrameNodes, tree: FrameTable, placed: Poses, styles: Callable[[str], set[RenderStyle]]
    ) -> None:
        """Draw each robot in its styles, with the meshes loaded since."""
        for loaded in self._loader.fetch():
            any(one.meshes.receive(loaded) for one in chain(self._single.values(), self._instanced.values()))
        for name, meshes in self._single.items():
            meshes.show(nodes, styles(name))
        for group in self._instanced.values():
            group.show(tree, placed, {name: styles(name) for name in group.robots})

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """The frame of each loaded visual, with the corners of its bounding box in it (8, 3) [m]."""
        return chain.from_iterable(
            one.corners() for one in (*self._single.values(), *self._instanced.values())
        )

    def _find_frames(self) -> None:
        self.frames = frozenset(chain.from_iterable(meshes.frames for meshes in self._single.values()))
