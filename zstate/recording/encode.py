"""Encodes robot messages as ROS 2 messages, for a recording or for the clients of a server.

Measurements that ROS has no type for, those of other packages, are in JSON, with a JSON schema, on the topics
``/<namespace>/<stream>/<writer>``, or ``/<namespace>/<stream>`` of a stream whose writers have no names. The
metadata of their channels name the stream and its version.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping
from functools import cache
from types import MappingProxyType
from typing import Protocol

from zstate._util.bounded import BoundedQueue
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import InvalidInput, ModelError
from zstate.model.robot import coordinate_names, velocity_columns_by_position
from zstate.model.urdf import parse_urdf
from zstate.recording.covariances import (
    CHILD_FRAME,
    EdgeCovariance,
    covariance_topic,
    encode_covariance,
    known_covariances,
    ros_name,
)
from zstate.recording.mcap.writer import ChannelId
from zstate.recording.storage import EDGE_WRITER, ROBOT, STREAM, VERSION, ChannelType
from zstate.stream_registry import is_latched, is_value, own_streams, stream_named
from zstate.streams import StreamName
from zstate.wire.joint_order import SampleLayout
from zstate.wire.json_form import carried_as_json, encode_json, json_type
from zstate.wire.messages import (
    POSE_BYTES,
    JointState,
    Message,
    RobotDescription,
    Sample,
    StampedMessage,
    StaticTransforms,
    TransformSample,
    order_digest,
    session_of,
)
from zstate.wire.ros2.cdr import to_time
from zstate.wire.ros2.encoder import RosStreamEncoder, checked_stamp
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.streams import (
    DisplayedForm,
    RecordedForm,
    displayed_form,
    recorded_forms,
    ros_stream,
    uncarried_number,
    without_suffix,
)
from zstate.wire.ros2.topics import SHARED, FrameNames, RmwKeys
from zstate.wire.ros2.types import POSE_WITH_COVARIANCE

MAX_LATCHED = 256
"""Latched messages of one robot: its description, the edges of each static writer, and its maps."""

MAX_MAP_BYTES = 1 << 27
"""Maps of all robots that are repeated in the files that follow: seven of the largest ones."""

MAX_PENDING = 1024
"""Samples of one robot that wait for the description that names their numbers."""
MAX_PENDING_BYTES = 1 << 22
"""Limit of their bytes, if that is reached first."""

MAX_OPEN_CHANNELS = 1024
"""Channels of one robot that are open at once; the least recently used one is released."""
CHANNEL_BURST = 1000
CHANNELS_PER_S = 10.0
"""Rate at which a robot opens channels, per second of log time, after the first ``CHANNEL_BURST``."""

TOPICS: dict[StreamName, StreamName] = {"transforms": "tf", "partial_joint_states": "joint_states"}
"""The streams after which the topics of others are named: ROS has no topics of single writers."""

POSED_FRAME = "zstate.posed_frame"
"""Channel metadata key of the frame whose measured poses a channel has, as it is named in /tf."""

NUMBER = "zstate.number"
"""Channel metadata key of the number that ROS does not carry (``RosStream.uncarried_number``)."""

_NAMED = SampleLayout()


@cache
def _stream_of(kind: type[Message], *, has_name: bool = False) -> StreamName:
    """The stream of messages of type ``kind``; ``has_name`` if their writer has a name, as some on /tf."""
    if has_name and kind is TransformSample:
        return "transforms"
    rows = [row for row in own_streams() if row.type is kind]
    return next((row.name for row in rows if row.named and has_name), rows[0].name)


class MessageOutput(Protocol):
    """Where encoded messages go: a recording (``RecordingWriter``), or the clients of a server."""

    def channel(
        self, topic: str, type: ChannelType, qos: Qos, metadata: Mapping[str, str] | None = None
    ) -> ChannelId:
        """Declare a channel; an equal declaration returns the same id."""
        ...

    def release(self, channel: ChannelId) -> None:
        """Forget a channel without latched messages."""
        ...

    def is_read(self, channel: ChannelId) -> bool:
        """Whether samples of the channel have a reader; they are not encoded without one."""
        ...

    def write(
        self, channel: ChannelId, payload: bytes, log_time: int, publish_time: int, *, sequence: int = 0
    ) -> None:
        """Write a message."""
        ...

    def latch(
        self,
        channel: ChannelId,
        key: str,
        payload: bytes,
        log_time: int,
        publish_time: int,
        *,
        once_per_file: bool = False,
    ) -> bool:
        """Write a message that is in effect until the next of this ``key``; False if it is not written."""
        ...

    def unlatch(self, channel: ChannelId, key: str) -> None:
        """End the effect of a latched message."""
        ...


class RecordingEncoder:
    """Writes the messages of robots, each writer's on channels of its own.

    Samples are written from one thread, latched messages from the same or from one other thread: large ones
    take long to encode, and do not block samples.

    The robot ``alone`` and what belongs to no robot are in the root of ROS's names, with unchanged frame
    names, where every ROS tool finds them; any other robot has a namespace and a frame prefix of its own.
    ``refuse(reason, text)`` is called for each message that cannot be written: CDR cannot represent it ("no
    stamp", "stamp outside 1901 to 2038", "not representable"), its model is unusable ("unusable model"), or
    its robot has opened too many channels ("too many writers", see ``OpenChannels``). It is also called for
    each map that is in one file only, since 128 MiB of maps are repeated in the files that follow ("map not
    repeated"). ``programs`` maps sessions to program names, as far as known when the first message of a
    session is written. ``for_viewer`` selects the forms that only viewers of live robots get.
    """

    def __init__(
        self,
        writer: MessageOutput,
        refuse: Callable[[str, str], None],
        *,
        alone: str | None = None,
        programs: Mapping[int, str] = MappingProxyType({}),
        for_viewer: bool = False,
    ) -> None:
        self._writer = writer
        self._for_viewer = for_viewer
        self._refuse = refuse
        self._root = {SHARED, alone}
        self._namespaces: dict[str, str] = {}
        self._programs = programs
        self._lock = fork_safe_lock()
        self._channels: defaultdict[str, OpenChannels] = defaultdict(OpenChannels)
        self._latched: dict[str, dict[str, ChannelEncoder]] = {}
        self._map_bytes: dict[str, int] = {}
        """Sizes of the maps that are repeated, by the keys of ``_latched_key``."""
        self._statics: dict[tuple[str, int], StaticAccumulator] = {}
        self._orders: dict[str, OrderRegistry] = {}
        self._pending = PendingSamples()
        self._counts: Counter[tuple[str, StreamName]] = Counter()

    @property
    def messages(self) -> dict[tuple[str, StreamName], int]:
        """Messages written, by robot and stream; repetitions of latched ones are not counted."""
        return dict(self._counts)

    @property
    def unwritten(self) -> int:
        """Samples without a matching description: dropped ones, and those that still wait."""
        return self._pending.dropped + self._pending.waiting

    def write_message(
        self,
        robot: str,
        message: Message,
        log_time: int,
        edge_writer: str | None = None,
        *,
        stream: StreamName = "",
    ) -> bool:
        """Write ``message`` of ``robot``, received at ``log_time`` [ns]; the clock belongs to SHARED.

        ``stream`` is the one that carried it: messages of other packages are of any type.

        ``edge_writer`` is the name under which edges are written: static ones, or moving ones of a
        TransformPublisher, which go to the topic tf; or under which a driver publishes some of the joints,
        which go to the topic joint_states; or it is the name of a sensor, of odometry or of a map, and of its
        topic. Without one, as in ROS, the static edges of a session add up. The edge of odometry is not
        written with it.
        Returns False if the robot has no channel left for that writer. Raises RecordingError if the file
        cannot grow.
        """
        try:
            if carried_as_json(stream) and is_latched(stream):
                self._latch(robot, stream, message, log_time, edge_writer or "")
            elif carried_as_json(stream):
                with self._lock:
                    self._write_json(robot, stream, message, log_time, edge_writer or "")
            elif isinstance(message, StaticTransforms):
                if edge_writer is None:
                    key = robot, message.session
                    edges = self._statics.setdefault(key, StaticAccumulator(message.session))
                    message, edge_writer = edges.with_edges(message), f"ros-{message.session}"
                self._latch(robot, "tf_static", message, log_time, edge_writer)
            elif isinstance(message, RobotDescription):
                self._write_description(robot, message, log_time)
            elif is_latched(latched := _stream_of(type(message))):
                self._latch(robot, latched, message, log_time, edge_writer or "")
            elif (form := recorded_forms().get(_stream_of(type(message)))) is not None:
                with self._lock:
                    self._write_form(form, robot, message, log_time, edge_writer or "")
            elif isinstance(message, StampedMessage):
                with self._lock:
                    self._write_sample(robot, message, log_time, edge_writer or "")
        except _TooManyWriters as error:
            self._refuse("too many writers", f"{robot!r}: {error}")
            return False
        except InvalidInput as error:
            reason, stamp = "not representable", 1
            if not carried_as_json(stream):
                stamp = getattr(message, "stamp", 1)
            try:
                to_time(stamp)
            except InvalidInput:
                reason = "stamp outside 1901 to 2038"
            self._refuse(reason if stamp else "no stamp", f"{robot!r}: {error}")
        return True

    def withdraw(self, robot: str, stream: StreamName, name: str, log_time: int) -> None:
        """Write that the writer ``name`` has withdrawn its static edges (``tf_static``), or its ``map``.

        ROS cannot express this: the messages are a TFMessage without transforms, and a grid without cells. A
        value in JSON is not repeated any more.
        """
        with self._lock:
            key = _latched_key(robot, stream, name)
            channel = self._latched.get(robot, {}).pop(key, None)
            self._map_bytes.pop(key, None)
            if channel is not None and carried_as_json(stream):
                self._writer.unlatch(channel.number, key)
            elif channel is not None:
                empty = ros_stream(stream).withdrawn or StaticTransforms(0, (), b"")
                self._writer.latch(channel.number, key, channel.encode(empty), log_time, log_time)
                self._writer.unlatch(channel.number, key)
                self._counts[robot, stream] += 1

    def _write_sample(self, robot: str, message: StampedMessage, log_time: int, edge_writer: str) -> None:
        sample_names = self._orders_of(robot).sample_names(message)
        if sample_names is None:
            self._pending.append(robot, message, log_time)
            return
        stream = _stream_of(type(message), has_name=bool(edge_writer))
        if stream == "transforms":
            assert isinstance(message, TransformSample)
            edges = sample_names.moving_edges if message.edges is None else message.edges
            for one in known_covariances(message, edges):
                self._write_covariance(robot, message, one, log_time, edge_writer)
        child = getattr(message, ros_stream(TOPICS.get(stream, stream)).uncarried, "")
        form = self._form_of(stream, message)
        channel = self._channel(robot, stream, message.session, log_time, edge_writer, child=child, form=form)
        if not self._writer.is_read(channel.number):
            return
        payload = channel.encode(message, sample_names)
        # MCAP begins in 1970; the payload keeps an earlier stamp.
        publish_time = max(message.stamp, 0)
        self._writer.write(channel.number, payload, log_time, publish_time, sequence=message.seq)
        self._counts[robot, stream] += 1

    def _write_json(
        self, robot: str, stream: StreamName, message: Message, log_time: int, edge_writer: str
    ) -> None:
        if not isinstance(message, StampedMessage):
            raise InvalidInput(f"a message of {stream!r} without a stamp")
        channel = self._channel(robot, stream, message.session, log_time, edge_writer)
        if self._writer.is_read(channel.number):
            payload, publish_time = encode_json(message), max(message.stamp, 0)
            self._writer.write(channel.number, payload, log_time, publish_time, sequence=message.seq)
            self._counts[robot, stream] += 1

    def _write_form(
        self, form: RecordedForm, robot: str, message: Message, log_time: int, edge_writer: str
    ) -> None:
        program = "" if form.program_of is None else form.program_of(message, edge_writer)
        payload = form.encode(message, robot, program)
        if payload is None:
            return
        stream = _stream_of(type(message))
        channel = self._channel(robot, stream, session_of(message), log_time, program=program)
        seq, stamp = getattr(message, "seq", 0), max(getattr(message, "stamp", 0), 0)
        self._writer.write(channel.number, payload, log_time, stamp, sequence=seq)
        self._counts[robot, stream] += 1

    def _write_covariance(
        self, robot: str, sample: Sample, covariance: EdgeCovariance, log_time: int, edge_writer: str
    ) -> None:
        """Write the covariance of one edge, before its sample."""
        try:
            channel = self._channel(
                robot, "transforms", sample.session, log_time, edge_writer, child=covariance.child
            )
        except _TooManyWriters as error:  # the sample itself may have a channel
            self._refuse("too many writers", f"{robot!r}, covariance of {covariance.child!r}: {error}")
            return
        if not self._writer.is_read(channel.number):
            return
        payload = channel.encode_covariance(covariance)
        self._writer.write(channel.number, payload, log_time, max(sample.stamp, 0), sequence=sample.seq)

    def _write_description(self, robot: str, description: RobotDescription, log_time: int) -> None:
        self._latch(robot, "robot_description", description, log_time)
        try:
            self._orders_of(robot).add(description, robot)
        except ModelError as error:
            self._refuse("unusable model", str(error))
        with self._lock:
            pending = self._pending.pop(robot)
        for sample, received in pending:
            self.write_message(robot, sample, received)

    def _latch(
        self,
        robot: str,
        stream: StreamName,
        message: Message,
        log_time: int,
        edge_writer: str = "",
    ) -> None:
        key = _latched_key(robot, stream, edge_writer)
        with self._lock:
            latched = self._latched.setdefault(robot, {})
            if key not in latched and len(latched) >= MAX_LATCHED:
                raise _TooManyWriters(
                    f"it has {MAX_LATCHED} latched messages; that of {edge_writer!r} is one more"
                )
            form = self._form_of(stream, message)
            number: int = getattr(message, uncarried_number(stream), 0)
            channel = self._channel(
                robot, stream, session_of(message), log_time, edge_writer, number=number, form=form
            )
        payload = encode_json(message) if carried_as_json(stream) else channel.encode(message)
        with self._lock:
            # The maps of a fleet, with 16 MB each, would be most of a recording if they were repeated.
            once = is_value(stream)
            number = channel.number
            before = latched.get(key, channel)
            if once and not self._may_repeat(key, len(payload)):
                self._writer.write(number, payload, log_time, log_time)
                self._writer.unlatch(before.number, key)
                is_new = True
            else:
                is_new = self._writer.latch(number, key, payload, log_time, log_time, once_per_file=once)
                if before.number != channel.number:
                    self._writer.unlatch(before.number, key)
            latched[key] = channel
            self._counts[robot, stream] += is_new

    def _may_repeat(self, key: str, size: int) -> bool:
        """Whether there is room to repeat the map of ``key`` in the files that follow; counts it if not."""
        self._map_bytes.pop(key, None)
        repeated = sum(self._map_bytes.values())
        if repeated + size > MAX_MAP_BYTES:
            text = (
                f"the map {key!r} of {size} bytes is in one file only: {len(self._map_bytes)} maps with "
                f"{repeated} bytes are repeated in the files that follow, and the limit is {MAX_MAP_BYTES}; "
                "record it by itself, or without splitting the file"
            )
            self._refuse("map not repeated", text)
            return False
        self._map_bytes[key] = size
        return True

    def _orders_of(self, robot: str) -> OrderRegistry:
        # Atomic: descriptions are added from another thread, without the lock.
        return self._orders.setdefault(robot, OrderRegistry())

    def _channel(
        self,
        robot: str,
        stream: StreamName,
        session: int,
        log_time: int,
        edge_writer: str = "",
        *,
        child: str = "",
        program: str = "",
        number: int = 0,
        form: DisplayedForm | None = None,
    ) -> ChannelEncoder:
        """The channel of a writer's stream; with ``child`` of the covariances, or measured poses, of it.

        With ``form`` that of its messages of this form; ``number`` is one that ROS does not carry.
        """
        key = (stream, session, edge_writer, child, number, form)
        opened = self._channels[robot]
        channel = opened.find(key)
        if channel is not None:
            return channel
        if not opened.allow(log_time):
            raise _TooManyWriters("its writers start too often, each with channels of its own")
        options = self._options(robot)
        names = FrameNames(options, robot)
        metadata = {"zstate.session": str(session)}
        if stream != "clock":
            metadata |= {ROBOT: robot, "zstate.frame_prefix": options.frame_prefix}
        if edge_writer:
            metadata[EDGE_WRITER] = edge_writer
        program = program or self._programs.get(session, "")
        if program:
            metadata["zstate.program"] = program
        topic, kind, qos = self.topic(robot, stream, edge_writer, form)
        if number:
            metadata[NUMBER] = str(number)
        if carried_as_json(stream):
            metadata |= {STREAM: stream, VERSION: str(stream_named(stream).version)}
        if child and ros_stream(TOPICS.get(stream, stream)).uncarried:
            metadata[POSED_FRAME] = names.to_ros(child)
        elif child:
            metadata[CHILD_FRAME] = in_ros = names.to_ros(child)
            topic, kind = covariance_topic(options.namespace, names.to_zstate(in_ros)), POSE_WITH_COVARIANCE
        channel = ChannelEncoder(self._writer.channel(topic, kind, qos, metadata), stream, names, form)
        for unused in opened.add(key, channel, self._latched.get(robot, {}).values()):
            self._writer.release(unused.number)
        return channel

    def _form_of(self, stream: StreamName, message: Message) -> DisplayedForm | None:
        """The form of ``message`` if it is not ROS's."""
        form = displayed_form(stream)
        if form is None or not (self._for_viewer or form.decode is not None):
            return None
        return form if form.applies(message) else None

    def topics(
        self, robot: str, stream: StreamName, writer_name: str = ""
    ) -> dict[str, tuple[ChannelType, Qos]]:
        """All topics of ``topic``: that of messages as ROS carries them, and that of their other form."""
        found = [self.topic(robot, stream, writer_name)]
        if (form := displayed_form(stream)) is not None:
            found.append(self.topic(robot, stream, writer_name, form))
        return {topic: (kind, qos) for topic, kind, qos in found}

    def topic(
        self, robot: str, stream: StreamName, writer_name: str = "", form: DisplayedForm | None = None
    ) -> tuple[str, ChannelType, Qos]:
        """The topic that carries a stream of ``robot``, its type and its QoS.

        ``writer_name`` is the name of a sensor, of odometry or of a map. Covariances, measured poses of a
        child, and messages in a ``form`` have further topics. Raises InvalidInput for an invalid name.
        """
        options = self._options(robot)
        if (recorded := recorded_forms().get(stream)) is not None:
            return recorded.topic_in(options.namespace), recorded.type, Qos()
        if carried_as_json(stream):
            tokens = filter(None, (options.namespace, stream, writer_name and ros_name(writer_name)))
            return f"/{'/'.join(tokens)}", json_type(stream_named(stream)), Qos()
        carrier = TOPICS.get(stream, stream)
        topic: str = RmwKeys(options).topic(robot, carrier, ros_name(writer_name))
        kind, qos = ros_stream(carrier)[:2]
        if form is not None:
            topic, kind = f"{without_suffix(topic)}/{form.suffix}", form.type
        return topic, kind, qos

    def _options(self, robot: str) -> Ros2Options:
        """The namespace and the frame prefix of a robot. Raises InvalidInput for an invalid name."""
        if robot in self._root:
            return Ros2Options()
        if robot not in self._namespaces:
            name = ros_name(robot)
            while name in self._namespaces.values():
                name += "_"
            self._namespaces[robot] = name
        return Ros2Options(namespace=self._namespaces[robot], frame_prefix=f"{robot}/")


def _latched_key(robot: str, stream: StreamName, name: str) -> str:
    """The key of a latched message, in the file and in its robot."""
    return f"{robot}/{stream}/{name}"


class ChannelEncoder:
    """Encodes the messages of one writer on ``stream``, for the channel ``number`` of the file.

    ``form`` is theirs, if it is not ROS's.
    """

    def __init__(
        self, number: ChannelId, stream: StreamName, names: FrameNames, form: DisplayedForm | None = None
    ) -> None:
        self.number = number
        self._form = form
        self._stream: StreamName = stream
        self._names = names
        self._sample_names = _NAMED
        self._encoder = RosStreamEncoder(names, _NAMED)

    def encode(self, message: Message, sample_names: SampleLayout = _NAMED) -> bytes:
        """The payload of ``message``; slow for a large latched one. ``sample_names`` names its numbers.

        Raises InvalidInput if CDR cannot represent it.
        """
        if self._form is not None:
            checked_stamp(getattr(message, "stamp", 0))
            return self._form.encode(message, self._names)
        if sample_names is not self._sample_names:
            self._sample_names = sample_names
            self._encoder = RosStreamEncoder(self._names, sample_names)
        return self._encoder.encode(message)

    def encode_covariance(self, covariance: EdgeCovariance) -> bytes:
        """The payload for a channel of covariances. Raises InvalidInput if CDR cannot represent it."""
        return encode_covariance(covariance._replace(parent=self._names.to_ros(covariance.parent)))


class OpenChannels:
    """The open channels of one robot. New ones are opened at a bounded rate.

    Each session has channels of its own, since readers distinguish the starts of a writer by them. The bound
    keeps a robot whose writers restart endlessly from using up all channels of a recording.
    """

    def __init__(self) -> None:
        self._channels: OrderedDict[Hashable, ChannelEncoder] = OrderedDict()
        self._allowed = float(CHANNEL_BURST)
        self._filled_at = 0

    def find(self, key: Hashable) -> ChannelEncoder | None:
        """The channel of ``key``, if it is open."""
        channel = self._channels.get(key)
        if channel is not None:
            self._channels.move_to_end(key)
        return channel

    def add(
        self, key: Hashable, channel: ChannelEncoder, kept: Collection[ChannelEncoder]
    ) -> tuple[ChannelEncoder, ...]:
        """Add a channel; beyond the maximum, remove and return the least recently used not ``kept`` one."""
        self._channels[key] = channel
        if len(self._channels) <= MAX_OPEN_CHANNELS:
            return ()
        unused = next(other for other, channel in self._channels.items() if channel not in kept)
        return (self._channels.pop(unused),)

    def allow(self, log_time: int) -> bool:
        """Whether another channel may be opened now, which counts as opening it."""
        passed_s = max(0, log_time - self._filled_at) / 1e9
        self._filled_at = log_time
        self._allowed = min(float(CHANNEL_BURST), self._allowed + passed_s * CHANNELS_PER_S)
        if self._allowed < 1.0:
            return False
        self._allowed -= 1.0
        return True


class OrderRegistry:
    """Joint and edge orders of one robot by digest; older ones are kept."""

    def __init__(self) -> None:
        self._joints: dict[bytes, SampleLayout] = {}
        self._edges: dict[bytes, SampleLayout] = {}

    def add(self, description: RobotDescription, robot: str) -> None:
        """Add the orders of a description. Raises ModelError if its joints cannot be parsed."""
        edges = description.moving_edges
        self._edges.setdefault(order_digest(edges), SampleLayout(moving_edges=edges))
        order = order_digest(description.joint_names)
        if description.joint_names and order not in self._joints:
            model = parse_urdf(description.urdf, f"the description of {robot!r}")
            self._joints[order] = SampleLayout(coordinate_names(model), velocity_columns_by_position(model))

    def sample_names(self, sample: StampedMessage) -> SampleLayout | None:
        """The names of the numbers in ``sample``, or None before a description with its order."""
        if isinstance(sample, JointState):
            return self._joints.get(sample.order) if sample.names is None else _NAMED
        if isinstance(sample, TransformSample):
            return self._edges.get(sample.order) if sample.edges is None else _NAMED
        return _NAMED


class PendingSamples:
    """Samples received before the description that names their numbers, the newest of each robot.

    ``dropped`` counts those that were replaced by newer ones.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._robots: dict[str, BoundedQueue[tuple[StampedMessage, int]]] = {}

    @property
    def waiting(self) -> int:
        """Number of samples held."""
        return sum(len(pending) for pending in list(self._robots.values()))

    def append(self, robot: str, sample: StampedMessage, log_time: int) -> None:
        """Hold a sample received at ``log_time``, unless it alone exceeds the limit."""
        pending = self._robots.setdefault(robot, BoundedQueue(MAX_PENDING, MAX_PENDING_BYTES))
        blocks: tuple[bytes | None, ...] = ()
        if isinstance(sample, JointState):
            blocks = (sample.positions, sample.velocities, sample.efforts)
        elif isinstance(sample, TransformSample):
            blocks = (sample.poses,)
        self.dropped += pending.append((sample, log_time), sum(len(block or b"") for block in blocks))

    def pop(self, robot: str) -> Iterable[tuple[StampedMessage, int]]:
        """Remove the samples of ``robot``, and return them with their log times."""
        return self._robots.pop(robot, ())


class StaticAccumulator:
    """All static edges of one session so far, as those of a ROS node add up; the newest of each child."""

    def __init__(self, session: int) -> None:
        self._session = session
        self._edges: dict[str, tuple[str, bytes]] = {}

    def with_edges(self, statics: StaticTransforms) -> StaticTransforms:
        """Add these edges; all edges so far."""
        for row, (parent, child) in enumerate(statics.edges):
            self._edges[child] = parent, statics.poses[row * POSE_BYTES : (row + 1) * POSE_BYTES]
        edges = tuple((parent, child) for child, (parent, _) in self._edges.items())
        return StaticTransforms(self._session, edges, b"".join(pose for _, pose in self._edges.values()))


class _TooManyWriters(InvalidInput):
    """The robot has used up its channels."""
