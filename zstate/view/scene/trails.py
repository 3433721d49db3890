"""Trails: the recent positions of frames, as fading lines."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, Poses

_SEGMENTS = 400
_SHORTEST_M = 0.002
_PERIOD_NS = 50_000_000
_LONGEST_GAP_NS = 1_000_000_000
_WIDTH_PX = 3.0
_PAPER = np.array([244.0, 244.0, 246.0])
_COLORS = ((214, 39, 120), (31, 119, 180), (44, 140, 60), (230, 120, 20), (120, 80, 190), (20, 150, 150))


class Trail:
    """The last positions of one frame, as a fixed number of segments that start at one point."""

    def __init__(self, handle: viser.LineSegmentsHandle, position: NDArray[np.float64], stamp: int) -> None:
        self.handle = handle
        self._points = np.broadcast_to(position, (_SEGMENTS, 2, 3)).astype(np.float32)
        self._stamp = stamp

    def continues_at(self, stamp: int) -> bool:
        """Whether a position at that stamp continues the trail: time has not jumped."""
        return 0 <= stamp - self._stamp < _LONGEST_GAP_NS

    def add(self, position: NDArray[np.float64], stamp: int) -> None:
        """Append a position, unless it is too soon or too near."""
        last = self._points[-1, 1]
        near = float(np.linalg.norm(position - last)) < _SHORTEST_M
        if near or stamp - self._stamp < _PERIOD_NS:
            self._stamp = stamp if near else self._stamp
            return
        self._points = np.roll(self._points, -1, axis=0)
        self._points[-1] = (last, position)
        self._stamp = stamp
        self.handle.points = self._points


class Trails:
    """Draws the enabled trails. A trail restarts when time jumps or the fixed frame changes."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._trails: dict[str, Trail | None] = {}
        self._colors: dict[str, int] = {}
        self._fixed = ""

    def switch(self, frame: str, on: bool) -> None:
        """Start or remove the trail of a frame."""
        if on:
            self._trails.setdefault(frame, None)
        elif frame in self._trails:
            self._clear(frame)
            del self._trails[frame]

    def show(self, moment: FramePoses, fixed: str, placed: Poses) -> None:
        """Append the current positions."""
        if fixed != self._fixed:
            self._fixed = fixed
            for frame in self._trails:
                self._clear(frame)
        for frame in self._trails:
            row = moment.tree.index.get(frame)
            if row is not None and moment.stamp is not None and np.isfinite(placed[row, 0]):
                self._add(frame, placed[row, :3], moment.stamp)

    def _add(self, frame: str, position: NDArray[np.float64], stamp: int) -> None:
        trail = self._trails[frame]
        if trail is not None and trail.continues_at(stamp):
            trail.add(position, stamp)
            return
        self._trails[frame] = Trail(self._line(frame, position), position, stamp)

    def _line(self, frame: str, position: NDArray[np.float64]) -> viser.LineSegmentsHandle:
        number = self._colors.setdefault(frame, len(self._colors))
        fade = np.linspace(0.0, 1.0, 2 * _SEGMENTS)[:, None] ** 0.5
        colors = (1.0 - fade) * _PAPER + fade * np.array(_COLORS[number % len(_COLORS)])
        return self._scene.add_line_segments(
            f"/trails/{number}",
            np.broadcast_to(position, (_SEGMENTS, 2, 3)).astype(np.float32),
            colors.reshape(_SEGMENTS, 2, 3).astype(np.uint8),
            thickness=_WIDTH_PX,
            thickness_units="screen",
        )

    def _clear(self, frame: str) -> None:
        trail = self._trails[frame]
        if trail is not None:
            trail.handle.remove()
        self._trails[frame] = None
