"""Moment: where every frame was at one instant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate.errors import UnknownFrame
from zstate.view.chains import Duals, compose, duals_of, invert, poses_of

Poses: TypeAlias = NDArray[np.float64]
Rows: TypeAlias = NDArray[np.intp]
Mask: TypeAlias = NDArray[np.bool_]

_STILL = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Tree:
    """Which frame is placed on which. Frame i is called ``names[i]``; parents stand before children.

    Trees are compared by identity: each change of the buffer makes another one.
    ``parents[i]`` is the row of its parent, -1 for a root. ``kinds`` are those of ``FrameInfo``: joint,
    pose, static or root; ``writers`` say who gives each edge, as far as that is known.
    """

    names: tuple[str, ...]
    parents: Rows
    kinds: tuple[str, ...]
    writers: tuple[str | None, ...]

    @cached_property
    def index(self) -> Mapping[str, int]:
        """The row of each frame."""
        return {name: row for row, name in enumerate(self.names)}

    @cached_property
    def roots(self) -> Rows:
        """The row of the frame above each frame that has no parent."""
        roots = np.arange(len(self.names))
        for row, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                roots[row] = roots[parent]
        return roots

    def row(self, name: str) -> int:
        """The row of a frame. Raises UnknownFrame."""
        try:
            return self.index[name]
        except KeyError:
            near = get_close_matches(name, self.names, n=3)
            raise UnknownFrame(name, name, name=name, near_misses=near, frame_count=len(self.names)) from None


@dataclass(frozen=True, eq=False)
class Moment:
    """The pose of every frame in its parent, at one instant.

    ``poses[i]`` is ``parent_from_child`` of frame i of ``tree``: (N, 7), x y z [m], qx qy qz qw; the
    identity for roots and where ``known[i]`` is False. Why a pose is not known stands in ``reasons[i]``.
    ``stamp`` is the instant [ns]; of what is newest, the newest of all, and None when nothing moves.
    """

    stamp: int | None
    tree: Tree
    poses: Poses
    known: Mask
    reasons: Mapping[int, str] = field(default_factory=dict[int, str])

    def placed(self, fixed: str) -> Poses:
        """The pose of every frame in ``fixed``: (N, 7), NaN where no known edges join the two.

        Row i is ``fixed_from_frame``; the array is the caller's to read only. Raises UnknownFrame.
        """
        done = self._placed.get(fixed)
        if done is None:
            done = self._placed[fixed] = self._place(self.tree.row(fixed))
        return done

    @property
    def tops(self) -> tuple[Rows, Poses]:
        """The highest frame that known edges lead up to from each one, by row, and its pose in that."""
        tops, top_from_frame = self._from_top
        return tops, poses_of(top_from_frame)

    def beside(self, fixed: str, offsets: Mapping[int, Sequence[float]]) -> Poses:
        """As ``placed``, with other trees too, where somebody wants them: their edges do not say.

        ``offsets`` are by the rows of their roots: x, y, z [m] in the root of the fixed frame's tree.
        """
        row = self.tree.row(fixed)
        tops, poses = self.tops
        shifts = np.full((len(poses), 3), np.nan)
        for root, offset in offsets.items():
            shifts[root] = offset
        shifts[tops[row]] = 0.0
        poses[:, :3] += shifts[tops]
        placed = poses_of(compose(invert(self._from_top[1][row : row + 1]), duals_of(poses)))
        placed[np.isnan(shifts[tops, 0])] = np.nan
        return placed

    def _place(self, fixed: int) -> Poses:
        tops, top_from_frame = self._from_top
        fixed_from_top = invert(top_from_frame[fixed : fixed + 1])
        placed = poses_of(compose(fixed_from_top, top_from_frame))
        placed[tops != tops[fixed]] = np.nan
        placed.flags.writeable = False
        return placed

    @cached_property
    def _placed(self) -> dict[str, Poses]:
        return {}

    @cached_property
    def _from_top(self) -> tuple[Rows, Duals]:
        """The highest frame that known edges lead up to, and ``top_from_frame``.

        Each round doubles how far up every frame has come, so that a deep tree needs few of them.
        """
        rows = np.arange(len(self.tree.names))
        up = np.where(self.known & (self.tree.parents >= 0), self.tree.parents, rows)
        duals = duals_of(self.poses)
        duals[up == rows] = _STILL
        while (up[up] != up).any():
            duals, up = compose(duals[up], duals), up[up]
        return up, duals
