"""Named: joint states as documents, with the names of the joints."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING

from zstate.cli.documents import Document, DocumentWriter
from zstate.cli.output.console import print_status
from zstate.clock import wait_in_slices
from zstate.closing import Closing
from zstate.errors import MessageError
from zstate.net.latched import LatchedSubscriber
from zstate.net.wires import wire_named
from zstate.wire.messages import JointState, RobotDescription
from zstate.wire.protocol import SerializedSample

if TYPE_CHECKING:
    from zstate.cli.stream_reader import TimedSample
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session

# A robot's description comes within milliseconds, if there is one.
_NAMES_WITHIN_S = 1.0


class Named(Closing):
    """Names the joints in samples of ``robot``, once it has been described."""

    def __init__(self, session: Session, robot: str, wire: str = "native") -> None:
        self._robot = robot
        self._wire = wire_named(wire)
        self._writer = DocumentWriter()
        self._described = Event()
        self._warned = False
        key = self._wire.expression(robot, "robot_description")
        self._subscriber = LatchedSubscriber(session, key, self._describe)

    def close(self) -> None:
        self._subscriber.close()

    @property
    def model(self) -> RobotModel | None:
        """What the robot is, once it has been described."""
        return self._writer.model

    def _describe(self, arrival: SerializedSample) -> None:
        if not arrival.payload:
            return
        try:
            (description,) = self._wire.decode("robot_description", arrival, self._robot)
        except MessageError as error:
            print_status(f"{arrival.key}: {error}")
            return
        assert isinstance(description, RobotDescription)
        self._writer.describe(description)
        self._described.set()

    def document(self, tapped: TimedSample) -> Document:
        """What a sample says, with the names of its joints if they can be known."""
        assert isinstance(tapped.sample, JointState)
        if not self._writer.knows(tapped.sample) and not self._warned:
            wait_in_slices(self._described, _NAMES_WITHIN_S)
        if not self._writer.knows(tapped.sample) and not self._warned:
            self._warned = True
            why = "is of another model" if self._described.is_set() else "is missing"
            print_status(
                f"the description of {self._robot!r} {why}, so its joints have no names here; "
                f"`zstate publish {self._robot}` publishes it"
            )
        return self._writer.document(tapped.sample)
