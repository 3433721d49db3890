"""Joint states and robot models received from other publishers."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, suppress

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

# Samples kept for a slow reader, or until the model is known.
_CAPACITY = 1024


class JointStateListener(Closeable):
    """Receives the joint states of ``robot``; also a joint source for a ``StatePublisher``.

    ``for reading in listener`` and ``async for reading in listener`` return each sample once, in order of
    arrival, and end with ``close()``; ``read`` returns the newest unread one. Of more than 1024 unread
    samples the oldest are dropped. ``on_reading(reading)`` is called with each sample, from one thread: keep
    it short.

    Numbers are in the order of ``model.joint_names``. The default model is the one in the robot's
    description; samples that arrive before it are kept. ``refused`` counts unusable samples by reason; the
    first of each reason is also logged. A context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        model: RobotModel | None = None,
        *,
        wire: str = "native",
        on_reading: Callable[[JointReading], object] | None = None,
    ) -> None:
        self.robot = robot
        self._refusals = Refusals("joint_states")
        self.refused: dict[str, int] = self._refusals.counts
        self._model = model
        self._validator = None if model is None else JointStateValidator(model)
        self._undescribed: deque[JointState] = deque(maxlen=_CAPACITY)
        self._readings: deque[JointReading] = deque(maxlen=_CAPACITY)
        self._changed = threading.Condition()
        self._waiting_tasks: list[Callable[[], object]] = []
        self._closed = False
        self._on_reading = on_reading
        wire_format = get_wire(wire)
        with ExitStack() as opening:
            if model is None:
                opening.enter_context(DescriptionSubscriber(session, robot, self._on_description, wire))
            on_error = self._refusals.count
            opening.enter_context(
                subscribe(session, wire_format, robot, "joint_states", self._on_messages, on_error=on_error)
            )
            for announcement in announce_reader(session, wire_format, robot, ["joint_states"]):
                opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<JointStateListener of {self.robot!r}: {len(self._readings)} unread samples>"

    @property
    def model(self) -> RobotModel | None:
        """The model of the robot; None before its description has arrived."""
        return self._model

    def _on_description(self, _: str, model: RobotModel) -> None:
        with self._changed:
            self._model, self._validator = model, JointStateValidator(model)
            undescribed = list(self._undescribed)
            self._undescribed.clear()
            self._add(undescribed)  # before samples that arrive now

    def _on_messages(self, received: list[Received]) -> None:
        self._add([one.message for one in received if isinstance(one.message, JointState)])

    def _add(self, states: list[JointState]) -> None:
        with self._changed:
            if self._validator is None:
                self._undescribed.extend(states)
                return
            validator = self._validator
            readings = [reading for state in states if (reading := self._reading(validator, state))]
            self._readings.extend(readings)
            self._wake()
        if self._on_reading is not None:
            for reading in readings:
                self._on_reading(reading)

    def _reading(self, validator: JointStateValidator, state: JointState) -> JointReading | None:
        try:
            return JointReading(*validator.read(state), stamp=state.stamp)
        except (MessageError, InvalidInput) as error:
            reason = error.reason if isinstance(error, MessageError) else "bad numbers"
            self._refusals.count(reason, error)
            return None

    def _wake(self) -> None:
        self._changed.notify_all()
        for wake in self._waiting_tasks:
            wake()
        self._waiting_tasks.clear()

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

    async def __aiter__(self) -> AsyncIterator[JointReading]:
        import asyncio  # noqa: PLC0415  # a caller has it already, and others do not need it

        loop = asyncio.get_running_loop()
        while True:
            arrived = asyncio.Event()

            def wake(arrived: asyncio.Event = arrived) -> None:
                # The loop may be closed by the time a sample arrives.
                with suppress(RuntimeError):
                    loop.call_soon_threadsafe(arrived.set)

            with self._changed:
                reading = self._readings.popleft() if self._readings else None
                if reading is None:
                    if self._closed:
                        return
                    self._waiting_tasks.append(wake)
            if reading is not None:
                yield reading
            else:
                await arrived.wait()

    def close(self) -> None:
        """Unsubscribe; iterations end. A second call does nothing."""
        self._opened.close()
        with self._changed:
            self._closed = True
            self._wake()


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
