"""The tf2_ros listener in C++, in this process."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from bench.environments import ROS1_LISTENER
from bench.job import Job
from bench.subjects.subject import Answered
from bench.subjects.wakeup_reader import WakeupReader

_ANSWERED = ctypes.CFUNCTYPE(None, ctypes.c_int64)

_library = ctypes.CDLL(str(ROS1_LISTENER))
_library.ros1_pose.argtypes = (ctypes.c_int64, ctypes.POINTER(ctypes.c_double))
_library.ros1_pose.restype = _library.ros1_knows.restype = ctypes.c_bool


class Reader:
    """The library holds the buffer; one reader per process."""

    def __init__(self, job: Job, answered: Answered) -> None:
        self._links = [link.encode() for link in job.links]
        self._wakeup = WakeupReader(job, answered)
        self._answered = _ANSWERED(self._wakeup.on_sample)  # the library keeps no reference
        _library.ros1_listen(job.base.encode(), job.tip.encode(), self._answered)

    def pose(self, stamp: int, robot: int = 0) -> Sequence[float]:
        """Looks up the pose in the buffer."""
        numbers = (ctypes.c_double * 7)()
        if not _library.ros1_pose(stamp, numbers):
            raise LookupError(f"tf2 has no pose at {stamp}")
        return tuple(numbers)

    def has_tree(self) -> bool:
        """Whether the buffer has every link."""
        return all(_library.ros1_knows(link) for link in self._links)

    def close(self) -> None:
        """Leaves the master."""
        self._wakeup.close()
        _library.ros1_close()
