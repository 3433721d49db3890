"""Robots from the network as channels of a FoxgloveServer, with the messages that a recording would hold."""

from __future__ import annotations

import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe
from zstate.clock import wait_interruptible
from zstate.errors import InvalidInput
from zstate.foxglove.server import FoxgloveServer, ServedChannel, ServedMessage
from zstate.ingest.counters import Counters
from zstate.net.presence import LivelinessToken, WriterWatch, announce_reader
from zstate.net.session import Session
from zstate.recording.encode import RecordingEncoder
from zstate.recording.mcap.writer import ChannelId
from zstate.recording.recorder import MessageQueue, SampleRecorder, recorded_streams
from zstate.recording.storage import ROBOT, ChannelType
from zstate.stream_registry import is_bulk, is_latched
from zstate.streams import StreamName
from zstate.wire.identity import Announcement
from zstate.wire.keys import ANY, STOP_STREAMS, check_robot
from zstate.wire.messages import ClockMessage, Message, RobotDescription
from zstate.wire.registry import get_wire
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.topics import SHARED

_PERIOD_S = 0.01
"""Samples are forwarded at most so often, together."""
# Robots that start together should be discovered together: it decides their namespaces.
_DISCOVERY_NS = 300_000_000
_POLL_S = 0.05
_JOIN_WITHIN_S = 0.9

Feed = tuple[str, StreamName]
"""A stream of a robot."""

_OF_DRIVERS: tuple[StreamName, ...] = ("driver", *STOP_STREAMS)
"""Drivers and stops have no tokens: their topics come with the joint states."""


class ServedTopics:
    """The MessageOutput of a RecordingEncoder: one channel for each topic, whatever its writers.

    A client of Foxglove uses one channel of each topic; in a recording each writer has its own.
    """

    def __init__(self, server: FoxgloveServer) -> None:
        self._server = server
        self._channels: dict[tuple[str, str], ServedChannel] = {}
        self._users: defaultdict[int, set[object]] = defaultdict(set)
        self._of_robot: defaultdict[str, set[int]] = defaultdict(set)
        self._latched: set[tuple[ChannelId, str]] = set()
        self._bulk: set[int] = set()
        self._waiting: list[ServedMessage] = []

    def open(self, topic: str, type: ChannelType, user: object, *, is_bulk: bool = False) -> ChannelId:
        """The channel of a topic, advertised until each ``user`` has closed it."""
        key = topic, type.name
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = ServedChannel(len(self._channels) + 1, topic, type)
        if is_bulk:
            self._bulk.add(channel.number)
        users = self._users[channel.number]
        if not users:
            self._server.advertise(channel)
        users.add(user)
        return ChannelId(channel.number)

    def close(self, number: ChannelId, user: object) -> None:
        """``user`` no longer needs a channel."""
        users = self._users[number]
        users.discard(user)
        if not users:
            self._server.unadvertise(number)

    def has_readers(self, robot: str) -> bool:
        """Whether a channel is read that only a message of ``robot`` has opened."""
        return any(map(self._server.is_read, self._of_robot.get(robot, ())))

    def close_all(self, robot: str) -> None:
        """Close the channels that messages of ``robot`` opened."""
        for number in self._of_robot.pop(robot, set()):
            self.close(ChannelId(number), robot)

    def unlatch_all(self, stream: StreamName) -> None:
        """Forget the latched messages of ``stream``; the next subscription to it receives them again."""
        for number, key in list(self._latched):
            if key.split("/")[1] == stream:
                self.unlatch(number, key)

    def flush(self) -> None:
        """Send what was written."""
        messages, self._waiting = self._waiting, []
        self._server.send(messages)

    def channel(
        self, topic: str, type: ChannelType, qos: Qos, metadata: Mapping[str, str] | None = None
    ) -> ChannelId:
        known = self._channels.get((topic, type.name))
        if known is not None and self._users[known.number]:
            return ChannelId(known.number)
        robot = (metadata or {}).get(ROBOT, SHARED)
        number = self.open(topic, type, robot)
        self._of_robot[robot].add(number)
        return number

    def release(self, channel: ChannelId) -> None:
        pass  # other writers of the topic have the same channel

    def is_read(self, channel: ChannelId) -> bool:
        return self._server.is_read(channel)

    def write(
        self, channel: ChannelId, payload: bytes, log_time: int, publish_time: int, *, sequence: int = 0
    ) -> None:
        self._waiting.append(ServedMessage(channel, payload, log_time, is_bulk=channel in self._bulk))

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
        self._latched.add((channel, key))
        self._waiting.append(ServedMessage(channel, payload, log_time, key))
        return True

    def unlatch(self, channel: ChannelId, key: str) -> None:
        self.flush()
        self._latched.discard((channel, key))
        self._server.unlatch(channel, key)


class FoxgloveBridge(Closeable):
    """Serves ``robots``, or all robots, on ``wire`` with ``server``; a context manager.

    Channels have the topics, types and frame names of a recording that starts now: a single selected robot,
    or the only robot at the start, is in the root, others have a namespace and a frame prefix. They are
    advertised as long as their writers are announced. A stream is subscribed to, decoded and encoded while a
    client reads one of its topics; only descriptions and the clock are always received. The description of
    each robot is a parameter as well, with the name of its topic. If the clock is simulated, its time is
    broadcast, and is the time of all messages.

    ``on_event(text)`` is called, from the bridge's thread, for robots that come and go. If the bridge fails,
    ``wait`` returns and ``failure`` is the reason. Raises InvalidInput for invalid names.
    """

    def __init__(
        self,
        session: Session,
        server: FoxgloveServer,
        robots: Sequence[str] = (),
        *,
        wire: str = "native",
        on_event: Callable[[str], object] = lambda _: None,
    ) -> None:
        self.failure: Exception | None = None
        self._session = session
        self._server = server
        self._on_event = on_event
        selected = (robots,) if isinstance(robots, str) else tuple(dict.fromkeys(robots))
        self._selected = tuple(map(check_robot, selected))
        self._wire = get_wire(wire)
        self._streams = recorded_streams(self._wire)
        self._topics = ServedTopics(server)
        self._counters = Counters()
        self._samples = SampleRecorder(self._wire, self._counters)
        self._encoder: RecordingEncoder | None = None
        self._starts_at: int | None = None
        self._changes: deque[tuple[Announcement, bool]] = deque()
        self._feeds_of: dict[Announcement, list[tuple[ChannelId, Feed]]] = {}
        self._streams_of: dict[str, set[Announcement]] = {}
        self._descriptions: dict[str, str] = {}
        self._subscribed: dict[StreamName, tuple[str, ...]] = {}
        self._announced: dict[str, tuple[tuple[StreamName, ...], list[LivelinessToken]]] = {}
        self._simulated_time: int | None = None
        self._wakeup = fork_safe(threading.Event())
        self._stop = fork_safe(threading.Event())
        self._ended = fork_safe(threading.Event())
        self._has_other_readers = False
        server.on_readers = self._on_readers
        with ExitStack() as opening:
            self._queue = opening.enter_context(MessageQueue(session, self._wakeup.set))
            everyone = self._selected or (ANY,)
            self._subscribe("robot_description", everyone)
            clock = self._wire.expression(everyone[0], "clock")
            self._queue.subscribe("clock", (clock,), SHARED)
            opening.enter_context(WriterWatch(session, everyone, self._on_writer, wire))
            self._opened = opening.pop_all()
        self._thread = threading.Thread(target=self._run, name="zstate foxglove bridge", daemon=True)
        self._thread.start()

    @property
    def refused(self) -> Mapping[str, int]:
        """Numbers of messages that could not be served, by reason."""
        return self._counters.stats().refused

    def wait(self, timeout_s: float | None = None) -> bool:
        """Block until the bridge has ended, or for ``timeout_s``; whether it has ended."""
        return wait_interruptible(self._ended, timeout_s)

    def close(self) -> None:
        """Stop serving the robots, within a second."""
        self._stop.set()
        self._wakeup.set()
        self._thread.join(_JOIN_WITHIN_S)
        self._opened.close()

    def _on_writer(self, announced: Announcement, alive: bool) -> None:
        if not self._selected or announced.robot in self._selected:
            self._changes.append((announced, alive))
            self._wakeup.set()

    def _on_readers(self) -> None:
        self._has_other_readers = True
        self._wakeup.set()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._wakeup.wait(None if self._encoder else _POLL_S)
                self._wakeup.clear()
                self._encoder = self._encoder or self._new_encoder()
                if self._encoder is not None:
                    if self._changes or self._has_other_readers:
                        self._has_other_readers = False
                        self._update_channels(self._encoder)
                        self._update_subscriptions()
                    self._forward(self._encoder)
                self._stop.wait(_PERIOD_S)
        except Exception as error:  # any error is reported as ``failure``
            if not self._stop.is_set():
                self.failure = error
        finally:
            for _, tokens in self._announced.values():
                for token in tokens:
                    token.close()
            self._ended.set()

    def _new_encoder(self) -> RecordingEncoder | None:
        """None until it is known which robots there are at the start."""
        robots = set(self._selected) or {announced.robot for announced, _ in self._changes.copy()}
        if not self._selected:
            if robots and self._starts_at is None:
                self._starts_at = time.monotonic_ns() + _DISCOVERY_NS
            if self._starts_at is None or time.monotonic_ns() < self._starts_at:
                return None
        others = robots - {SHARED}
        alone = others.pop() if len(others) == 1 else None
        return RecordingEncoder(self._topics, self._counters.count_refusal, alone=alone, for_viewer=True)

    def _update_channels(self, encoder: RecordingEncoder) -> None:
        """Open and close the channels of the writers that have come and gone."""
        while self._changes:
            announced, alive = self._changes.popleft()
            robot = announced.robot
            writers = self._streams_of.setdefault(robot, set())
            if alive and announced not in writers:
                if not writers:
                    self._on_event(f"robot {robot!r} is served")
                writers.add(announced)
                self._feeds_of[announced] = [
                    (self._topics.open(topic, kind, announced, is_bulk=is_bulk(feed[1])), feed)
                    for topic, kind, feed in self._topics_of(encoder, announced)
                ]
            elif not alive and announced in writers:
                writers.discard(announced)
                for number, _ in self._feeds_of.pop(announced):
                    self._topics.close(number, announced)
            self._update_parameter(encoder, robot)
            if not writers:
                del self._streams_of[robot]
                self._topics.close_all(robot)
                self._on_event(f"robot {robot!r} is gone")

    def _topics_of(
        self, encoder: RecordingEncoder, announced: Announcement
    ) -> Sequence[tuple[str, ChannelType, Feed]]:
        """The topics that a writer's messages are on, with the stream that carries them."""
        robot, stream, name = announced.robot, announced.stream, announced.name
        if stream not in self._streams:
            return ()
        # As streams of the topics and of their messages.
        carried: list[tuple[StreamName, StreamName]] = [(stream, stream)]
        if stream != "transforms" and stream in self._wire.edges:
            carried.append(("tf", stream))
        if stream == "joint_states" and "driver" in self._streams:
            carried.extend(zip(_OF_DRIVERS, _OF_DRIVERS, strict=True))
        topics: list[tuple[str, ChannelType, Feed]] = []
        try:
            for of_topic, of_messages in carried:
                for topic, (kind, _) in encoder.topics(robot, of_topic, name).items():
                    topics.append((topic, kind, (robot, of_messages)))
        except InvalidInput as error:
            self._counters.count_refusal("not representable", f"{robot!r}: {error}")
        return topics

    def _update_parameter(self, encoder: RecordingEncoder, robot: str) -> None:
        writers = self._streams_of.get(robot, ())
        has_one = any(one.stream == "robot_description" for one in writers)
        name = encoder.topic(robot, "robot_description")[0]
        self._server.set_parameter(name, self._descriptions.get(robot) if has_one else None)

    def _update_subscriptions(self) -> None:
        """Subscribe to the streams that clients read, and announce this."""
        feeds = {
            feed
            for channels in self._feeds_of.values()
            for number, feed in channels
            if self._server.is_read(number)
        }
        for robot, writers in self._streams_of.items():
            if self._topics.has_readers(robot):  # covariances of moving edges
                feeds |= {(robot, one.stream) for one in writers if one.stream in self._wire.edges}
        robots_of: defaultdict[StreamName, set[str]] = defaultdict(set)
        for robot, stream in feeds:
            robots_of[stream].add(robot)
        for stream in self._streams:
            # On ROS wires robots share topics, whose keys do not name them.
            is_shared = bool(self._wire.shared)
            wanted = tuple(sorted(robots_of[stream]))
            robots = (self._selected or (ANY,)) if wanted and is_shared else wanted
            if stream != "robot_description" and robots != self._subscribed.get(stream, ()):
                self._subscribe(stream, robots)
        announced = {feed for feed in feeds if feed[1] not in _OF_DRIVERS}
        self._announce({robot: {one for its, one in announced if its == robot} for robot, _ in announced})

    def _subscribe(self, stream: StreamName, robots: tuple[str, ...]) -> None:
        if is_latched(stream):
            self._topics.unlatch_all(stream)
        self._queue.unsubscribe(stream)
        self._subscribed[stream] = robots
        if robots:
            expressions = tuple(dict.fromkeys(self._wire.expression(robot, stream) for robot in robots))
            self._queue.subscribe(
                stream, expressions, self._selected[0] if len(self._selected) == 1 else None
            )

    def _announce(self, streams_of: Mapping[str, set[StreamName]]) -> None:
        """Announce this process as the reader of these streams of each robot."""
        for robot in self._announced.keys() | streams_of.keys():
            streams = tuple(sorted(streams_of.get(robot, ())))
            before, tokens = self._announced.get(robot, ((), []))
            if streams == before:
                continue
            if streams:
                new = announce_reader(self._session, self._wire, robot, streams)
                self._announced[robot] = streams, new
            else:
                del self._announced[robot]
            for token in tokens:
                token.close()

    def _forward(self, encoder: RecordingEncoder) -> None:
        for batch in self._queue.pop_all():
            self._samples.start_batch(batch)
            stamp = batch.stamp if self._simulated_time is None else self._simulated_time
            for arrival in batch.arrivals:
                robot = self._samples.robot_of(batch, arrival)
                # A sample that was queued when its robot left would open a channel again.
                may_be_early = is_latched(batch.stream) or batch.stream == "clock"
                is_late = not may_be_early and robot not in self._streams_of
                if robot is None or is_late:
                    continue
                for message in self._samples.write(encoder, robot, batch._replace(stamp=stamp), arrival):
                    self._on_message(encoder, robot, message)
        self._topics.flush()

    def _on_message(self, encoder: RecordingEncoder, robot: str, message: Message) -> None:
        if isinstance(message, RobotDescription):
            self._descriptions[robot] = message.urdf
            self._update_parameter(encoder, robot)
            if robot not in self._streams_of:  # not announced yet, or gone
                self._topics.close_all(robot)
        elif isinstance(message, ClockMessage):
            self._simulated_time = message.stamp
            self._server.set_time(message.stamp)
