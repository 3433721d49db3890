"""Joint states of somebody else, with a word when they begin."""

from __future__ import annotations

from collections.abc import Iterator

from zstate.cli.output.console import print_status
from zstate.cli.words import words_of
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.net.topic_statistics import mean_rate_hz
from zstate.nodes.publisher import StatePublisher
from zstate.sources import JointReading, SubscribedSource


class HeardSource(SubscribedSource):
    """A SubscribedSource that announces the first reading and counts them all.

    Each one is published by ``further`` as well.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        robot: str,
        wire: str,
        *,
        further: StatePublisher,
    ) -> None:
        super().__init__(session, model, robot, wire=wire)
        self.count = 0
        self._further = further
        self._place = words_of(wire).place(robot, ("joint_states",))
        self._first = self._last = 0

    @property
    def rate_hz(self) -> float:
        """The rate of the readings so far, by their stamps; 0 for fewer than two."""
        return mean_rate_hz(self.count, self._last - self._first) or 0.0

    def read(self, stamp: int) -> JointReading | None:
        reading = super().read(stamp)
        if reading is not None:
            self._note(reading)
        return reading

    def __iter__(self) -> Iterator[JointReading]:
        for reading in super().__iter__():
            self._note(reading)
            yield reading

    def _note(self, reading: JointReading) -> None:
        assert reading.stamp is not None
        if not self.count:
            self._first = reading.stamp
            print_status(f"heard {self._place}: {len(reading.positions)} positions")
        self._last = reading.stamp
        self.count += 1
        self._further.publish(reading.positions, reading.velocities, reading.efforts, reading.stamp)
