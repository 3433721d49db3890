"""Hearing: all that is said about one robot, message by message."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from typing import Protocol

from zstate._util.refusals import Refusals
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.wire.keys import Stream
from zstate.wire.messages import JointState, Message, RobotDescription, StaticTransforms
from zstate.wire.native import NativeWire
from zstate.wire.wire import Arrival


class Hearer(Protocol):
    """Who hears it. What it raises, InvalidInput or MessageError, is counted."""

    def describe(self, description: RobotDescription) -> None:
        """What the robot is."""
        ...

    def place(self, writer: str, statics: StaticTransforms | None) -> None:
        """All static edges of ``writer``; None when it takes them back."""
        ...

    def move(self, state: JointState) -> None:
        """Where its joints are."""
        ...


class Hearing(Closing):
    """Hands ``hearer`` what is said of ``robot``, each stream on a thread of its own."""

    def __init__(self, session: Session, robot: str, hearer: Hearer, refusals: Refusals) -> None:
        self._robot = robot
        self._hearer = hearer
        self._refusals = refusals
        self._wire = NativeWire()
        expression = self._wire.expression
        with ExitStack() as opening:
            key = expression(robot, "robot_description")
            opening.enter_context(LatchedSubscriber(session, key, self._on_description))
            key = expression(robot, "tf_static")
            opening.enter_context(LatchedSubscriber(session, key, self._on_statics))
            key = expression(robot, "joint_states")
            opening.enter_context(StreamSubscriber(session, key, self._on_joints))
            self._opened = opening.pop_all()

    def _on_description(self, arrival: Arrival) -> None:
        if arrival.payload:
            self._hand_over("robot_description", arrival)

    def _on_statics(self, arrival: Arrival) -> None:
        if arrival.payload:
            self._hand_over("tf_static", arrival)
        else:
            with suppress(InvalidInput):  # a key that no writer has
                self._hearer.place(self._wire.statics_writer(arrival.key), None)

    def _on_joints(self, arrivals: list[Arrival]) -> None:
        for arrival in arrivals:
            self._hand_over("joint_states", arrival)

    def _hand_over(self, stream: Stream, arrival: Arrival) -> None:
        try:
            for message in self._wire.decode(stream, arrival, self._robot):
                self._tell(arrival.key, message)
        except MessageError as error:
            self._refusals.count(error.reason, f"{arrival.key}: {error}")
        except InvalidInput as error:
            self._refusals.count("bad numbers", f"{arrival.key}: {error}")

    def _tell(self, key: str, message: Message) -> None:
        if isinstance(message, JointState):
            self._hearer.move(message)
        elif isinstance(message, StaticTransforms):
            self._hearer.place(self._wire.statics_writer(key), message)
        elif isinstance(message, RobotDescription):
            self._hearer.describe(message)

    def close(self) -> None:
        """Stop. A second call does nothing."""
        self._opened.close()
