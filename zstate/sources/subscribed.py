"""Joint states that somebody else publishes."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from zstate.clock import LONGEST_WAIT_S
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError, ZStateError
from zstate.model.robot import RobotModel
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.net.wires import wire_named
from zstate.sources.source import JointReading
from zstate.sources.states import StateReader
from zstate.wire.messages import JointState, Message
from zstate.wire.protocol import SerializedSample

_LOG = logging.getLogger("zstate")

# At most so many readings wait for a slow reader; then the oldest are dropped.
_CAPACITY = 1024


class SubscribedSource(Closing):
    """The ``joint_states`` of ``robot``, as they come in: ``for reading in source: ...``

    ``read`` gives the newest one that has not been read. Iteration ends with ``close()``. Samples that
    cannot be used are counted in ``refused``, by reason; the first of each is also logged. ``on_readings()``
    is called, from one thread, after each batch of samples.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        robot: str | None = None,
        *,
        wire: str = "native",
        on_readings: Callable[[], object] | None = None,
    ) -> None:
        self.refused: dict[str, int] = {}
        self._states = StateReader(model)
        self._robot = robot or model.name
        self._wire = wire_named(wire)
        self._readings: deque[JointReading] = deque(maxlen=_CAPACITY)
        self._changed = threading.Condition()
        self._closed = False
        self._on_readings = on_readings
        key = self._wire.expression(self._robot, "joint_states")
        self._subscriber = StreamSubscriber(session, key, self._take)
        self._announcements = announce_reader(session, self._wire, self._robot, ["joint_states"])

    def _take(self, arrivals: list[SerializedSample]) -> None:
        states = [state for arrival in arrivals for state in self._decode(arrival)]
        readings = [reading for state in states if (reading := self._read(state)) is not None]
        with self._changed:
            self._readings.extend(readings)
            self._changed.notify_all()
        if self._on_readings is not None:
            self._on_readings()

    def _decode(self, arrival: SerializedSample) -> Sequence[Message]:
        try:
            return self._wire.decode("joint_states", arrival, self._robot)
        except MessageError as error:
            self._refuse(error.reason, error)
            return ()

    def _read(self, state: Message) -> JointReading | None:
        assert isinstance(state, JointState)
        try:
            numbers = self._states.read(state)
        except MessageError as error:
            return self._refuse(error.reason, error)
        except InvalidInput as error:
            return self._refuse("bad numbers", error)
        return JointReading(*numbers, stamp=state.stamp)

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
        for announcement in self._announcements:
            announcement.close()
        self._subscriber.close()
        with self._changed:
            self._closed = True
            self._changed.notify_all()
