"""Joint states of another publisher.

Robot models from descriptions on the network.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.clock import LONGEST_WAIT_S
from zstate.errors import InvalidInput, MessageError, ModelError
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.sources.joint_source import JointReading, JointStateValidator
from zstate.wire.messages import JointState, Message, RobotDescription
from zstate.wire.registry import get_wire

# Readings that wait for a slow reader; of more the oldest are dropped.
_CAPACITY = 1024


class SubscribedSource(Closeable):
    """The ``joint_states`` of ``robot`` as they arrive: ``for reading in source: ...``

    ``read`` returns the newest one that has not been read. Iteration ends with ``close()``. Samples that
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
        self._refusals = Refusals("joint_states")
        self.refused: dict[str, int] = self._refusals.counts
        self._states = JointStateValidator(model)
        self._robot = robot or model.name
        named = get_wire(wire)
        self._readings: deque[JointReading] = deque(maxlen=_CAPACITY)
        self._changed = threading.Condition()
        self._closed = False
        self._on_readings = on_readings
        self._subscriber = subscribe(
            session, named, self._robot, "joint_states", self._on_messages, on_error=self._refusals.count
        )
        self._announcements = announce_reader(session, named, self._robot, ["joint_states"])

    def _on_messages(self, received: list[Received]) -> None:
        readings = [reading for one in received if (reading := self._read(one.message)) is not None]
        with self._changed:
            self._readings.extend(readings)
            self._changed.notify_all()
        if self._on_readings is not None:
            self._on_readings()

    def _read(self, state: Message) -> JointReading | None:
        assert isinstance(state, JointState)
        try:
            numbers = self._states.read(state)
        except (MessageError, InvalidInput) as error:
            reason = error.reason if isinstance(error, MessageError) else "bad numbers"
            self._refusals.count(reason, error)
            return None
        return JointReading(*numbers, stamp=state.stamp)

    def read(self, stamp: int) -> JointReading | None:
        """The newest reading, independent of ``stamp``; None if none arrived since the last call."""
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


class DescriptionSubscriber(Closeable):
    """Subscribes to the ``robot_description`` of ``robot`` ("*": of all robots), earlier ones included.

    ``on_description(robot, model)`` is called from one thread with the first model of a robot, and
    with each one that replaces it. Descriptions that cannot be used are counted in ``refused``, by
    reason; the first of each is also logged.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        on_description: Callable[[str, RobotModel], object],
        wire: str = "native",
    ) -> None:
        self._refusals = Refusals("robot_description")
        self.refused = self._refusals.counts
        self._on_description = on_description
        self._urdfs: dict[str, str] = {}
        self._subscriber = subscribe(
            session,
            get_wire(wire),
            robot,
            "robot_description",
            self._on_messages,
            on_error=self._refusals.count,
        )

    def _on_messages(self, received: list[Received]) -> None:
        for robot, _, description in received:
            assert isinstance(description, RobotDescription)
            if description.urdf == self._urdfs.get(robot):
                continue
            try:
                # Plain URDF text: input from the network opens no files and runs no xacro.
                model = parse_urdf(description.urdf, f"the URDF of {robot!r}")
            except ModelError as error:
                self._refusals.count("model", error)
                continue
            self._urdfs[robot] = description.urdf
            self._on_description(robot, model)

    def close(self) -> None:
        """Stop listening within a second. A second call does nothing."""
        self._subscriber.close()
