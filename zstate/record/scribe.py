"""Scribe: what robots say, written into a recording as ROS 2 says it."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping
from types import MappingProxyType

from zstate.errors import InvalidInput, ModelError
from zstate.record.channel import ROBOT
from zstate.record.gathered import Gathered
from zstate.record.naming import Naming
from zstate.record.orders import Orders
from zstate.record.pen import Pen
from zstate.record.writer import RecordWriter
from zstate.wire.keys import Stream
from zstate.wire.messages import (
    Clock,
    JointState,
    Message,
    RobotDescription,
    Sample,
    StaticTransforms,
    TransformSample,
)
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.ros2.qos import STREAM_QOS
from zstate.wire.ros2.times import to_time
from zstate.wire.ros2.topics import RmwKeys, type_of

EARLY = 1024
"""So many samples of a robot wait for the description that names their numbers."""

_STREAMS: dict[type[Message], Stream] = {
    JointState: "joint_states",
    TransformSample: "tf",
    StaticTransforms: "tf_static",
    RobotDescription: "robot_description",
    Clock: "clock",
}


class Scribe:
    """Writes the messages of robots, each writer's on channels of its own. For one thread.

    ``alone`` is the robot that stands in the root of ROS's names (see ``Naming``). ``refuse(reason,
    text)`` is told of each message that cannot be written: CDR has no place for it ("no stamp", "stamp
    outside 1901 to 2038", "not sayable"), or its model is of no use ("unusable model"). ``programs``
    says who is behind a session, as far as is known when its first message is written.
    """

    def __init__(
        self,
        writer: RecordWriter,
        refuse: Callable[[str, str], None],
        *,
        alone: str | None = None,
        programs: Mapping[int, str] = MappingProxyType({}),
    ) -> None:
        self._writer = writer
        self._refuse = refuse
        self._naming = Naming(alone)
        self._programs = programs
        self._pens: dict[tuple[str, Stream, int, str], Pen] = {}
        self._latched: dict[str, Pen] = {}
        self._gathered: dict[tuple[str, int], Gathered] = {}
        self._orders: dict[str, Orders] = {}
        self._early: dict[str, deque[tuple[Sample | Clock, int]]] = {}
        self._given_up = 0
        self._counts: Counter[tuple[str, Stream]] = Counter()

    @property
    def messages(self) -> dict[tuple[str, Stream], int]:
        """How many were written, by robot and stream; the repetitions of latched ones are not counted."""
        return dict(self._counts)

    @property
    def unwritten(self) -> int:
        """The samples that no description fitted: those that were given up, and those that still wait."""
        return self._given_up + sum(len(early) for early in list(self._early.values()))

    def take(self, robot: str, message: Message, log_time: int, static_writer: str | None = None) -> None:
        """Write ``message`` of ``robot``, which was heard at ``log_time`` [ns]; the clock is SHARED's.

        ``static_writer`` is the name under which static edges are written; without one, as in ROS, those
        of a session add up. Raises RecordingError when the file cannot grow.
        """
        try:
            if isinstance(message, StaticTransforms):
                self._take_statics(robot, message, log_time, static_writer)
            elif isinstance(message, RobotDescription):
                self._take_description(robot, message, log_time)
            elif isinstance(message, Sample | Clock):
                self._take_sample(robot, message, log_time)
        except InvalidInput as error:
            self._refuse(_reason(message), f"{robot!r}: {error}")

    def withdraw(self, robot: str, static_writer: str, log_time: int) -> None:
        """Write that a static writer has taken all its edges back."""
        pen = self._latched.pop(key := f"{robot}/{static_writer}", None)
        if pen is not None:
            pen.latch(key, StaticTransforms(0, (), b""), log_time)
            pen.unlatch(key)
            self._counts[robot, "tf_static"] += 1

    def _take_sample(self, robot: str, message: Sample | Clock, log_time: int) -> None:
        sample_names = self._orders_of(robot).sample_names(message)
        if sample_names is None:
            self._keep_early(robot, message, log_time)
            return
        stream = _STREAMS[type(message)]
        self._pen(robot, stream, message.session).write(message, sample_names, log_time)
        self._counts[robot, stream] += 1

    def _take_description(self, robot: str, description: RobotDescription, log_time: int) -> None:
        self._latch(robot, description, log_time, robot)
        try:
            self._orders_of(robot).learn(description, robot)
        except ModelError as error:
            self._refuse("unusable model", str(error))
        for sample, heard in self._early.pop(robot, ()):
            self.take(robot, sample, heard)

    def _take_statics(
        self, robot: str, statics: StaticTransforms, log_time: int, static_writer: str | None
    ) -> None:
        if static_writer is None:
            gathered = self._gathered.setdefault((robot, statics.session), Gathered(statics.session))
            statics, static_writer = gathered.with_edges(statics), f"ros-{statics.session}"
        self._latch(robot, statics, log_time, f"{robot}/{static_writer}", static_writer)

    def _latch(
        self,
        robot: str,
        message: StaticTransforms | RobotDescription,
        log_time: int,
        key: str,
        static_writer: str = "",
    ) -> None:
        stream = _STREAMS[type(message)]
        pen = self._pen(robot, stream, message.session, static_writer)
        pen.latch(key, message, log_time)
        before = self._latched.get(key, pen)
        if before is not pen:
            before.unlatch(key)
        self._latched[key] = pen
        self._counts[robot, stream] += 1

    def _keep_early(self, robot: str, sample: Sample | Clock, log_time: int) -> None:
        early = self._early.setdefault(robot, deque(maxlen=EARLY))
        self._given_up += len(early) == EARLY
        early.append((sample, log_time))

    def _orders_of(self, robot: str) -> Orders:
        return self._orders.setdefault(robot, Orders())

    def _pen(self, robot: str, stream: Stream, session: int, static_writer: str = "") -> Pen:
        key = (robot, stream, session, static_writer)
        if key not in self._pens:
            self._pens[key] = self._new_pen(*key)
        return self._pens[key]

    def _new_pen(self, robot: str, stream: Stream, session: int, static_writer: str) -> Pen:
        options = self._naming.options(robot)
        metadata = {"zstate.session": str(session)}
        if stream != "clock":
            metadata |= {ROBOT: robot, "zstate.frame_prefix": options.frame_prefix}
        if static_writer:
            metadata["zstate.writer"] = static_writer
        if session in self._programs:
            metadata["zstate.program"] = self._programs[session]
        topic = RmwKeys(options).topic(robot, stream)
        channel = self._writer.channel(topic, type_of(stream), STREAM_QOS[stream], metadata)
        return Pen(self._writer, channel, stream, FrameNames(options, robot))


def _reason(message: Message) -> str:
    stamp = message.stamp if isinstance(message, Sample | Clock) else 1
    if not stamp:
        return "no stamp"
    try:
        to_time(stamp)
    except InvalidInput:
        return "stamp outside 1901 to 2038"
    return "not sayable"
