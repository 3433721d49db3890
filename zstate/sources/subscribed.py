"""Joint states and robot models received from other publishers."""

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
from zstate.wire.messages import JointState, RobotDescription
from zstate.wire.registry import get_wire

# Readings queued for a slow reader; the oldest of more are dropped.
_CAPACITY = 1024


class SubscribedSource(Closeable):
    """Joint source that receives the ``joint_states`` of ``robot``: ``for reading in source: ...``

    ``read`` returns the newest unread reading. Iteration ends with ``close()``. ``refused`` counts unusable
    samples by reason; the first of each reason is also logged. ``on_readings()`` is called, from one thread,
    after each batch of samples.
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
        self._validator = JointStateValidator(model)
        self._robot = robot or model.name
        wire_format = get_wire(wire)
        self._readings: deque[JointReading] = deque(maxlen=_CAPACITY)
        self._changed = threading.Condition()
        self._closed = False
        self._on_readings = on_readings
        self._subscriber = subscribe(
            session,
            wire_format,
            self._robot,
            "joint_states",
            self._on_messages,
            on_error=self._refusals.count,
        )
        self._announcements = announce_reader(session, wire_format, self._robot, ["joint_states"])

    def _on_messages(self, received: list[Received]) -> None:
        readings: list[JointReading] = []
        for _, _, state in received:
            assert isinstance(state, JointState)
            try:
                readings.append(JointReading(*self._validator.read(state), stamp=state.stamp))
            except (MessageError, InvalidInput) as error:
                reason = error.reason if isinstance(error, MessageError) else "bad numbers"
                self._refusals.count(reason, error)
        with self._changed:
            self._readings.extend(readings)
            self._changed.notify_all()
        if self._on_readings is not None:
            self._on_readings()

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
        """Unsubscribe; iterations end."""
        for announcement in self._announcements:
            announcement.close()
        self._subscriber.close()
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class DescriptionSubscriber(Closeable):
    """Subscriber of the ``robot_description`` of ``robot`` ("*": of all robots), earlier ones included.

    ``on_description(robot, model)`` is called from one thread with the first model of a robot, and
    with each replacement. ``refused`` counts unusable descriptions by reason; the first of each reason is
    also logged.
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
        """Unsubscribe within a second. A second call does nothing."""
        self._subscriber.close()
