"""Frames in the scene: their nodes, and markers at them: axes, lines to parents, labels and trails.

The frame tree is drawn as viser nodes, so that only poses that change are sent: a moving joint is one
message, whatever its link carries; another fixed frame moves only the root.

Poses are sent without the setters of viser, which compare each pose with numpy's ``allclose`` and check the
types of arrays: that costs more than the rest of sending, and the callers here have compared already. For
talos at 30 Hz it is a third of the drawing.
"""

# pyright: reportPrivateUsage=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import viser
from numpy.typing import NDArray
from viser import _messages as messages

from zstate.buffer.snapshot import FramePoses, FrameTable, Mask, Poses, Rows
from zstate.se3 import IDENTITY, to_matrix

_TOP = "/frames"
# Smaller changes are rounding errors of products of poses, and are not sent [m, and parts of a quaternion].
_INVISIBLE = 1e-6

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


class FrameNodes:
    """A node for each frame that carries something, and for its ancestors.

    ``paths`` are their names in viser. ``shown`` has a flag for each row of ``tree``: whether the pose in the
    fixed frame is known. ``version`` grows when the path of a frame or its flag changes.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        scene.add_frame(_TOP, show_axes=False)
        self._ids: dict[str, int] = {}
        self._handles: dict[str, viser.FrameHandle] = {}
        self._rows: Rows = np.empty(0, dtype=np.intp)
        self._node_handles: list[viser.FrameHandle] = []
        self._carriers: frozenset[str] = frozenset()
        self._with_axes: Mask = np.empty(0, dtype=np.bool_)
        self._poses: Poses = np.empty((0, 7))
        self.tree: FrameTable | None = None
        self.paths: dict[str, str] = {}
        self.shown: Mask = np.empty(0, dtype=np.bool_)
        self.version = 0

    def show(self, snapshot: FramePoses, placed: Poses, carriers: frozenset[str]) -> None:
        """Move every frame to its pose in the fixed one (N, 7); ``carriers`` get nodes."""
        if snapshot.tree is not self.tree or carriers != self._carriers:
            self._carriers = carriers
            self._rebuild(snapshot.tree)
        shown = np.isfinite(placed[:, 0])
        if not np.array_equal(shown, self.shown):
            self.shown = shown
            self.version += 1
            # A node without a pose is visible if a descendant has one.
            visible = _with_ancestors(shown, snapshot.tree)[self._rows].tolist()
            for handle, is_visible in zip(self._node_handles, visible, strict=True):
                handle.visible = is_visible
        # Poses in the node of the parent, which is at the fixed frame if its own pose is unknown.
        parents = snapshot.tree.parents
        on_shown = (parents >= 0) & shown[parents]
        in_fixed = np.where(shown[:, None], placed, IDENTITY)
        poses = np.where((shown & on_shown)[:, None], snapshot.poses, in_fixed)
        self._move(poses[self._rows])

    def show_axes(self, frames: Mask) -> None:
        """Draw axes at the shown ones of ``frames``, a flag for each row of the tree; all of them have nodes.

        A browser moves what is on a node at once, as meshes, but the instances of a node one picture later.
        """
        on = (frames & self.shown)[self._rows]
        for row in np.flatnonzero(on != self._with_axes).tolist():
            self._node_handles[row].show_axes = bool(on[row])
        self._with_axes = on

    def is_shown(self, frame: str) -> bool:
        """Whether the pose of the frame in the fixed one is known."""
        return self.tree is not None and frame in self.paths and bool(self.shown[self.tree.row(frame)])

    def _rebuild(self, tree: FrameTable) -> None:
        """Short names, because every message contains one; the number of a frame never changes."""
        carriers = np.array([name in self._carriers for name in tree.names], dtype=np.bool_)
        paths: dict[str, str] = {}
        for row in np.flatnonzero(_with_ancestors(carriers, tree)).tolist():
            name, parent = tree.names[row], int(tree.parents[row])
            above = _TOP if parent < 0 else paths[tree.names[parent]]
            paths[name] = f"{above}/{self._ids.setdefault(name, len(self._ids))}"
        removed = self._handles.keys() - set(paths.values())
        for path in removed:
            handle = self._handles.pop(path)
            if path.rpartition("/")[0] not in removed:
                handle.remove()  # with its descendants
        for path in paths.values():
            if path not in self._handles:
                self._handles[path] = self._scene.add_frame(
                    path,
                    show_axes=False,
                    axes_length=_AXIS_LENGTH_M,
                    axes_radius=_AXIS_RADIUS_M,
                    origin_radius=_AXIS_RADIUS_M,
                )
        self._rows = np.array([tree.row(name) for name in paths], dtype=np.intp)
        self._node_handles = [self._handles[path] for path in paths.values()]
        self._with_axes = np.array([handle.show_axes for handle in self._node_handles], dtype=np.bool_)
        self._poses = np.full((len(paths), 7), np.nan)
        self.shown = np.zeros(0, dtype=np.bool_)
        self.tree, self.paths = tree, paths
        self.version += 1

    def _move(self, poses: Poses) -> None:
        with np.errstate(invalid="ignore"):
            changed = ~(np.abs(poses - self._poses) <= _INVISIBLE)
        moved, turned = changed[:, :3].any(axis=1), changed[:, 3:].any(axis=1)
        for row in np.flatnonzero(moved).tolist():
            x, y, z = poses[row, :3].tolist()
            node = self._node_handles[row]._impl
            node.position[:] = (x, y, z)
            node.api._queue_scene_message(messages.SetPositionMessage(node.name, (x, y, z)))
        for row in np.flatnonzero(turned).tolist():
            qx, qy, qz, qw = poses[row, 3:].tolist()
            node = self._node_handles[row]._impl
            node.wxyz[:] = (qw, qx, qy, qz)
            node.api._queue_scene_message(messages.SetOrientationMessage(node.name, (qw, qx, qy, qz)))
        self._poses[moved, :3] = poses[moved, :3]
        self._poses[turned, 3:] = poses[turned, 3:]


def _with_ancestors(frames: Mask, tree: FrameTable) -> Mask:
    """The frames of a mask and all frames above them; parents come first."""
    marked = frames.copy()
    for row in range(len(marked) - 1, -1, -1):
        if marked[row] and tree.parents[row] >= 0:
            marked[tree.parents[row]] = True
    return marked


def wxyzs(poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """The quaternions of poses (..., 7) in the order of viser (..., 4)."""
    return poses[..., [6, 3, 4, 5]]


def in_frame(pose: Sequence[float], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform ``points`` (N, 3) by a pose."""
    matrix = to_matrix(pose)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def set_instances(
    handle: viser.BatchedAxesHandle | viser.BatchedGlbHandle,
    positions: NDArray[np.float32],
    wxyzs: NDArray[np.float32],
) -> None:
    """Set positions (N, 3) [m] and rotations (N, 4) of the instances of a node; viser keeps the arrays."""
    node = handle._impl
    node.props.batched_positions, node.props.batched_wxyzs = positions, wxyzs
    moved = {"batched_positions": positions, "batched_wxyzs": wxyzs}
    node.api._queue_scene_message(messages.SceneNodeUpdateMessage(node.name, moved))


class Axes:
    """Three short lines at each frame, red x, green y, blue z, as instances of one node of viser."""

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
