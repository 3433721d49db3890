"""The frame tree as viser nodes, so that only poses that change are sent.

A moving joint is one message, whatever its link carries; another fixed frame moves only the root.

Poses are sent without the setters of viser, which compare each pose with numpy's ``allclose`` and check the
types of arrays: that costs more than the rest of sending, and the callers here have compared already. For
talos at 30 Hz it is a third of the drawing.
"""

# pyright: reportPrivateUsage=false

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray
from viser import _messages as messages

from zstate.buffer.snapshot import FramePoses, FrameTable, Mask, Poses, Rows
from zstate.se3 import IDENTITY, to_matrix

_TOP = "/frames"
# Smaller changes are rounding errors of products of poses, and are not sent [m, and parts of a quaternion].
_INVISIBLE = 1e-6


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
                self._handles[path] = self._scene.add_frame(path, show_axes=False)
        self._rows = np.array([tree.row(name) for name in paths], dtype=np.intp)
        self._node_handles = [self._handles[path] for path in paths.values()]
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
