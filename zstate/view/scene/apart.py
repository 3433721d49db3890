"""Apart: trees of frames that nothing joins to the fixed frame, drawn beside it.

Where they are relative to each other is not known. So they stand in rows, on one floor, as far apart as
their robots reach, each with a label that says so.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FramePoses, FrameTable, Poses, Rows
from zstate.view.scene.nodes import Nodes

_GAP_M = 0.3
_FLESH_M = 0.12  # what meshes have around the frames
# A row is longer than the rows are deep: pictures are wider than high.
_WIDER = 1.6

Offset = tuple[float, float, float]


class _Box(NamedTuple):
    """The room of a tree around its root [m]: its middle and half its size along x, y; its lowest point."""

    middle: NDArray[np.float64]
    half: NDArray[np.float64]
    low: float


class Apart:
    """Places trees beside that of the fixed frame, and labels all when there are several.

    A tree keeps its place while robots move; places are found again when a tree comes or goes, or more of
    its frames have a pose. ``version`` grows then. ``frames`` are those that have a label.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._tree: FrameTable | None = None
        self._found_for: tuple[int, int] | None = None
        self._boxes: dict[str, tuple[tuple[str, ...], int, _Box]] = {}
        self._offsets: dict[int, Offset] = {}
        self._named_offsets: dict[str, Offset] = {}
        self._texts: dict[str, str] = {}
        self._labels: dict[str, tuple[str, viser.LabelHandle]] = {}
        self.version = 0

    @property
    def frames(self) -> frozenset[str]:
        """The frames on whose nodes a label hangs."""
        return frozenset(self._texts)

    def placed(self, moment: FramePoses, fixed: str) -> Poses:
        """As ``moment.poses_in(fixed)``, where every tree has a place. Raises UnknownFrame."""
        tree = moment.tree
        root = int(tree.roots[tree.row(fixed)])
        found_for = root, int(np.count_nonzero(moment.known))
        if tree is not self._tree or found_for != self._found_for:
            self._tree, self._found_for = tree, found_for
            self._find_places(moment, root)
        return moment.poses_side_by_side(fixed, self._offsets) if self._offsets else moment.poses_in(fixed)

    def show(self, nodes: Nodes) -> None:
        """Draw the labels."""
        for frame, (path, label) in list(self._labels.items()):
            if nodes.paths.get(frame) != path:
                del self._labels[frame]  # it went with the node that it hung on
            elif frame not in self._texts:
                label.remove()
                del self._labels[frame]
        for frame, text in self._texts.items():
            path = nodes.paths[frame]
            if frame not in self._labels:
                label = self._scene.add_label(f"{path}/apart", text, anchor="bottom-center")
                self._labels[frame] = path, label
            else:
                self._labels[frame][1].text = text

    def _find_places(self, moment: FramePoses, first: int) -> None:
        names = moment.tree.names
        members = _members(moment.tree)
        others = sorted((row for row in members if row != first), key=lambda row: _natural(names[row]))
        ordered = [first, *others]
        boxes = [self._box(moment, row, members[row]) for row in ordered]
        self._boxes = {name: self._boxes[name] for name in (names[row] for row in ordered)}
        offsets = _in_rows(boxes)
        self._offsets = {row: offset for row, offset in zip(ordered, offsets, strict=True) if row != first}
        named = {names[row]: offset for row, offset in self._offsets.items()}
        self.version += named != self._named_offsets
        self._named_offsets = named
        self._texts = {}
        for row in ordered if others else ():
            called = _called([names[member] for member in map(int, members[row])])
            self._texts[names[row]] = called if row == first else f"{called} (place unknown)"

    def _box(self, moment: FramePoses, root: int, rows: Rows) -> _Box:
        """The largest box that was found for the tree: it does not shrink while samples are missing."""
        tree = moment.tree
        names = tuple(tree.names[row] for row in map(int, rows))
        tops, poses = moment.tops
        known = rows[tops[rows] == root]
        before = self._boxes.get(names[0])
        if before is not None and before[0] == names and before[1] >= len(known):
            return before[2]
        box = _box_of([tree.names[row] for row in map(int, known)], poses[known, :3])
        self._boxes[names[0]] = names, len(known), box
        return box


def _members(tree: FrameTable) -> dict[int, Rows]:
    """The rows of each tree by that of its root, which stands first."""
    order = np.argsort(tree.roots, kind="stable")
    starts = np.flatnonzero(np.diff(tree.roots[order], prepend=-1))
    ends = [*starts[1:].tolist(), len(order)]
    groups = [order[start:end] for start, end in zip(starts.tolist(), ends, strict=True)]
    return {int(tree.roots[group[0]]): group for group in groups}


def _box_of(names: Sequence[str], points: NDArray[np.float64]) -> _Box:
    """Robots may turn and reach to every side; other frames count only where there is no robot."""
    robots: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        robots.setdefault(name.partition("/")[0] if "/" in name else "", []).append(row)
    if len(robots) > 1:
        robots.pop("", None)
    corners: list[NDArray[np.float64]] = []
    for rows in robots.values():
        reach = float(np.linalg.norm(points[rows] - points[rows[0]], axis=1).max()) + _FLESH_M
        corners += [points[rows[0], :2] - reach, points[rows[0], :2] + reach]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return _Box(0.5 * (low + high), 0.5 * (high - low), min(0.0, float(points[:, 2].min())))


def _in_rows(boxes: Sequence[_Box]) -> list[Offset]:
    """How far each box is moved so that all stand in rows along y on one floor, the first unmoved."""
    columns = math.ceil(math.sqrt(_WIDER * len(boxes)))
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
    """Where the middles of intervals are that lie side by side, counted from that of the first."""
    middles = [0.0]
    for before, half in pairwise(halves):
        middles.append(middles[-1] + before + _GAP_M + half)
    return middles


def _called(names: Sequence[str]) -> str:
    """The robot whose tree it is; the root, where it is that of several or of none."""
    robots = {name.partition("/")[0] for name in names if "/" in name}
    return robots.pop() if len(robots) == 1 else names[0]


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that puts bot2 before bot10."""
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", name[:200])]
