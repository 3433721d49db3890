"""Markers of frames: axes, lines to parents, labels and trails."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, Mask, Poses, Rows
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

_TRAIL_SEGMENTS = 400
_MIN_STEP_M = 0.002
_TRAIL_PERIOD_NS = 50_000_000
_MAX_GAP_NS = 1_000_000_000
_TRAIL_WIDTH_PX = 3.0
_BACKGROUND = np.array([244.0, 244.0, 246.0])
_TRAIL_COLORS = (
    (214, 39, 120),
    (31, 119, 180),
    (44, 140, 60),
    (230, 120, 20),
    (120, 80, 190),
    (20, 150, 150),
)


class Axes:
    """Three short lines at each frame, red x, green y, blue z; one node of viser for all."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handle: viser.BatchedAxesHandle | None = None
        self._drawn = np.empty((0, 7), dtype=np.float32)

    def show(self, on: bool, placed: Poses, shown: Mask) -> None:
        """Draw axes at each shown pose (N, 7), if ``on``."""
        is_visible = on and bool(shown.any())
        if self._handle is not None:
            self._handle.visible = is_visible
        if is_visible:
            poses = placed[shown].astype(np.float32)
            if self._handle is None or len(self._drawn) != len(poses):
                self._handle = self._scene.add_batched_axes(
                    "/axes",
                    wxyzs(poses),
                    poses[:, :3],
                    axes_length=_AXIS_LENGTH_M,
                    axes_radius=_AXIS_RADIUS_M,
                )
            elif not np.array_equal(poses, self._drawn):
                set_instances(self._handle, poses[:, :3], wxyzs(poses))
            self._drawn = poses


class ParentLines:
    """Lines from each frame to its parent; one node of viser for all."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handle: viser.LineSegmentsHandle | None = None

    def show(self, on: bool, placed: Poses, shown: Mask, parents: Rows) -> None:
        """Draw a line to each shown pose (N, 7) from a shown parent, if ``on``."""
        rows = np.flatnonzero(shown & (parents >= 0) & shown[parents]) if on else parents[:0]
        points = np.stack([placed[parents[rows], :3], placed[rows, :3]], axis=1).astype(np.float32)
        if self._handle is None and len(rows):
            self._handle = self._scene.add_line_segments(
                "/lines", points, _LINE_COLOR, thickness=_LINE_WIDTH_PX, thickness_units="screen"
            )
        if self._handle is not None:
            self._handle.visible = bool(len(rows))
            if len(rows):
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
            is_on_node = nodes.paths.get(frame) == path  # else it was removed with its node
            if is_on_node and frame not in texts:
                label.remove()
            if not is_on_node or frame not in texts:
                del self._labels[frame]
        for frame, text in texts.items():
            path = nodes.paths.get(frame)
            if frame in self._labels:
                label = self._labels[frame][1]
                label.text, label.font_size_mode = text, size
            elif path is not None:
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

    def show(self, on: bool, snapshot: FramePoses, nodes: FrameNodes) -> None:
        """Label every shown frame, if ``on``."""
        joined = np.zeros(0, dtype=np.bool_)
        if on:
            parents, shown = snapshot.tree.parents, nodes.shown
            at_parent = np.linalg.norm(snapshot.poses[:, :3], axis=1) < _SAME_PLACE_M
            joined = at_parent & snapshot.known & (parents >= 0) & shown & shown[parents]
        drawn = (on, nodes.version, joined.tobytes())
        if drawn != self._drawn:
            self._drawn = drawn
            texts = _texts(snapshot, nodes.shown, joined) if on else {}
            self._labels.show(texts, nodes, "scene" if len(texts) > _MAX_SCREEN_LABELS else "screen")


def _texts(snapshot: FramePoses, shown: Mask, joined: Mask) -> dict[str, str]:
    """The text of each label, by its frame; ``joined`` frames share the label of their parent."""
    names = snapshot.tree.names
    robots = {name.partition("/")[0] for name in names if "/" in name}
    lines: dict[int, list[str]] = {}
    hosts: list[int] = []
    for row, name in enumerate(names):
        hosts.append(hosts[int(snapshot.tree.parents[row])] if joined[row] else row)
        if shown[row]:
            text = name if len(robots) > 1 else name.partition("/")[2] or name
            lines.setdefault(hosts[row], []).append(text)
    return {names[row]: "\n".join(texts) for row, texts in lines.items()}


@dataclass
class _Trail:
    """The last positions of one frame, as a fixed number of segments that start at one point."""

    handle: viser.LineSegmentsHandle
    points: NDArray[np.float32]
    stamp: int


class Trails:
    """Draws the enabled trails. A trail restarts when time jumps or the fixed frame changes."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._trails: dict[str, _Trail | None] = {}
        self._numbers: dict[str, int] = {}
        self._fixed = ""

    def set_trail(self, frame: str, on: bool) -> None:
        """Start or remove the trail of a frame."""
        if on:
            self._trails.setdefault(frame, None)
        elif frame in self._trails:
            self._clear(frame)
            del self._trails[frame]

    def show(self, snapshot: FramePoses, fixed: str, placed: Poses) -> None:
        """Append the current positions, unless they are too soon or too near."""
        if fixed != self._fixed:
            self._fixed = fixed
            for frame in self._trails:
                self._clear(frame)
        for frame, trail in self._trails.items():
            row, stamp = snapshot.tree.index.get(frame), snapshot.stamp
            if row is None or stamp is None or not np.isfinite(placed[row, 0]):
                continue
            position = placed[row, :3]
            if trail is None or not 0 <= stamp - trail.stamp < _MAX_GAP_NS:
                self._trails[frame] = self._new_trail(frame, position, stamp)
                continue
            last = trail.points[-1, 1]
            if float(np.linalg.norm(position - last)) < _MIN_STEP_M:
                trail.stamp = stamp
            elif stamp - trail.stamp >= _TRAIL_PERIOD_NS:
                points = np.roll(trail.points, -1, axis=0)
                points[-1] = (last, position)
                trail.points, trail.stamp = points, stamp
                trail.handle.points = points

    def _new_trail(self, frame: str, position: NDArray[np.float64], stamp: int) -> _Trail:
        number = self._numbers.setdefault(frame, len(self._numbers))
        points = np.broadcast_to(position, (_TRAIL_SEGMENTS, 2, 3)).astype(np.float32)
        fade = np.linspace(0.0, 1.0, 2 * _TRAIL_SEGMENTS)[:, None] ** 0.5
        colors = (1.0 - fade) * _BACKGROUND + fade * np.array(_TRAIL_COLORS[number % len(_TRAIL_COLORS)])
        handle = self._scene.add_line_segments(
            f"/trails/{number}",
            points,
            colors.reshape(_TRAIL_SEGMENTS, 2, 3).astype(np.uint8),
            thickness=_TRAIL_WIDTH_PX,
            thickness_units="screen",
        )
        return _Trail(handle, points, stamp)

    def _clear(self, frame: str) -> None:
        trail = self._trails[frame]
        if trail is not None:
            trail.handle.remove()
        self._trails[frame] = None
