"""Joint states that somebody else publishes."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Iterator

from zstate.clock import LONGEST_WAIT_S
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError, ZStateError
from zstate.model.edges import EdgeTable
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.net.streams import Arrival, StreamSubscriber
from zstate.sources.source import JointReading
from zstate.wire.joint_order import JointNumbers, JointOrder
from zstate.wire.messages import JointState
from zstate.wire.native import NativeWire

_LOG = logging.getLogger("zstate")

# At most so many readings wait for a slow reader; then the oldest are dropped.
_CAPACITY = 1024


class SubscribedSource(Closing):
    """The ``joint_states`` of ``robot``, as they come in: ``for reading in source: ...``

    ``read`` gives the newest one that has not been read. Iteration ends with ``close()``. Samples that
    cannot be used are counted in ``refused``, by reason; the first of each is also logged.
    """

    def __init__(self, session: Session, model: RobotModel, robot: str | None = None) -> None:
        self.refused: dict[str, int] = {}
        self._model = model
        self._table = EdgeTable(model)
        self._order = JointOrder(model.joint_names)
        self._wire = NativeWire()
        self._readings: deque[JointReading] = deque(maxlen=_CAPACITY)
        self._changed = threading.Condition()
        self._closed = False
        key = self._wire.expression(robot or model.name, "joint_states")
        self._subscriber = StreamSubscriber(session, key, self._take)

    def _take(self, arrivals: list[Arrival]) -> None:
        readings = [reading for arrival in arrivals if (reading := self._read(arrival)) is not None]
        with self._changed:
            self._readings.extend(readings)
            self._changed.notify_all()

    def _read(self, arrival: Arrival) -> JointReading | None:
        _, payload, encoding = arrival
        try:
            state = self._wire.decode("joint_states", payload, encoding)
            assert isinstance(state, JointState)
            numbers = self._order.read(state)
            self._check(numbers)
        except MessageError as error:
            return self._refuse(error.reason, error)
        except InvalidInput as error:
            return self._refuse("bad numbers", error)
        return JointReading(*numbers, stamp=state.stamp)

    def _check(self, numbers: JointNumbers) -> None:
        # All that ``StatePublisher.publish`` would refuse, for that would end its ``run``.
        self._table.normalised(self._model.check_positions(numbers.positions))
        if numbers.velocities is not None:
            self._model.check_velocities(numbers.velocities)
        if numbers.efforts is not None:
            self._model.check_efforts(numbers.efforts)

    def _refuse(self, reason: str, error: ZStateError) -> None:
        if reason not in self.refused:
            _LOG.warning("joint_states refused (%s): %s; further ones are only counted", reason, error)
        self.refused[reason] = self.refused.get(reason, 0) + 1

    def read(self, stamp: int) -> JointReading | None:
        """The newest reading, whatever ``stamp`` is; None when nothing has come since the last call."""
        with self._changed:
            newest = self._readings[-1] if self._readings else None
            self._readings.clear()
        return newest

    def __iter__(self) -> Iterator[JointReading]:
        while True:
            with self._changed:
                if not self._changed.wait_for(lambda: self._readings or self._closed, LONGEST_WAIT_S):
                    continue
                if not self._readings:
                    return
                reading = self._readings.popleft()
            yield reading

    def close(self) -> None:
        """Stop listening; iterations end."""
        self._subscriber.close()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
