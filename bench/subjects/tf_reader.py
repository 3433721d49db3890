"""The reader of ROS 2 messages, shared by the DDS subjects."""

from __future__ import annotations

from typing import Any

from bench.job import Job
from bench.subjects.edges import Pose
from bench.subjects.subject import Answered
from bench.subjects.tf_messages import TfHistory
from bench.subjects.wakeup_reader import WakeupReader


class TfReader:
    """Stores the transforms of each message and answers from them."""

    def __init__(self, job: Job, answered: Answered) -> None:
        self._answered = answered
        self._history = TfHistory(job)
        self._wakeup = WakeupReader(job, self._answer)

    def _on_transforms(self, message: Any) -> None:
        self._wakeup.on_sample(self._history.add(message))

    def _answer(self, stamp: int) -> None:
        if self._history.has_pose(stamp):
            self._answered(stamp)

    def pose(self, stamp: int, robot: int = 0) -> Pose:
        """The pose from the stored transforms."""
        return self._history.pose(stamp)

    def has_tree(self) -> bool:
        """Whether every link has been received."""
        return self._history.has_tree()

    def close(self) -> None:
        """Stops answering."""
        self._wakeup.close()
