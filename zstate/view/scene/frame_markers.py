"""Markers of frames: axes, lines to parents, and labels with names or with the age of stale robots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Mask, Poses, Rows
from zstate.view.scene.frame_nodes import FrameNodes, set_instances, wxyzs

_AXIS_LENGTH_M = 0.1
_AXIS_RADIUS_M = 0.0025
_LINE_COLOR = (230, 150, 20)
_LINE_WIDTH_PX = 2.0
_LABEL_SCALE = 0.85
# More labels of constant size on the screen would cover the rest: they then have a size in the scene [m].
_MAX_SCREEN_LABELS = 40
_LABEL_HEIGHT_M = 0.028
_SAME_PLACE_M = 0.004


class Axes:
    """Three short lines at each frame, red x, green y, blue z; one node of viser for all."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handle: viser.BatchedAxesHandle | None = None
        self._drawn = np.empty((0, 7), dtype=np.float32)

    def show(self, on: bool, placed: Poses, shown: Mask) -> None:
        """Draw axes at each shown pose (N, 7), if ``on``."""
        if not on or not shown.any():
            if self._handle is not None:
                self._handle.visible = False
            return
        poses = placed[shown].astype(np.float32)
        if self._handle is None or len(self._drawn) != len(poses):
            self._draw(poses)
            return
        self._handle.visible = True
        if not np.array_equal(poses, self._drawn):
            self._drawn = poses
            set_instances(self._handle, poses[:, :3], wxyzs(poses))

    def _draw(self, poses: NDArray[np.float32]) -> None:
        self._drawn = poses
        self._handle = self._scene.add_batched_axes(
            "/axes",
            wxyzs(poses),
            poses[:, :3],
            axes_length=_AXIS_LENGTH_M,
            axes_radius=_AXIS_RADIUS_M,
        )


class ParentLines:
    """Lines from each frame to its parent; one node of viser for all."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handle: viser.LineSegmentsHandle | None = None

    def show(self, on: bool, placed: Poses, shown: Mask, parents: Rows) -> None:
        """Draw a line to each shown pose (N, 7) from a shown parent, if ``on``."""
        rows = np.flatnonzero(shown & (parents >= 0) & shown[parents]) if on else parents[:0]
        if not len(rows):
            if self._handle is not None:
                self._handle.visible = False
            return
        points = np.stack([placed[parents[rows], :3], placed[rows, :3]], axis=1).astype(np.float32)
        if self._handle is None:
            self._handle = self._scene.add_line_segments(
                "/lines", points, _LINE_COLOR, thickness=_LINE_WIDTH_PX, thickness_units="screen"
            )
        self._handle.visible = True
        self._handle.points = points


class NodeLabels:
    """Labels on frame nodes, so that nothing is sent when they move. A label is removed with its node."""

    def __init__(self, scene: viser.SceneApi, name: str, **options: Any) -> None:
        self._scene = scene
        self._name = name
        self._options = options
        self._labels: dict[str, tuple[str, viser.LabelHandle]] = {}

    def show(
        self, texts: Mapping[str, str], nodes: FrameNodes, size: Literal["screen", "scene"] = "screen"
    ) -> None:
        """Show ``texts``, by frame, and no others."""
        for frame, (path, label) in list(self._labels.items()):
            if nodes.paths.get(frame) != path:
                del self._labels[frame]  # it was removed with its node
            elif frame not in texts:
                label.remove()
                del self._labels[frame]
        for frame, text in texts.items():
            path = nodes.paths.get(frame)
            if path is None:
                continue
            if frame in self._labels:
                label = self._labels[frame][1]
                label.text, label.font_size_mode = text, size
            else:
                label = self._scene.add_label(
                    f"{path}/{self._name}", text, font_size_mode=size, **self._options
                )
                self._labels[frame] = path, label


class FrameLabels:
    """A label with the name of each frame, without the robot's name if there is only one robot.

    Frames at the same place, such as the axes of a wrist, share one label with a line for each: labels on
    top of each other cannot be read.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._labels = NodeLabels(
            scene,
            "name",
            font_screen_scale=_LABEL_SCALE,
            font_scene_height=_LABEL_HEIGHT_M,
            anchor="bottom-left",
        )
        self._drawn: tuple[bool, int, bytes] | None = None

    def show(self, on: bool, moment: FramePoses, nodes: FrameNodes) -> None:
        """Label every shown frame, if ``on``."""
        joined = _at_parents(moment, nodes.shown) if on else np.zeros(0, dtype=np.bool_)
        drawn = (on, nodes.version, joined.tobytes())
        if drawn != self._drawn:
            self._drawn = drawn
            texts = _texts(moment, nodes.shown, joined) if on else {}
            self._labels.show(texts, nodes, "scene" if len(texts) > _MAX_SCREEN_LABELS else "screen")


def _at_parents(moment: FramePoses, shown: Mask) -> Mask:
    """Which frames are at the same place as their parents."""
    parents = moment.tree.parents
    near: NDArray[np.bool_] = np.linalg.norm(moment.poses[:, :3], axis=1) < _SAME_PLACE_M
    return near & moment.known & (parents >= 0) & shown & shown[parents]


def _texts(moment: FramePoses, shown: Mask, joined: Mask) -> dict[str, str]:
    """The text of each label, by its frame."""
    names = moment.tree.names
    robots = {name.partition("/")[0] for name in names if "/" in name}
    lines: dict[int, list[str]] = {}
    hosts: list[int] = []
    for row, name in enumerate(names):
        hosts.append(hosts[int(moment.tree.parents[row])] if joined[row] else row)
        if shown[row]:
            text = name if len(robots) > 1 else name.partition("/")[2] or name
            lines.setdefault(hosts[row], []).append(text)
    return {names[row]: "\n".join(names_here) for row, names_here in lines.items()}


class StaleLabels:
    """The text of each stale robot, on a label at its first frame."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._labels = NodeLabels(scene, "silence", anchor="top-center")
        self._texts: dict[str, str] = {}
        self._tree: FrameTable | None = None
        self._first_frames: dict[str, str] = {}

    def set(self, robot: str, text: str | None) -> None:
        """Set the text of a stale robot; None if it is not stale."""
        if text is None:
            self._texts.pop(robot, None)
        else:
            self._texts[robot] = text

    def is_stale(self, robot: str) -> bool:
        """Whether the robot has a text."""
        return robot in self._texts

    def frames(self, tree: FrameTable) -> frozenset[str]:
        """The frames that carry labels: the first of each stale robot, since parents come first."""
        if tree is not self._tree:
            self._tree, self._first_frames = tree, {}
            for name in tree.names:
                self._first_frames.setdefault(name.partition("/")[0], name)
        return frozenset(self._first_frames[robot] for robot in self._texts if robot in self._first_frames)

    def show(self, nodes: FrameNodes) -> None:
        """Draw the labels."""
        first = self._first_frames
        texts = {first[robot]: f"{robot}: {text}" for robot, text in self._texts.items() if robot in first}
        self._labels.show(texts, nodes)
