"""TransformListener: follows robots on the network and keeps a buffer filled."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Literal

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import Clock
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.following.edges import EdgeFollower
from zstate.following.follower import Follower
from zstate.following.joints import JointFollower
from zstate.following.statics import StaticFollower
from zstate.following.tally import Stats, Tally
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import Writer, watch
from zstate.net.session import Session
from zstate.net.streams import CAPACITY, Arrival, StreamSubscriber
from zstate.wire.keys import ANY, MODEL_WRITER, Stream, robot_of
from zstate.wire.messages import Message, RobotDescription, Sample, StaticTransforms
from zstate.wire.wires import wire_named

Follow = Literal["joint_states", "tf"]


class TransformListener(Closing):
    """Fills ``buffer`` with what a robot's publishers say; ``robot="*"`` follows every robot.

    Frames are called ``robot/frame`` in the buffer, and answer to their bare names while those are
    unique. ``follow="joint_states"`` takes joint positions and the model and does the kinematics here;
    ``follow="tf"`` takes ready transforms and needs no model. A context manager.

    What cannot be used is counted in ``stats``, reported once through ``logging``, and never stops
    the stream.
    """

    def __init__(  # noqa: PLR0917 - the order is that of the published contract
        self,
        session: Session,
        robot: str = ANY,
        buffer: TransformBuffer | None = None,
        wire: str = "native",
        follow: Follow = "joint_states",
        history_s: float = 10.0,
        *,
        clock: Clock | None = None,
    ) -> None:
        if follow not in ("joint_states", "tf"):
            raise InvalidInput(f"follow is 'joint_states' or 'tf', not {follow!r}")
        self.robot = robot
        self.buffer = TransformBuffer(history_s, clock) if buffer is None else buffer
        self._wire = wire_named(wire)
        self._follow: Follow = follow
        self._tally = Tally()
        self._robots: dict[str, Follower] = {}
        self._statics: dict[str, StaticFollower] = {}
        with ExitStack() as opening:
            self._open(session, robot, opening)
            self._opened = opening.pop_all()

    def _open(self, session: Session, robot: str, opening: ExitStack) -> None:
        expression = self._wire.expression
        key = expression(robot, "robot_description")
        opening.enter_context(LatchedSubscriber(session, key, self._on_description))
        key = expression(robot, "tf_static")
        opening.enter_context(LatchedSubscriber(session, key, self._on_statics))
        opening.enter_context(watch(session, robot, self._on_writer))
        key = expression(robot, self._follow)
        opening.enter_context(StreamSubscriber(session, key, self._on_samples))

    @property
    def stats(self) -> Stats:
        """What has been received, lost and refused so far."""
        return self._tally.stats()

    def robots(self) -> tuple[str, ...]:
        """The robots that were heard so far, sorted by name."""
        return tuple(sorted(name for name, robot in list(self._robots.items()) if robot.heard))

    def close(self) -> None:
        """Stop listening; the buffer keeps what it has. A second call does nothing."""
        self._opened.close()

    def _follower(self, robot: str) -> Follower:
        follower = self._robots.get(robot)
        if follower is None:
            make = JointFollower if self._follow == "joint_states" else EdgeFollower
            follower = self._robots.setdefault(robot, make(robot, self.buffer, self._tally))
        return follower

    def _on_samples(self, arrivals: list[Arrival]) -> None:
        overflowed = len(arrivals) >= CAPACITY
        for key, payload, encoding in arrivals:
            sample = self._decode(key, self._follow, payload, encoding)
            if isinstance(sample, Sample):
                self._follower(robot_of(key)).take(sample, overflowed=overflowed)
                overflowed = False

    def _on_description(self, key: str, payload: bytes | None, encoding: str) -> None:
        if payload is None:
            return
        description = self._decode(key, "robot_description", payload, encoding)
        if isinstance(description, RobotDescription):
            self._follower(robot_of(key)).describe(description)

    def _on_statics(self, key: str, payload: bytes | None, encoding: str) -> None:
        robot, writer = robot_of(key), key.rpartition("/")[2]
        if writer == MODEL_WRITER and self._follow == "joint_states":
            return  # the model itself says the same
        statics = self._statics.setdefault(key, StaticFollower(robot, writer, self.buffer, self._tally))
        message = None if payload is None else self._decode(key, "tf_static", payload, encoding)
        if payload is None:
            statics.withdraw()
        elif isinstance(message, StaticTransforms):
            self._follower(robot).note_heard()
            statics.replace(message)

    def _decode(self, key: str, stream: Stream, payload: bytes, encoding: str) -> Message | None:
        try:
            return self._wire.decode(stream, payload, encoding)
        except MessageError as error:
            self._tally.refuse(error.reason, f"{key}: {error}")
            return None

    def _on_writer(self, robot: str, stream: Stream, writer: Writer, alive: bool) -> None:
        if stream != self._follow:
            return
        if alive:
            self._follower(robot).name_writer(writer.session, str(writer))
        else:
            self._follower(robot).writer_left(writer.session)
