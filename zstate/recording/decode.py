"""Decodes the records of a recording into the messages that listeners receive."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from hashlib import blake2b
from itertools import islice
from typing import NamedTuple

from zstate.errors import InvalidInput, MessageError, ModelError
from zstate.ingest.joint_parts import JointNames
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.recording.covariances import (
    CovarianceJoin,
    EdgeCovariance,
    child_frame,
    decode_covariance,
    is_covariance_topic,
)
from zstate.recording.encode import NUMBER, POSED_FRAME, TOPICS, StaticAccumulator
from zstate.recording.reader import RecordingReader
from zstate.recording.storage import EDGE_WRITER, JSON, ROBOT, STREAM, VERSION, Channel, Record
from zstate.stream_registry import edge_streams, is_value, stream_named, streams_where
from zstate.streams import StreamName
from zstate.wire.json_form import JsonDecoder, carried_as_json
from zstate.wire.measurements import with_field
from zstate.wire.messages import JointState, Message, RobotDescription, StaticTransforms, TransformSample
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.streams import (
    has_named_topics,
    has_sensor_topics,
    recorded_forms,
    ros_streams,
    uncarried_number,
    without_suffix,
)
from zstate.wire.ros2.topics import SHARED, FrameNames, name_from_topic, robot_from_topic

_TOPICS: tuple[StreamName, ...] = ("robot_description", "tf_static", "joint_states", "tf", "clock")
STREAMS: tuple[StreamName, ...] = (*_TOPICS, *TOPICS)
"""The streams of a robot's state, which are decoded by default. ``transforms`` are channels of the topic tf
with the name of a writer, and those of their covariances; ``partial_joint_states`` channels of the topic
joint_states with such a name."""


def further_streams() -> tuple[StreamName, ...]:
    """Further streams that can be decoded: the channels of these types, whatever their topic is.

    The edges of odometry are recorded on tf as well, and read from there.
    """
    return streams_where(lambda row: row.group == "measurement" or row.name in edges_with_more())


def edges_with_more() -> tuple[StreamName, ...]:
    """The streams of edges with more than poses, as velocities: recorded, and their edges on tf as well."""
    return tuple(name for name in edge_streams() if name not in TOPICS)


_NAMED: dict[StreamName, StreamName] = {topic: named for named, topic in TOPICS.items()}

_SESSION, _PREFIX = "zstate.session", "zstate.frame_prefix"

_MAX_TRIED = 10_000
"""Joint states in which the joints of the model are looked up."""


@dataclass(frozen=True, slots=True)
class RecordedWriter:
    """One writer of one stream, as one channel of a recording describes it.

    ``stream`` may be one of another package, if that is installed here.

    ``robot`` is empty for the clock. ``edge_writer`` is the name under which edges were written: moving ones,
    or static ones, each time all of them; or the name of a driver of some joints, of a sensor, of odometry or
    of a map. In the bags of ROS it is the last name of the topic of scans or of a map, for ``/r1/imu/data``
    of the robot r1 "imu_data", and None for edges, of which static ones add up there. ``program`` is the
    writer's program, ``session`` one start of it. ``foreign`` channels do not describe writers: their robot
    is the topic's namespace, and all writers of a topic count as one.
    """

    robot: str
    stream: StreamName
    session: int
    edge_writer: str | None
    program: str | None
    foreign: bool

    @classmethod
    def from_channel(cls, channel: Channel, robots: Collection[str] = ()) -> RecordedWriter | None:
        """The writer of ``channel``; None if it is no stream of a robot.

        Topics below those of sensors (``has_sensor_topics``) in a bag are those of one of ``robots``, or of
        "ros".
        """
        stream: StreamName = "transforms"
        name, facts = name_from_topic(channel.topic), channel.metadata
        foreign = _SESSION not in facts
        if channel.encoding == JSON:
            stream = facts[STREAM]
            if foreign or not carried_as_json(stream):
                return None
        elif child_frame(channel) is None:
            for stream, carried in ros_streams().items():
                is_named = name == stream or carried.is_named
                is_of_type = channel.type_name == carried.type.name
                if is_named and (is_of_type or carried.recorded_form(channel.type_name) is not None):
                    break
            else:
                found = None if foreign else _stream_of_form(name, channel.type_name)
                if found is None:
                    return None
                stream = found
        if EDGE_WRITER in facts:
            stream = _NAMED.get(stream, stream)
        digest = blake2b(channel.topic.encode(), digest_size=4).digest()
        robot = robot_from_topic(channel.topic) if foreign else facts.get(ROBOT, "")
        if foreign and stream == "pose" and is_covariance_topic(channel.topic):
            return None
        if foreign and has_sensor_topics(stream):
            robot, name = _sensor_from_topic(channel.topic, robots)
        return cls(
            robot="" if stream == "clock" else robot,
            stream=stream,
            session=int.from_bytes(digest, "little") if foreign else int(facts[_SESSION]),
            edge_writer=facts.get(EDGE_WRITER, name if has_named_topics(stream) else None),
            program=facts.get("zstate.program"),
            foreign=foreign,
        )


def _stream_of_form(topic: str, type_name: str) -> StreamName | None:
    """The stream that only recordings have, by the last name and the type of its topic, if any."""
    forms = recorded_forms().items()
    return next((name for name, form in forms if (form.topic, form.type.name) == (topic, type_name)), None)


def _sensor_from_topic(topic: str, robots: Collection[str]) -> tuple[str, str]:
    """The robot of ``topic``: the last of its namespaces that is one of ``robots``; and the name below it."""
    tokens = without_suffix(topic).strip("/").split("/")
    for place in range(len(tokens) - 2, -1, -1):
        if tokens[place] in robots:
            return tokens[place], "_".join(tokens[place + 1 :])
    return SHARED, "_".join(tokens)


def _robots_of(channels: Sequence[Channel]) -> frozenset[str]:
    """The robots of ``channels``, without namespaces that may be those of sensors."""
    writers = filter(None, map(RecordedWriter.from_channel, channels))
    return frozenset(writer.robot for writer in writers if not has_sensor_topics(writer.stream))


def recorded_writers(channels: Sequence[Channel]) -> list[RecordedWriter | None]:
    """The writers of all ``channels`` of a recording, in their order."""
    robots = _robots_of(channels)
    return [RecordedWriter.from_channel(channel, robots) for channel in channels]


class DecodedMessage(NamedTuple):
    """One message, its writer, and when it was recorded [ns]."""

    writer: RecordedWriter
    message: Message
    log_time: int


class UndecodedRecord(NamedTuple):
    """One record, the decoder of its channel, and the sequence number of its message."""

    channel: ChannelDecoder
    record: Record
    seq: int


class DecodedRecording:
    """The messages of a recording by zstate, or of a bag of ROS 2.

    Messages that cannot be decoded are left out; ``refuse(reason, text)`` is called for each. Sequence
    numbers are the writers', or count the messages of a foreign channel.
    """

    def __init__(self, reader: RecordingReader, refuse: Callable[[str, str], None]) -> None:
        self._reader = reader
        self._refuse = refuse
        self._known: dict[Channel, ChannelDecoder | None] = {}
        self._counts: Counter[RecordedWriter] = Counter()
        self._topics: dict[str, set[RecordedWriter]] = {}
        self.ignored: tuple[Channel, ...] = ()
        self._bag_robots = _robots_of(reader.channels())
        for channel in reader.channels():
            decoder = self._decoder(channel)
            if decoder is None:
                self.ignored += (channel,)
            else:
                self._counts[decoder.writer] += 0 if decoder.covariances_of else channel.count
                self._topics.setdefault(channel.topic, set()).add(decoder.writer)

    @property
    def writers(self) -> dict[RecordedWriter, int]:
        """All writers with at least one message, and their number of messages."""
        return {writer: count for writer, count in self._counts.items() if count}

    @property
    def robots(self) -> tuple[str, ...]:
        """The robots in the recording, by name; "ros" for what is in no namespace of a bag.

        Without the places that have maps only.
        """
        return tuple(sorted({writer.robot for writer in self.writers if not is_value(writer.stream)} - {""}))

    @property
    def names(self) -> tuple[str, ...]:
        """The robots, and the places that have maps only."""
        return tuple(sorted({writer.robot for writer in self.writers} - {""}))

    def writers_of(self, robots: Collection[str] | None) -> set[RecordedWriter]:
        """The writers of ``robots`` (None: of all).

        The clock belongs to every robot, and so do the transforms that are in no namespace of a bag.
        """
        return {
            writer
            for writer in self.writers
            if robots is None
            or writer.stream == "clock"
            or writer.robot in robots
            or (writer.foreign and writer.robot == SHARED and writer.stream in ("tf", "tf_static"))
        }

    def messages(
        self,
        robots: Collection[str] | None = None,
        streams: Collection[StreamName] = STREAMS,
        begin: int | None = None,
        end: int | None = None,
    ) -> Iterator[DecodedMessage]:
        """The messages of ``writers_of(robots)`` on ``streams``, by log time in [begin, end)."""
        joined = JoinedMessages(self)
        for undecoded in self.records(robots, streams, begin, end):
            yield from joined.add(undecoded)

    def covariance(self, undecoded: UndecodedRecord) -> EdgeCovariance | None:
        """The covariance in a record of some; None if it cannot be decoded."""
        channel, record, _ = undecoded
        try:
            covariance = decode_covariance(record.payload, channel.covariances_of)
        except MessageError as error:
            self._refuse(error.reason, f"{record.topic}: {error}")
            return None
        to_zstate = channel.names.to_zstate
        parent, child = to_zstate(covariance.parent), to_zstate(covariance.child)
        return covariance._replace(parent=parent, child=child)

    def decode(self, undecoded: UndecodedRecord) -> Iterator[DecodedMessage]:
        """The messages of one record; none if it cannot be decoded."""
        channel, record, seq = undecoded
        writer = channel.writer
        messages: Sequence[Message]
        try:
            if (form := recorded_forms().get(writer.stream)) is not None:
                messages = (form.decode(record.payload, writer.session, seq),)
            elif channel.json is not None:
                messages = (channel.json.decode(record.payload),)
            elif (decode := channel.decode_form) is not None:
                messages = (decode(record.payload, writer.session, seq, channel.names),)
            else:
                topic = channel.topic
                messages = channel.ros.messages(topic, record.payload, writer.session, seq, channel.names)
        except MessageError as error:
            self._refuse(error.reason, f"{record.topic}: {error}")
            return
        for message in messages:
            content = with_field(message, field, channel.posed) if (field := channel.uncarried) else message
            if channel.number:
                content = with_field(content, uncarried_number(writer.stream), channel.number)
            yield DecodedMessage(writer, content, record.log_time)

    def records(
        self,
        robots: Collection[str] | None = None,
        streams: Collection[StreamName] = STREAMS,
        begin: int | None = None,
        end: int | None = None,
    ) -> Iterator[UndecodedRecord]:
        """The records of ``messages`` and of their covariances, for readers that decode many together."""
        selected = {writer for writer in self.writers_of(robots) if writer.stream in streams}
        topics = {topic for topic, writers in self._topics.items() if writers & selected}
        counts: Counter[RecordedWriter] = Counter()
        last: Channel | None = None
        decoder: ChannelDecoder | None = None
        # Without topics there is nothing to read, while None would mean all.
        for record in self._reader.records(topics, begin, end) if topics else ():
            if record.channel is not last:  # the hash of a channel costs as much as its record
                last, decoder = record.channel, self._decoder(record.channel)
                if decoder is not None and decoder.writer not in selected:
                    decoder = None
            if decoder is None:
                continue
            seq = record.sequence
            if decoder.writer.foreign:
                counts[decoder.writer] += 1
                seq = counts[decoder.writer]
            yield UndecodedRecord(decoder, record, seq)

    def _decoder(self, channel: Channel) -> ChannelDecoder | None:
        if channel not in self._known:
            writer = RecordedWriter.from_channel(channel, self._bag_robots)
            decoder = None
            if writer is not None:
                options = Ros2Options(frame_prefix=channel.metadata.get(_PREFIX, ""))
                names = FrameNames(options, writer.robot or SHARED)
                topic = TOPICS.get(writer.stream, writer.stream)
                posed = channel.metadata.get(POSED_FRAME, "")
                json = None
                if channel.encoding == JSON:
                    json = JsonDecoder(stream_named(writer.stream), channel.metadata.get(VERSION, "1"))
                carried = ros_streams().get(writer.stream)
                form = None if carried is None else carried.recorded_form(channel.type_name)
                decoder = ChannelDecoder(
                    *(writer, topic, names, RosDecoder(), child_frame(channel) or ""),
                    posed and names.to_zstate(posed),
                    json,
                    None if form is None else form.decode,
                    int(channel.metadata.get(NUMBER, "0")),
                )
            self._known[channel] = decoder
        return self._known[channel]


class JoinedMessages:
    """The messages of records in the order of the recording, transforms with their covariances."""

    def __init__(self, recording: DecodedRecording) -> None:
        self._recording = recording
        self._joins: defaultdict[RecordedWriter, CovarianceJoin] = defaultdict(CovarianceJoin)

    def add(self, undecoded: UndecodedRecord) -> Iterator[DecodedMessage]:
        """The messages of the next record."""
        writer, joins = undecoded.channel.writer, self._joins
        if undecoded.channel.covariances_of:
            if (covariance := self._recording.covariance(undecoded)) is not None:
                joins[writer].add(covariance)
            return
        for decoded in self._recording.decode(undecoded):
            if joins and writer in joins and isinstance(decoded.message, TransformSample):
                yield decoded._replace(message=joins[writer].join(decoded.message))
            else:
                yield decoded


class ChannelDecoder(NamedTuple):
    """The writer of a channel, the stream that its topic is named after, and the decoder of its messages.

    A channel of covariances has those of the child frame ``covariances_of``, by its name in ROS; one of
    poses, those of the frame ``posed``, empty for the base of the robot. ``json`` decodes a channel in JSON,
    ``decode_form`` one with messages in another form than ROS carries them. ``number`` is one of its messages
    that ROS does not carry.
    """

    writer: RecordedWriter
    topic: StreamName
    names: FrameNames
    ros: RosDecoder
    covariances_of: str
    posed: str
    json: JsonDecoder | None
    decode_form: Callable[..., Message] | None
    number: int

    @property
    def uncarried(self) -> str:
        """The field with the frame ``posed``; empty if its messages have none."""
        carried = ros_streams().get(self.writer.stream)
        return "" if carried is None else carried.uncarried


class LatchedState:
    """The robot descriptions, static edges and maps in effect at one point of a recording."""

    def __init__(self) -> None:
        self.descriptions: dict[str, DecodedMessage] = {}
        """By robot."""
        self.values: dict[tuple[str, StreamName, str], DecodedMessage] = {}
        """Maps and so on, by robot, stream and name; of a withdrawn map a grid without cells."""
        self._statics: dict[tuple[str, str], DecodedMessage] = {}
        self._accumulated: dict[RecordedWriter, StaticAccumulator] = {}

    @property
    def statics(self) -> tuple[DecodedMessage, ...]:
        """One of each static writer, with all of its edges."""
        return tuple(self._statics.values())

    def update(self, decoded: DecodedMessage) -> DecodedMessage | None:
        """The message if it changes the state; None if it repeats what is in effect, or is a sample.

        Static edges that add up, as in the bags of ROS, are returned all together.
        """
        writer, message, _ = decoded
        if isinstance(message, RobotDescription):
            before = self.descriptions.get(writer.robot)
            self.descriptions[writer.robot] = decoded
        elif isinstance(message, StaticTransforms):
            if writer.edge_writer is None:
                edges = self._accumulated.setdefault(writer, StaticAccumulator(writer.session))
                decoded = decoded._replace(message=edges.with_edges(message))
            key = static_key(writer)
            before = self._statics.get(key)
            self._statics[key] = decoded
        elif is_value(writer.stream):
            before = self.values.get(key := (writer.robot, writer.stream, writer.edge_writer or ""))
            self.values[key] = decoded
        else:
            return None
        is_same = before is not None and _latched_value(before.message) == _latched_value(decoded.message)
        return None if is_same else decoded


def _latched_value(message: Message) -> object:
    """What a latched message states, whatever session repeats it."""
    if isinstance(message, RobotDescription):
        return message.urdf
    if isinstance(message, StaticTransforms):
        return message.edges, message.poses
    return tuple(getattr(message, name) for name in message.__struct_fields__ if name != "session")


def static_key(writer: RecordedWriter) -> tuple[str, str]:
    """The robot of static edges, and the name of their static writer, "recorded" for a bag."""
    return writer.robot, writer.edge_writer or "recorded"


def check_has_robot(recording: DecodedRecording, robot: str) -> str:
    """``robot``, if the recording has it or maps of it. Raises InvalidInput, which names its robots."""
    if robot not in recording.names:
        names = ", ".join(map(repr, recording.robots)) or "none"
        raise InvalidInput(f"the recording has no robot {robot!r}; its robots: {names}")
    return robot


def robot_with_joint_states(
    recording: DecodedRecording, robot: str | None, streams: Collection[StreamName] = ("joint_states",)
) -> str:
    """``robot``, or the only one with joint states on ``streams``.

    Raises InvalidInput, which names those that have some.
    """
    robots = sorted({writer.robot for writer in recording.writers if writer.stream in streams})
    if robot in robots:
        return robot
    if robot is None and len(robots) == 1:
        return robots[0]
    there = ", ".join(map(repr, robots)) or "none"
    what = f"joint_states of {robot!r}" if robot else "the joint_states of one robot"
    advice = f"; name one of them as ROBOT, in Python robot={robots[0]!r}" if robot is None and robots else ""
    raise InvalidInput(f"the recording does not hold {what}; it has those of {there}{advice}")


def first_descriptions(
    recording: DecodedRecording, robots: Collection[str] | None = None
) -> dict[str, DecodedMessage]:
    """The first description of each robot."""
    described = {writer.robot for writer in recording.writers if writer.stream == "robot_description"}
    missing = described if robots is None else described.intersection(robots)
    found: dict[str, DecodedMessage] = {}
    for decoded in recording.messages(missing, ("robot_description",)):
        found.setdefault(decoded.writer.robot, decoded)
        if found.keys() == missing:
            break
    return found


def recorded_model(
    recording: DecodedRecording, description: DecodedMessage, refuse: Callable[[str, str], None]
) -> RobotModel | None:
    """The model of a described robot, or None if its joint states cannot be used with it.

    That is the case without joint states, with a URDF that cannot be parsed, and if the first joint states
    together lack a joint: in a bag of ROS the rest may be on another topic, or in tf alone. A robot with
    ``partial_joint_states`` may lack drivers, as it may live.
    """
    robot, message = description.writer.robot, description.message
    assert isinstance(message, RobotDescription)
    try:
        # The text only: a URDF from a file opens no other files and runs no xacro.
        model = parse_urdf(message.urdf, f"the URDF of {robot!r}")
    except ModelError as error:
        refuse("robot description", f"{robot!r}: {error}")
        return None
    if any((one.robot, one.stream) == (robot, "partial_joint_states") for one in recording.writers):
        return model
    names, missing = JointNames(model), set(model.joint_names)
    for decoded in islice(recording.messages((robot,), ("joint_states",)), _MAX_TRIED):
        assert isinstance(decoded.message, JointState)
        with suppress(MessageError):  # of other joints
            missing.difference_update(names.joints(decoded.message.names or (), others=True))
        if not missing:
            return model
    return None
