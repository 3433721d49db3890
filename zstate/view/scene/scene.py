"""Scene: what is drawn in the page, apart from its panels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Poses
from zstate.model.findings import Finding
from zstate.model.robot import RobotModel
from zstate.model.shapes import Shape, read_shapes
from zstate.view.meshes import Meshes
from zstate.view.scene.apart import Apart
from zstate.view.scene.axes import Axes
from zstate.view.scene.dress import Dress
from zstate.view.scene.lines import Lines
from zstate.view.scene.names import Names
from zstate.view.scene.nodes import Nodes, in_frame
from zstate.view.scene.robots import Robots
from zstate.view.scene.silences import Silences
from zstate.view.scene.trails import Trails
from zstate.view.scene.workshop import Workshop


class Scene:
    """Robots, and frames, as they are at the moments that are shown.

    The attributes say what is drawn from the next ``show`` on: ``visuals`` and ``collisions`` of robots
    (the latter see-through), and ``axes``, ``names`` and ``parent_lines`` of frames. Files are read beside
    the drawing; ``busy`` while some of what is to be drawn is not there yet. To be used by one thread.
    """

    def __init__(self, server: viser.ViserServer, meshes: Meshes | None = None) -> None:
        self.visuals = True
        self.collisions = False
        self.axes = True
        self.names = False
        self.parent_lines = False
        self._scene = server.scene
        self._workshop = Workshop(meshes or Meshes())
        self._robots = Robots(server.scene, self._workshop)
        self._faults: dict[str, tuple[tuple[str, str], ...]] = {}
        self._nodes = Nodes(server.scene)
        self._axes = Axes(server.scene)
        self._names = Names(server.scene)
        self._lines = Lines(server.scene)
        self._trails = Trails(server.scene)
        self._silences = Silences(server.scene)
        self._apart = Apart(server.scene)

    @property
    def busy(self) -> bool:
        """Whether files are still being read for what is to be drawn."""
        return self._workshop.busy

    @property
    def arrangement(self) -> int:
        """A number that changes when trees that nothing joins to the fixed frame are placed elsewhere."""
        return self._apart.version

    def set_robot(
        self,
        name: str,
        model: RobotModel,
        shapes: Sequence[Shape] | None = None,
        base: Path | None = None,
    ) -> None:
        """Draw a robot, in place of an earlier one of that name; its links are the frames ``name/link``.

        ``shapes`` are those of its model when they are not given. ``base`` is the folder of its URDF file,
        if the user named that: then every file that it names can be drawn, otherwise those in packages.
        """
        faults: tuple[Finding, ...] = ()
        if shapes is None:
            shapes, faults = read_shapes(model)
        self._faults[name] = tuple((f"{name}, line {one.line}", one.message) for one in faults)
        self._robots.set(name, tuple(shapes), self._nodes, base)

    def remove_robot(self, name: str) -> None:
        """Draw a robot no more; without one of that name, do nothing."""
        self._robots.remove(name, self._nodes)
        self._faults.pop(name, None)
        self._silences.set(name, None)

    def grey(self, robot: str, since: str | None) -> None:
        """Draw a robot in see-through grey, with the text ``since`` at its root; None: as it is again."""
        self._silences.set(robot, since)

    def trail(self, frame: str, on: bool) -> None:
        """Draw where a frame has been from now on, or draw that no more."""
        self._trails.switch(frame, on)

    def missing_meshes(self, robot: str) -> tuple[tuple[str, str], ...]:
        """What cannot be drawn of a robot: the name of each file in the URDF, and why it cannot."""
        missing = tuple((one.uri, one.why) for one in self._robots.missing(robot))
        return self._faults.get(robot, ()) + missing

    def show(self, moment: FramePoses, fixed: str) -> Poses:
        """Draw everything as it was at a moment, seen from the frame ``fixed``.

        Returns the place of each frame, as ``moment.poses_in(fixed)``, and of trees that nothing joins to the
        fixed frame as they are drawn beside it. Raises UnknownFrame.
        """
        placed = self._apart.placed(moment, fixed)
        self._nodes.show(moment, placed, self._wanted(moment.tree))
        shown = self._nodes.shown
        self._robots.show(self._nodes, moment.tree, placed, self._dresses)
        self._axes.show(self.axes, placed, shown)
        self._lines.show(self.parent_lines, placed, shown, moment.tree.parents)
        self._names.show(self.names, moment, self._nodes)
        self._trails.show(moment, fixed, placed)
        self._silences.show(self._nodes)
        self._apart.show(self._nodes)
        return placed

    def corners(self, tree: FrameTable, placed: Poses) -> NDArray[np.float64]:
        """The corners of the boxes around all visuals that are there and have a place: (N, 3) [m]."""
        boxes = [np.empty((0, 3))]
        for frame, corners in self._robots.corners():
            row = tree.index.get(frame)
            if row is not None and np.isfinite(placed[row, 0]):
                boxes.append(in_frame(placed[row].tolist(), corners))
        return np.concatenate(boxes)

    def _wanted(self, tree: FrameTable) -> frozenset[str]:
        """The frames on which something hangs."""
        if self.names:
            return frozenset(tree.names)
        return self._robots.frames | self._silences.frames(tree) | self._apart.frames

    def _dresses(self, robot: str) -> set[Dress]:
        dresses: set[Dress] = {"collision"} if self.collisions else set()
        if self.visuals:
            dresses.add("grey" if self._silences.is_silent(robot) else "visual")
        return dresses
