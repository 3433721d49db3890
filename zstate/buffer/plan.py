"""Plans: lookups of one pair of frames, without the search for names."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.buffer.frame_tree import FrameTree
from zstate.buffer.path import TransformPath
from zstate.clock import check_stamp, check_stamps
from zstate.errors import InvalidInput
from zstate.transform import Transform


class Plan:
    """Compiled lookup of ``target_from_source``: ``buffer.lookup`` without the search for names.

    Made by ``TransformBuffer.plan``; follows the buffer when frames are added or withdrawn.
    """

    def __init__(
        self, target: str, source: str, tree: FrameTree, current_path: Callable[[], TransformPath]
    ) -> None:
        self.target = target
        self.source = source
        self._tree = tree
        self._current_path = current_path
        self._cached = tree.version, current_path()

    def __repr__(self) -> str:
        return f"<plan of {self.source!r} in {self.target!r}>"

    def at(self, stamp: int | None = None) -> Transform:
        """The transform at ``stamp`` [ns], or at the newest common instant. Never predicts.

        Raises LookupFailed as ``TransformBuffer.lookup`` does.
        """
        version, path = self._cached
        if version != self._tree.version:
            # The version is read first: a path newer than its version is compiled again, never kept.
            self._cached = self._tree.version, self._current_path()
            path = self._cached[1]
        transform = path.at(stamp)
        if transform is not None:
            return transform
        return path.transform(None if stamp is None else check_stamp(stamp))

    def poses(self, stamps: ArrayLike, out: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """pose7 at each of ``stamps``: (T, 7), written into ``out`` if given.

        Raises LookupFailed for the first stamp without a transform; ``out`` is then unchanged.
        """
        instants = check_stamps(stamps)
        if out is not None and (out.shape != (len(instants), 7) or out.dtype != np.float64):
            raise InvalidInput(f"out must be ({len(instants)}, 7) float64; got {out.shape} {out.dtype}")
        path = self._current_path()
        poses, valid = path.poses(instants)
        while not valid.all():
            # A lookup of the first missing stamp raises the reason, unless its sample has arrived since.
            path.transform(int(instants[valid.argmin()]))
            poses, valid = path.poses(instants)
        if out is None:
            return poses
        out[...] = poses
        return out
