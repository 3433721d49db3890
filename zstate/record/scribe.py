"""Scribe: what robots say, written into a recording as ROS 2 says it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType

from zstate.errors import InvalidInput, ModelError
from zstate.locks import new_lock
from zstate.record.channel import ROBOT
from zstate.record.gathered import Gathered
from zstate.record.naming import Naming
from zstate.record.orders import EarlySamples, Orders
from zstate.record.pen import Pen, Pens
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

MOST_LATCHED = 256
"""So many descriptions and sets of static edges of a robot hold at once, one of each static writer."""

_STREAMS: dict[type[Message], Stream] = {
    JointState: "joint_states",
    TransformSample: "tf",
    StaticTransforms: "tf_static",
    RobotDescription: "robot_description",
    Clock: "clock",
}


class Scribe:
    """Writes the messages of robots, each writer's on channels of its own.

    Samples are taken in one thread, latched messages in the same or in one other, as large ones take long
    to encode: samples are written meanwhile.

    ``alone`` is the robot that stands in the root of ROS's names (see ``Naming``). ``refuse(reason,
    text)`` is told of each message that cannot be written: CDR has no place for it ("no stamp", "stamp
    outside 1901 to 2038", "not sayable"), its model is of no use ("unusable model"), or its robot has
    opened too many channels ("too many writers", see ``Pens``). ``programs`` says who is behind a session,
    as far as is known when its first message is written.
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
        self._lock = new_lock()
        self._pens: dict[str, Pens] = {}
        self._latched: dict[str, dict[str, Pen]] = {}
        self._gathered: dict[tuple[str, int], Gathered] = {}
        self._orders: dict[str, Orders] = {}
        self._early = EarlySamples()
        self._counts: Counter[tuple[str, Stream]] = Counter()

    @property
    def messages(self) -> dict[tuple[str, Stream], int]:
        """How many were written, by robot and stream; the repetitions of latched ones are not counted."""
        return dict(self._counts)

    @property
    def unwritten(self) -> int:
        """The samples that no description fitted: those that were given up, and those that still wait."""
        return self._early.given_up + self._early.waiting

    def take(self, robot: str, message: Message, log_time: int, static_writer: str | None = None) -> bool:
        """Write ``message`` of ``robot``, which was heard at ``log_time`` [ns]; the clock is SHARED's.

        ``static_writer`` is the name under which static edges are written; without one, as in ROS, those
        of a session add up. Whether the robot may have a channel for that writer. Raises RecordingError
        when the file cannot grow.
        """
        try:
            if isinstance(message, StaticTransforms):
                self._take_statics(robot, message, log_time, static_writer)
            elif isinstance(message, RobotDescription):
                self._take_description(robot, message, log_time)
            elif isinstance(message, Sample | Clock):
                with self._lock:
                    self._take_sample(robot, message, log_time)
        except _TooManyWriters as error:
            self._refuse("too many writers", f"{robot!r}: {error}")
            return False
        except InvalidInput as error:
            self._refuse(_reason(message), f"{robot!r}: {error}")
        return True

    def withdraw(self, robot: str, static_writer: str, log_time: int) -> None:
        """Write that a static writer has taken all its edges back."""
        with self._lock:
            pen = self._latched.get(robot, {}).pop(key := f"{robot}/{static_writer}", None)
            if pen is not None:
                pen.latch(key, pen.encode(StaticTransforms(0, (), b"")), log_time)
                pen.unlatch(key)
                self._counts[robot, "tf_static"] += 1

    def _take_sample(self, robot: str, message: Sample | Clock, log_time: int) -> None:
        sample_names = self._orders_of(robot).sample_names(message)
        if sample_names is None:
            self._early.keep(robot, message, log_time)
            return
        stream = _STREAMS[type(message)]
        self._pen(robot, stream, message.session, log_time).write(message, sample_names, log_time)
        self._counts[robot, stream] += 1

    def _take_description(self, robot: str, description: RobotDescription, log_time: int) -> None:
        self._latch(robot, description, log_time, robot)
        try:
            self._orders_of(robot).learn(description, robot)
        except ModelError as error:
            self._refuse("unusable model", str(error))
        with self._lock:
            early = self._early.pop(robot)
        for sample, heard in early:
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
        with self._lock:
            latched = self._latched.setdefault(robot, {})
            if key not in latched and len(latched) >= MOST_LATCHED:
                raise _TooManyWriters(
                    f"it has {MOST_LATCHED} static writers, and {static_writer!r} is one more"
                )
            pen = self._pen(robot, stream, message.session, log_time, static_writer)
        payload = pen.encode(message)
        with self._lock:
            pen.latch(key, payload, log_time)
            before = latched.get(key, pen)
            if before is not pen:
                before.unlatch(key)
            latched[key] = pen
            self._counts[robot, stream] += 1

    def _orders_of(self, robot: str) -> Orders:
        return self._orders.setdefault(robot, Orders())

    def _pen(self, robot: str, stream: Stream, session: int, log_time: int, static_writer: str = "") -> Pen:
        key = (stream, session, static_writer)
        pens = self._pens.get(robot)
        if pens is None:
            pens = self._pens[robot] = Pens()
        pen = pens.find(key)
        if pen is None:
            if not pens.may_open(log_time):
                raise _TooManyWriters("its writers start too often, each with channels of its own")
            pen = self._new_pen(robot, *key)
            pens.open(key, pen, self._latched.get(robot, {}).values())
        return pen

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


class _TooManyWriters(InvalidInput):
    """The robot has used up its channels."""


def _reason(message: Message) -> str:
    stamp = message.stamp if isinstance(message, Sample | Clock) else 1
    if not stamp:
        return "no stamp"
    try:
        to_time(stamp)
    except InvalidInput:
        return "stamp outside 1901 to 2038"
    return "not sayable"
