"""A simulated sensor on a robot: where it was while it measured, by the transforms of the robot."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import LookupFailed, NoData

_RESTART_NS = 10**9
"""A clock earlier by more than this was set back, and the sensor starts again; by less, a tick was late."""


class SweepPoses(NamedTuple):
    """The poses (N, 7) of a sensor at N instants of a sweep that starts at ``stamp`` [ns]."""

    stamp: int
    poses: NDArray[np.float64]


class MountedSensor:
    """The frame of a sensor, in the frame of what it measures.

    A sweep ends at the newest stamp that ``buffer`` can place, so that it is right while the robot moves. The
    pose is that in ``world_frame`` if the buffer has that frame, else that in the root of the robot, which
    then stands at the origin of the world. Both frames are full names.
    """

    def __init__(self, buffer: TransformBuffer, frame: str, world_frame: str) -> None:
        self._buffer = buffer
        self._frame, self._world_frame = frame, world_frame
        self._last = -1

    @property
    def target(self) -> str:
        """The frame in which the world stands now; that of the sensor if the buffer does not have that."""
        parents = {frame.name: frame.parent for frame in self._buffer.frames()}
        if self._world_frame in parents:
            return self._world_frame
        name = self._frame
        while (parent := parents.get(name)) is not None:
            name = parent
        return name

    def problem(self) -> LookupFailed | None:
        """Why the pose of the sensor is not known; None if it is."""
        try:
            self._buffer.lookup(self.target, self._frame)
        except LookupFailed as reason:
            return reason
        return None

    def sweep(self, stamp: int, offsets: NDArray[np.int64]) -> SweepPoses | None:
        """The poses of the sweep that ends at ``stamp`` [ns] at the latest, ``offsets`` [ns] after its start.

        None without newer poses than last time, or if the buffer cannot place all of the sweep yet. A clock
        that is set back by more than 1 s, as at the start of each loop of a recording, starts again.
        """
        target = self.target
        if stamp < self._last - _RESTART_NS:
            self._last = -1
        try:
            end = min(stamp, self._newest(target, self._frame, stamp))
            first = end - int(offsets[-1])
            if end <= self._last or first < 0:
                return None
            poses, valid = self._buffer.lookup_many(target, self._frame, offsets + first)
        except LookupFailed:
            return None
        if not valid.all():
            return None
        self._last = end
        return SweepPoses(first, poses)

    def _newest(self, target: str, source: str, stamp: int) -> int:
        """The newest stamp at which ``source`` is placed in ``target``; ``stamp`` if all edges are static."""
        try:
            return self._buffer.latest(target, source)
        except NoData:
            if self._buffer.can_lookup(target, source):
                return stamp
            raise
