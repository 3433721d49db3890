"""Layout of frame trees that are not connected to the fixed frame.

Their relative poses are unknown. They are placed in rows next to it, on one floor, as far apart as their
robots reach, with labels that mark them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Poses

_GAP_M = 0.3
_MARGIN_M = 0.12  # of meshes around their frames
# Width of the layout divided by its depth: pictures are wider than high.
_ASPECT = 1.6

Offset = tuple[float, float, float]


class _Box(NamedTuple):
    """The space of a tree around its root [m]: centre and half size along x, y; lowest z."""

    middle: NDArray[np.float64]
    half: NDArray[np.float64]
    low: float


class TreeLayout:
    """Places trees next to that of the fixed frame; ``labels`` are texts by root if there are several.

    A tree keeps its place while robots move. The layout is computed again, and ``version`` grows, when a tree
    appears or disappears, or more of its frames have a pose.
    """

    def __init__(self) -> None:
        self._laid_out_for: tuple[FrameTable, int, int] | None = None
        # By root: the frames of the tree, the number of them with a pose, and their box.
        self._boxes: dict[str, tuple[list[str], int, _Box]] = {}
        self._offsets: dict[str, Offset] = {}
        self.labels: dict[str, str] = {}
        self.version = 0

    def placed(self, snapshot: FramePoses, fixed: str) -> Poses:
        """As ``snapshot.poses_in(fixed)``, with poses for every tree. Raises UnknownFrame."""
        tree = snapshot.tree
        root = int(tree.roots[tree.row(fixed)])
        laid_out_for = tree, root, int(np.count_nonzero(snapshot.known))
        if laid_out_for != self._laid_out_for:
            self._laid_out_for = laid_out_for
            self._lay_out(snapshot, root)
        if not self._offsets:
            return snapshot.poses_in(fixed)
        offsets = {tree.index[name]: offset for name, offset in self._offsets.items()}
        return snapshot.poses_side_by_side(fixed, offsets)

    def _lay_out(self, snapshot: FramePoses, first: int) -> None:
        names = snapshot.tree.names
        members: dict[int, list[int]] = {}
        for row, root in enumerate(snapshot.tree.roots.tolist()):
            members.setdefault(root, []).append(row)
        others = sorted((row for row in members if row != first), key=lambda row: _natural(names[row]))
        ordered = [first, *others]
        self._boxes = {names[row]: self._box(snapshot, row, members[row]) for row in ordered}
        offsets = _in_rows([box for _, _, box in self._boxes.values()])
        named = {names[row]: offset for row, offset in zip(others, offsets[1:], strict=True)}
        self.version += named != self._offsets
        self._offsets = named
        self.labels = {}
        for row in ordered if others else ():
            robots = {names[k].partition("/")[0] for k in members[row] if "/" in names[k]}
            title = robots.pop() if len(robots) == 1 else names[row]
            self.labels[names[row]] = title if row == first else f"{title} (position unknown)"

    def _box(self, snapshot: FramePoses, root: int, rows: list[int]) -> tuple[list[str], int, _Box]:
        """The largest box of the tree so far: it does not shrink while samples are missing."""
        names = [snapshot.tree.names[row] for row in rows]
        tops, poses = snapshot.tops
        known = [row for row in rows if tops[row] == root]
        before = self._boxes.get(names[0])
        if before is not None and before[0] == names and before[1] >= len(known):
            return before
        box = _bounding_box([snapshot.tree.names[row] for row in known], poses[known, :3])
        return names, len(known), box


def _bounding_box(names: Sequence[str], points: NDArray[np.float64]) -> _Box:
    """The box that the robots can reach in all directions; other frames count only without a robot."""
    robots: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        robots.setdefault(name.partition("/")[0] if "/" in name else "", []).append(row)
    if len(robots) > 1:
        robots.pop("", None)
    corners: list[NDArray[np.float64]] = []
    for rows in robots.values():
        reach = float(np.linalg.norm(points[rows] - points[rows[0]], axis=1).max()) + _MARGIN_M
        corners += [points[rows[0], :2] - reach, points[rows[0], :2] + reach]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return _Box(0.5 * (low + high), 0.5 * (high - low), min(0.0, float(points[:, 2].min())))


def _in_rows(boxes: Sequence[_Box]) -> list[Offset]:
    """The offset of each box in a layout of rows along y on one floor; the first is not moved."""
    columns = math.ceil(math.sqrt(_ASPECT * len(boxes)))
    widths = [max(float(box.half[1]) for box in boxes[k::columns]) for k in range(min(columns, len(boxes)))]
    starts = range(0, len(boxes), columns)
    depths = [max(float(box.half[0]) for box in boxes[start : start + columns]) for start in starts]
    across, behind = _middles(widths), _middles(depths)
    first = boxes[0]
    offsets: list[Offset] = []
    for k, box in enumerate(boxes):
        x = first.middle[0] - behind[k // columns] - box.middle[0]
        y = first.middle[1] + across[k % columns] - box.middle[1]
        offsets.append((float(x), float(y), first.low - box.low))
    return offsets


def _middles(halves: Sequence[float]) -> list[float]:
    """The centres of adjacent intervals, relative to the first."""
    middles = [0.0]
    for before, half in pairwise(halves):
        middles.append(middles[-1] + before + _GAP_M + half)
    return middles


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that puts bot2 before bot10."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", name[:200])]
