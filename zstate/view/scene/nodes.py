"""Nodes: the tree of frames as a tree of viser's, so that only poses that change are sent.

A joint that turns is one message, whatever hangs on its link; another fixed frame moves the root alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Mask, Poses, Rows
from zstate.se3 import IDENTITY, to_matrix
from zstate.view.scene.posing import move, turn

_Float = TypeVar("_Float", np.float32, np.float64)

_TOP = "/frames"
# What nobody sees is not sent [m, and parts of a quaternion]: what is left when poses are multiplied.
_UNSEEN = 1e-6


class Nodes:
    """A node for each frame on which something hangs, and for those above it.

    ``paths`` are their names in viser. ``shown`` says by row of ``tree`` which frames have a place in the
    fixed one. ``version`` grows when a frame has got another path, or a place, or has lost it.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        scene.add_frame(_TOP, show_axes=False)
        self._ids: dict[str, int] = {}
        self._handles: dict[str, viser.FrameHandle] = {}
        self._rows: Rows = np.empty(0, dtype=np.intp)
        self._hooks: list[viser.FrameHandle] = []
        self._wanted: frozenset[str] = frozenset()
        self._poses: Poses = np.empty((0, 7))
        self.tree: FrameTable | None = None
        self.paths: dict[str, str] = {}
        self.shown: Mask = np.empty(0, dtype=np.bool_)
        self.version = 0

    def show(self, moment: FramePoses, placed: Poses, wanted: frozenset[str]) -> None:
        """Move every frame to its place in the fixed one (N, 7), with nodes for those ``wanted``."""
        if moment.tree is not self.tree or wanted != self._wanted:
            self._wanted = wanted
            self._grow(moment.tree)
        shown = np.isfinite(placed[:, 0])
        if not np.array_equal(shown, self.shown):
            self._reveal(moment.tree, shown)
        self._move(_on_parents(moment, placed, shown)[self._rows])

    def is_shown(self, frame: str) -> bool:
        """Whether the frame has a place in the fixed one."""
        return self.tree is not None and frame in self.paths and bool(self.shown[self.tree.row(frame)])

    def _grow(self, tree: FrameTable) -> None:
        paths = self._paths(tree)
        for path in self._outermost_without(set(paths.values())):
            self._handles[path].remove()
            for below in [one for one in self._handles if one == path or one.startswith(f"{path}/")]:
                del self._handles[below]
        for path in paths.values():
            if path not in self._handles:
                self._handles[path] = self._scene.add_frame(path, show_axes=False)
        self._rows = np.array([tree.row(name) for name in paths], dtype=np.intp)
        self._hooks = [self._handles[path] for path in paths.values()]
        self._poses = np.full((len(paths), 7), np.nan)
        self.shown = np.zeros(0, dtype=np.bool_)
        self.tree, self.paths = tree, paths
        self.version += 1

    def _paths(self, tree: FrameTable) -> dict[str, str]:
        """Short ones, because every message has one; a frame keeps its number for good."""
        kept = np.array([name in self._wanted for name in tree.names], dtype=np.bool_)
        for row in range(len(kept) - 1, -1, -1):
            kept[tree.parents[row]] |= kept[row] and tree.parents[row] >= 0
        paths: dict[str, str] = {}
        for row in np.flatnonzero(kept).tolist():
            name, parent = tree.names[row], int(tree.parents[row])
            above = _TOP if parent < 0 else paths[tree.names[parent]]
            paths[name] = f"{above}/{self._ids.setdefault(name, len(self._ids))}"
        return paths

    def _outermost_without(self, kept: set[str]) -> Iterator[str]:
        """The nodes to remove; what is below one goes with it."""
        gone = self._handles.keys() - kept
        return (path for path in gone if path.rpartition("/")[0] not in gone)

    def _reveal(self, tree: FrameTable, shown: Mask) -> None:
        """A node without a place is hidden, unless a frame below it has one: then it is only passed."""
        passed = shown.copy()
        for row in range(len(shown) - 1, -1, -1):
            parent = int(tree.parents[row])
            if passed[row] and parent >= 0:
                passed[parent] = True
        for handle, visible in zip(self._hooks, passed[self._rows].tolist(), strict=True):
            handle.visible = visible
        self.shown = shown
        self.version += 1

    def _move(self, poses: Poses) -> None:
        with np.errstate(invalid="ignore"):
            changed = ~(np.abs(poses - self._poses) <= _UNSEEN)
        moved, turned = changed[:, :3].any(axis=1), changed[:, 3:].any(axis=1)
        for row in np.flatnonzero(moved).tolist():
            x, y, z = poses[row, :3].tolist()
            move(self._hooks[row], (x, y, z))
        for row in np.flatnonzero(turned).tolist():
            qx, qy, qz, qw = poses[row, 3:].tolist()
            turn(self._hooks[row], (qw, qx, qy, qz))
        self._poses[moved, :3] = poses[moved, :3]
        self._poses[turned, 3:] = poses[turned, 3:]


def wxyzs(poses: NDArray[_Float]) -> NDArray[_Float]:
    """The quaternions of poses (..., 7) in viser's order (..., 4)."""
    return poses[..., [6, 3, 4, 5]]


def in_frame(pose: Sequence[float], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """``points`` (N, 3) of something at a pose, in the frame that the pose is in."""
    matrix = to_matrix(pose)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _on_parents(moment: FramePoses, placed: Poses, shown: Mask) -> Poses:
    """Each frame on the node of its parent, which stands at the fixed frame while it has no place."""
    parents = moment.tree.parents
    on_shown = (parents >= 0) & shown[parents]
    on_top = np.where(shown[:, None], placed, IDENTITY)
    return np.where((shown & on_shown)[:, None], moment.poses, on_top)
