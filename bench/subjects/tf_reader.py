"""TfReader: what readers of ROS 2's messages do with them, whichever DDS brings them."""

from __future__ import annotations

from typing import Any

from bench.job import Job
from bench.subjects.awakening import Awakening
from bench.subjects.edges import Pose
from bench.subjects.subject import Answered
from bench.subjects.tf_messages import TfHistory


class TfReader:
    """Keeps the transforms of each message, and answers from them."""

    def __init__(self, job: Job, answered: Answered) -> None:
        self._answered = answered
        self._history = TfHistory(job)
        self._awakening = Awakening(job, self._answer)

    def _on_transforms(self, message: Any) -> None:
        self._awakening.heard(self._history.add(message))

    def _answer(self, stamp: int) -> None:
        if self._history.answers(stamp):
            self._answered(stamp)

    def pose(self, stamp: int, robot: int = 0) -> Pose:
        """From what was kept."""
        return self._history.pose(stamp)

    def has_tree(self) -> bool:
        """Whether every link was heard of."""
        return self._history.has_tree()

    def close(self) -> None:
        """Answer no more."""
        self._awakening.close()
