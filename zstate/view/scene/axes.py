"""Axes: three short lines at each frame, red x, green y, blue z; all of them one node of viser's."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import Mask, Poses
from zstate.view.scene.nodes import wxyzs
from zstate.view.scene.posing import place

_LENGTH_M = 0.1
_RADIUS_M = 0.0025


class Axes:
    """Draws them while they are ``on``."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handle: viser.BatchedAxesHandle | None = None
        self._drawn = np.empty((0, 7), dtype=np.float32)

    def show(self, on: bool, placed: Poses, shown: Mask) -> None:
        """Put one at each of the poses (N, 7) that is shown."""
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
            place(self._handle, poses[:, :3], wxyzs(poses))

    def _draw(self, poses: NDArray[np.float32]) -> None:
        self._drawn = poses
        self._handle = self._scene.add_batched_axes(
            "/axes",
            wxyzs(poses),
            poses[:, :3],
            axes_length=_LENGTH_M,
            axes_radius=_RADIUS_M,
        )
