"""The tf2_ros listener in C++, in this process."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from bench.job import Job
from bench.subjects.awakening import Awakening
from bench.subjects.ros1_cpp import LIBRARY
from bench.subjects.subject import Answered

_ANSWERED = ctypes.CFUNCTYPE(None, ctypes.c_int64)

_library = ctypes.CDLL(str(LIBRARY))
_library.ros1_pose.argtypes = (ctypes.c_int64, ctypes.POINTER(ctypes.c_double))
_library.ros1_pose.restype = _library.ros1_knows.restype = ctypes.c_bool


class Reader:
    """Its buffer lives in the library; one in a process."""

    def __init__(self, job: Job, answered: Answered) -> None:
        self._links = [link.encode() for link in job.links]
        self._awakening = Awakening(job, answered)
        self._answered = _ANSWERED(self._awakening.heard)  # the library keeps no reference
        _library.ros1_listen(job.base.encode(), job.tip.encode(), self._answered)

    def pose(self, stamp: int, robot: int = 0) -> Sequence[float]:
        """From the buffer."""
        numbers = (ctypes.c_double * 7)()
        if not _library.ros1_pose(stamp, numbers):
            raise LookupError(f"tf2 has no pose at {stamp}")
        return tuple(numbers)

    def has_tree(self) -> bool:
        """As the buffer says."""
        return all(_library.ros1_knows(link) for link in self._links)

    def close(self) -> None:
        """Leave the master."""
        self._awakening.close()
        _library.ros1_close()
