"""Joint states and robot models received from other publishers."""

from __future__ import annotations

import logging
import math
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from typing import Literal

from zstate._util.bounded import BoundedQueue
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.inbox import Inbox
from zstate._util.refusals import Refusals
from zstate.errors import InvalidInput, MessageError, ModelError
from zstate.ingest.early_samples import EARLY_BYTES
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.sources.joint_source import JointReading, JointStateValidator
from zstate.sources.joint_state_merger import JointStateMerger
from zstate.streams import StreamName
from zstate.wire.messages import JointState, RobotDescription, message_size
from zstate.wire.protocol import Wire
from zstate.wire.registry import get_wire

_LOG = logging.getLogger("zstate")

MAX_AGE_S = 0.5
"""The greatest difference of the stamps of the values of one reading [s]."""

# Samples kept for a slow reader, or until the model is known.
_CAPACITY = 1024


class JointStateReader:
    """Computes readings of all joints of ``robot`` from its messages of whole or partial joint states.

    ``max_age_s``, ``stream`` and incomplete readings are those of ``JointStateListener``.
    ``on_error(reason, text)`` is called for each unusable message.
    """

    def __init__(
        self,
        robot: str,
        model: RobotModel,
        wire: Wire,
        max_age_s: float,
        on_error: Callable[[str, object], object],
        *,
        stream: StreamName = "joint_states",
    ) -> None:
        self.model = model
        self.newest: JointReading | None = None
        """The last reading so far."""
        self._robot = robot
        self._on_error = on_error
        self._is_shared = bool(wire.shared)
        self._whole_key = wire.expression(robot, stream)
        self._validator = JointStateValidator(model)
        self._merger = JointStateMerger(model, max_age_s, others=self._is_shared)
        self._explained: set[tuple[str, ...]] = set()

    @property
    def incomplete(self) -> int:
        """How many messages of some joints gave no reading, because of other joints."""
        return self._merger.incomplete

    def readings(self, received: Iterable[Received]) -> list[JointReading]:
        """The reading of each usable message, in their order."""
        readings = [reading for one in received if (reading := self._reading(one))]
        if readings:
            self.newest = readings[-1]
        return readings

    def _reading(self, received: Received) -> JointReading | None:
        state = received.message
        assert isinstance(state, JointState)
        try:
            if self._is_shared:
                if not self._merger.has_all_joints(state):
                    return self._merged(state, f"the ROS node of session {state.session:016x}")
            elif received.key != self._whole_key:
                return self._merged(state, repr(received.key.rpartition("/")[2]))
            return JointReading(*self._validator.read(state), stamp=state.stamp)
        except (MessageError, InvalidInput) as error:
            reason = error.reason if isinstance(error, MessageError) else "bad numbers"
            self._on_error(reason, error)
            return None

    def _merged(self, state: JointState, writer: str) -> JointReading | None:
        merger = self._merger
        reading = merger.add(state, writer)
        if reading is None and (missing := merger.missing_joints()) and missing not in self._explained:
            self._explained.add(missing)
            _LOG.warning("%s: no whole joint states: %s", self._robot, merger.explanation())
        return reading


class JointStateListener(Closeable):
    """Receives the joint states of ``robot``; also a joint source for a ``StatePublisher``.

    ``for reading in listener`` and ``async for reading in listener`` return each sample once, in order of
    arrival, and end with ``close()``; ``read`` returns the newest unread one. If more than 1024 samples are
    unread, the oldest are dropped. ``on_reading(reading)`` is called with each sample, from one thread: keep
    it short.

    If the joints come from several drivers, each with its own joints (``PartialStatePublisher``, in ROS any
    node), each sample of a driver gives one reading of all joints with the newest values of the others. A
    reading is complete if no value is more than ``max_age_s`` [s] older than the newest, by their stamps;
    ``incomplete`` counts samples that gave none. The log names the missing joints and their writers once.

    With ``stream="joint_setpoints"`` the samples are what a ``DriverHost`` writes to its driver, on the
    native wire only. If its driver owns some of the joints, pass their ``model.part(names)``.

    Numbers are in the order of ``model.joint_names``. The default model is the one in the robot's
    description; samples that arrive before it are kept. ``refused`` counts unusable samples by reason; the
    first of each reason is also logged. A context manager.

    Nothing is received in a forked process: there iterations and ``read`` return the unread samples, then
    raise Closed.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        model: RobotModel | None = None,
        *,
        wire: str = "native",
        stream: Literal["joint_states", "joint_setpoints"] = "joint_states",
        on_reading: Callable[[JointReading], object] | None = None,
        max_age_s: float = MAX_AGE_S,
    ) -> None:
        if not (math.isfinite(max_age_s) and max_age_s > 0.0):
            raise InvalidInput(f"max_age_s is a positive number of seconds, not {max_age_s!r}")
        self.robot = robot
        self._refusals = Refusals(stream)
        self.refused: dict[str, int] = self._refusals.counts
        self._max_age_s = max_age_s
        self._wire = get_wire(wire)
        self._reader: JointStateReader | None = None
        self._undescribed: BoundedQueue[Received] = BoundedQueue(_CAPACITY, EARLY_BYTES)
        self._unread: Inbox[JointReading] = Inbox(_CAPACITY, session.check)
        self._lock = fork_safe_lock()
        self._on_reading = on_reading
        self._stream: StreamName = stream
        streams: tuple[StreamName, ...] = (stream,)
        if stream == "joint_states":
            streams = tuple(dict.fromkeys((stream, self._wire.partial_joint_states)))
        with ExitStack() as opening:
            if model is None:
                opening.enter_context(DescriptionSubscriber(session, robot, self._on_description, wire))
            else:
                self._set_model(model)
            on_error = self._refusals.count
            for one in streams:
                opening.enter_context(
                    subscribe(session, self._wire, robot, one, self._on_messages, on_error=on_error)
                )
            for announcement in announce_reader(session, self._wire, robot, streams):
                opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<JointStateListener of {self.robot!r}: {len(self._unread)} unread samples>"

    @property
    def model(self) -> RobotModel | None:
        """The model of the robot; None before its description has arrived."""
        return None if self._reader is None else self._reader.model

    @property
    def incomplete(self) -> int:
        """How many samples of drivers of some joints gave no reading, because of other joints."""
        return 0 if self._reader is None else self._reader.incomplete

    def _set_model(self, model: RobotModel) -> JointStateReader:
        on_error = self._refusals.count
        self._reader = JointStateReader(
            self.robot, model, self._wire, self._max_age_s, on_error, stream=self._stream
        )
        return self._reader

    def _on_description(self, _: str, model: RobotModel) -> None:
        with self._lock:
            reader = self._set_model(model)
            undescribed = list(self._undescribed)
            self._undescribed.clear()
            readings = self._add(reader, undescribed)  # before samples that arrive now
        self._call_back(readings)

    def _on_messages(self, received: list[Received]) -> None:
        with self._lock:
            if self._reader is None:
                for one in received:
                    self._undescribed.append(one, message_size(one.message))
                return
            readings = self._add(self._reader, received)
        self._call_back(readings)

    def _add(self, reader: JointStateReader, received: list[Received]) -> list[JointReading]:
        readings = reader.readings(received)
        self._unread.add(readings)
        return readings

    def _call_back(self, readings: list[JointReading]) -> None:
        if self._on_reading is not None:
            for reading in readings:
                self._on_reading(reading)

    def read(self, stamp: int) -> JointReading | None:
        """The newest reading, independent of ``stamp``; None if none arrived since the last call.

        Raises Closed.
        """
        return self._unread.take_newest()

    def __iter__(self) -> Iterator[JointReading]:
        return iter(self._unread)

    def __aiter__(self) -> AsyncIterator[JointReading]:
        return aiter(self._unread)

    def close(self) -> None:
        """Unsubscribe; iterations end. A second call does nothing."""
        self._opened.close()
        self._unread.close()


class DescriptionSubscriber(Closeable):
    """Subscriber of the ``robot_description`` of a robot, of several or of all ("*"), earlier ones included.

    ``on_description(robot, model)`` is called from one thread with the first model of a robot, and
    with each replacement. ``refused`` counts unusable descriptions by reason; the first of each reason is
    also logged.
    """

    def __init__(
        self,
        session: Session,
        robots: str | Sequence[str],
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
            robots,
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
