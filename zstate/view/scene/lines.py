"""Lines: from each frame to its parent; all of them one node of viser's."""

from __future__ import annotations

import numpy as np
import viser

from zstate.buffer.snapshot import Mask, Poses, Rows

_COLOR = (230, 150, 20)
_WIDTH_PX = 2.0


class Lines:
    """Draws them while they are ``on``."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handle: viser.LineSegmentsHandle | None = None

    def show(self, on: bool, placed: Poses, shown: Mask, parents: Rows) -> None:
        """Draw one to each of the poses (N, 7) that is shown, as is its parent."""
        rows = np.flatnonzero(shown & (parents >= 0) & shown[parents]) if on else parents[:0]
        if not len(rows):
            if self._handle is not None:
                self._handle.visible = False
            return
        points = np.stack([placed[parents[rows], :3], placed[rows, :3]], axis=1).astype(np.float32)
        if self._handle is None:
            self._handle = self._scene.add_line_segments(
                "/lines", points, _COLOR, thickness=_WIDTH_PX, thickness_units="screen"
            )
        self._handle.visible = True
        self._handle.points = points
