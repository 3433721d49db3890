"""Collects what robots publish during a short window, and what has arrived of each of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.doctor.check import Check
from zstate.cli.doctor.plugin_checks import opened_checks
from zstate.cli.output.wire_text import RosMessages, messages_for
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import NoClock, Unreachable
from zstate.ingest.counters import ListenerStats
from zstate.ingest.events import WriterEvent
from zstate.model.robot import RobotModel, coordinate_names
from zstate.net.clock_offset import MeasuredOffset, measure_offsets, unanswered
from zstate.net.discovery import RobotInfo, discover, discover_readers
from zstate.net.session import Session
from zstate.net.sites import NO_SITES, Sites, discover_sites
from zstate.net.status_monitor import StatusSubscriber
from zstate.net.subscription import Received, subscribe
from zstate.net.topic_statistics import IntervalStatistics, TopicStatistics, WriterKey
from zstate.nodes.clock import SimulatedClock
from zstate.nodes.listener import Follow, TransformListener
from zstate.stream_registry import edge_streams, is_latched, is_measured, measured_streams, stream_named
from zstate.streams import JOINT_STREAMS, StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StampedMessage,
    Status,
    TransformSample,
    from_block,
    order_digest,
)
from zstate.wire.registry import get_wire

_MIN_WINDOW_S = 1.2  # writers publish their status once a second
_READERS_WITHIN_S = 0.3
_REPLY_WITHIN_S = 0.4


def _measured() -> tuple[StreamName, ...]:
    """The streams of measurements, and of moving edges in messages of their own."""
    return (*measured_streams(), *(stream for stream in edge_streams() if stream != "transforms"))


def has_frame(stream: StreamName) -> bool:
    """Whether its messages are measured in one frame, their ``frame``."""
    return is_measured(stream) and "frame" in stream_named(stream).type.__struct_fields__


def _native_streams() -> tuple[StreamName, ...]:
    return (*sorted(JOINT_STREAMS), "transforms", *_measured())


def _ros_streams() -> tuple[StreamName, ...]:
    carries = get_wire("ros2").carries
    return ("joint_states", "tf", *filter(carries, _measured()))


class WriterSamples:
    """Samples of one writer: ``statistics``, the ``newest``, ``names`` of joints or frames, and ranges.

    The frames are those that its edges place, or those of its measurements.
    """

    def __init__(self, statistics: IntervalStatistics) -> None:
        self.statistics = statistics
        self.newest: Any = None
        self.names: dict[str, None] = {}
        self._joints: tuple[str, ...] | None = None
        self._order = b""
        self._extremes = np.empty((2, 0))

    def add(self, sample: StampedMessage) -> None:
        """Include ``sample``; positions in another joint order replace all before."""
        self.newest = sample
        if isinstance(frame := getattr(sample, "frame", None), str):
            self.names[frame] = None
        elif isinstance(sample, TransformSample):
            self.names.update(dict.fromkeys(child for _, child in sample.edges or ()))
        elif isinstance(sample, JointState):
            self.names.update(dict.fromkeys(sample.names or ()))
            positions = from_block(sample.positions)
            if (sample.order, positions.size) != (self._order, self._extremes.shape[1]):
                self._joints, self._order = sample.names, sample.order
                self._extremes = np.stack((positions, positions))
            np.fmin(self._extremes[0], positions, out=self._extremes[0])
            np.fmax(self._extremes[1], positions, out=self._extremes[1])

    def positions(self, model: RobotModel) -> NDArray[np.float64]:
        """Two position vectors of ``model``, the least and the greatest; NaN for what the samples lack."""
        coordinates, names = coordinate_names(model), self._joints
        if names is None:
            names = coordinates if self._order == order_digest(model.joint_names) else ()
        columns = {name: column for column, name in enumerate(names)}
        found = np.full((2, len(coordinates)), np.nan)
        for column, name in enumerate(coordinates):
            if name in columns:
                found[:, column] = self._extremes[:, columns[name]]
        return found


class StreamSamples(NamedTuple):
    """The samples of one stream of a robot: those of each of its ``writers``, by session.

    ``statistics`` are of all writers together, and only of the streams that poses are computed from.
    """

    statistics: IntervalStatistics
    writers: Mapping[int, WriterSamples]


class StreamCollector(Closeable):
    """Subscribes to all streams of ``robots``, to their models, and to the status of their writers.

    One set of subscriptions serves all robots: on the native wire, for more than one robot, that of all
    robots there are. ``on_change()`` is called after each sample and each latched value.
    """

    def __init__(
        self, session: Session, robots: Sequence[RobotInfo], wire: str, on_change: Callable[[], object]
    ) -> None:
        self.is_native = wire == "native"
        self.robot = robots[0].name if len(robots) == 1 else ANY
        self.descriptions: dict[str, RobotDescription] = {}
        self.statuses: dict[str, dict[int, Status]] = {info.name: {} for info in robots}
        self.events: dict[str, list[WriterEvent]] = {info.name: [] for info in robots}
        self._session, self._on_change = session, on_change
        self._wire = get_wire(wire)
        self._samples: dict[tuple[str, StreamName], dict[int, WriterSamples]] = {}
        self._listeners: dict[Follow, TransformListener] = {}
        followed: dict[Follow, list[str]] = {}
        for info in robots:
            followed.setdefault(followed_stream(info, wire), []).append(info.name)
        with ExitStack() as opening:
            opening.enter_context(
                subscribe(session, self._wire, self.robot, "robot_description", self._on_descriptions)
            )
            self.plugins = opening.enter_context(opened_checks(session, robots, wire, on_change))
            topic = TopicStatistics(session, self._wire, sources=_sources, on_sample=self._on_sample)
            self.topic = opening.enter_context(topic)
            for stream in _native_streams() if self.is_native else _ros_streams():
                topic.subscribe(stream, self.robot)
            # A subscription to tf makes publishers compute it: only of the robots that have nothing else.
            for name in followed.get("tf", ()) if self.is_native else ():
                topic.subscribe("tf", name)
            if self.is_native:
                opening.enter_context(StatusSubscriber(session, self.robot, self._on_status))
            for follow, names in followed.items():
                of = self.robot if follow == "joint_states" else names
                listener = TransformListener(session, of, wire=wire, follow=follow, on_event=self._on_event)
                self._listeners[follow] = opening.enter_context(listener)
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def listener(self, follow: Follow) -> TransformListener:
        """The listener of all robots that move by the stream ``follow``."""
        return self._listeners[follow]

    def samples(self, robot: str, stream: StreamName) -> StreamSamples:
        """What has arrived of ``stream`` of ``robot``."""
        statistics = self.topic.get((robot, stream)) or IntervalStatistics()
        return StreamSamples(statistics, self._samples.get((robot, stream), {}).copy())

    @property
    def has_overrun(self) -> bool:
        """Whether more samples have arrived than were taken in here, so that rates are too low."""
        return self.topic.has_overrun

    @cached_property
    def frames(self) -> dict[Follow, FleetFrames]:
        """The frames of all robots, when first asked for."""
        return {follow: FleetFrames(one.buffer.frames()) for follow, one in self._listeners.items()}

    @cached_property
    def simulated_now(self) -> int | NoClock:
        """The simulated time [ns], or why there is none; waits up to half a second when first asked for."""
        with SimulatedClock(self._session) as clock:
            try:
                return clock.wait(0.5)
            except NoClock as error:
                return error

    def _on_sample(self, robot: str, stream: StreamName, sample: StampedMessage) -> None:
        if robot not in self.statuses:
            return  # of a robot that joined later
        writers = self._samples.setdefault((robot, stream), {})
        writer = writers.get(sample.session)
        if writer is None:
            statistics = self.topic.get(WriterKey(robot, stream, sample.session))
            assert statistics is not None
            writer = writers[sample.session] = WriterSamples(statistics)
        writer.add(sample)
        self._on_change()

    def _on_descriptions(self, received: list[Received]) -> None:
        for robot, _, message in received:
            if isinstance(message, RobotDescription):
                self.descriptions[robot] = message
        self._on_change()

    def _on_status(self, robot: str, status: Status) -> None:
        if robot in self.statuses:
            self.statuses[robot][status.session] = status

    def _on_event(self, event: WriterEvent) -> None:
        if event.robot in self.events:
            self.events[event.robot].append(event)


def _sources(robot: str, stream: StreamName, sample: StampedMessage) -> Iterator[Hashable]:
    if stream in ("joint_states", "tf"):
        yield robot, stream
    yield WriterKey(robot, stream, sample.session)


def followed_stream(info: RobotInfo, wire: str) -> Follow:
    """The stream that the poses of a robot are computed from."""
    streams = {stream for stream, _ in info.writers}
    moves_by_joints = not JOINT_STREAMS.isdisjoint(streams) or "tf" not in streams
    return "joint_states" if wire == "native" and moves_by_joints else "tf"


class FleetFrames:
    """The frames of several robots, by name, and those of each robot."""

    def __init__(self, frames: Sequence[FrameInfo]) -> None:
        self.by_name = {frame.name: frame for frame in frames}
        self._names: dict[str, list[str]] = {}
        for name in self.by_name:
            self._names.setdefault(name.partition("/")[0], []).append(name)

    def of(self, robot: str) -> list[FrameInfo]:
        """The frames of ``robot``, and those above them up to their roots."""
        found: dict[str, FrameInfo] = {}
        for name in self._names.get(robot, ()):
            above: str | None = name
            while above is not None and above not in found:
                found[above] = self.by_name[above]
                above = self.by_name[above].parent
        return list(found.values())


class RobotProbe:
    """What ``collector`` has of the robot ``info``.

    ``neighbours`` are all announced robots. ``nodes`` are the samples of each stream by ROS node, on a ROS
    wire; ``transforms`` and ``parts``, the partial joint states, are those of the native wire. ``measured``
    are those of its sensors and its odometry. ``waits`` are the streams without a writer that programs of
    this robot read, with these programs. ``sites`` are those that announce how they thin streams.
    ``argument`` is the robot in the commands of findings; empty if the wire is that of one robot.
    """

    def __init__(
        self,
        collector: StreamCollector,
        info: RobotInfo,
        neighbours: Sequence[RobotInfo],
        readers: Sequence[Announcement] = (),
        *,
        sites: Sites = NO_SITES,
        is_only: bool = False,
    ) -> None:
        self.info, self.neighbours, self.sites = info, neighbours, sites
        self.argument = "" if is_only else f" {info.name}"
        self.streams = frozenset(stream for stream, _ in info.writers)
        self.followed: Follow = followed_stream(info, "native" if collector.is_native else "")
        self.offsets: tuple[MeasuredOffset, ...] = ()
        self.unresponsive: set[WriterId] = set()
        self.waits = unwritten_streams(info, readers)
        self.collector = collector
        self.statuses = collector.statuses[info.name]
        self.events = collector.events[info.name]
        self._listener = collector.listener(self.followed)

    @property
    def description(self) -> RobotDescription | None:
        """The model; None if it has not arrived."""
        return self.collector.descriptions.get(self.info.name)

    @property
    def samples(self) -> StreamSamples:
        """Those of the followed stream."""
        return self._of(self.followed)

    @property
    def transforms(self) -> StreamSamples:
        """Those of moving edges."""
        return self._of("transforms")

    @property
    def parts(self) -> StreamSamples:
        """Those of drivers of some joints."""
        return self._of("partial_joint_states")

    @property
    def measured(self) -> dict[StreamName, StreamSamples]:
        """Those of sensors, and of odometry."""
        return {stream: self._of(stream) for stream in _measured()}

    def newest(self, stream: StreamName) -> dict[str, Any]:
        """The newest message of each announced writer of ``stream``, by the writer's name."""
        writers = self._of(stream).writers
        names = self.info.named(stream)
        return {name: writers[one.session].newest for name, one in names if one.session in writers}

    @property
    def nodes(self) -> dict[StreamName, StreamSamples]:
        """Those of each ROS node; empty on the native wire."""
        streams: tuple[StreamName, ...] = () if self.collector.is_native else ("joint_states", "tf")
        return {stream: self._of(stream) for stream in streams}

    def _of(self, stream: StreamName) -> StreamSamples:
        return self.collector.samples(self.info.name, stream)

    @property
    def buffer(self) -> TransformBuffer:
        """The buffer with its frames, and with those of the others that are examined."""
        return self._listener.buffer

    @property
    def is_alone(self) -> bool:
        """Whether no other robot is examined."""
        return self.collector.robot != ANY or not self.collector.is_native

    @property
    def frames(self) -> list[FrameInfo]:
        """Its frames and those above them; all that its writers place, if it is examined alone."""
        everything = self.collector.frames[self.followed]
        return list(everything.by_name.values()) if self.is_alone else everything.of(self.info.name)

    @property
    def all_frames(self) -> list[FrameInfo]:
        """Those of all examined robots."""
        return list(self.collector.frames[self.followed].by_name.values())

    @property
    def stats(self) -> ListenerStats:
        """What a listener of this robot counts."""
        return self._listener.stats if self.is_alone else self._listener.stats_of(self.info.name)

    @property
    def refusals(self) -> dict[str, str]:
        """The text of the first refusal of each reason."""
        return self._listener.refusals if self.is_alone else self._listener.refusals_of(self.info.name)

    def writers(self, stream: StreamName) -> list[WriterId]:
        """The announced writers of ``stream``, the newest last."""
        found = [writer for written, writer in self.info.writers if written == stream]
        return sorted(found, key=lambda writer: writer.since)

    def writers_text(self) -> str:
        """Every announced writer with its streams."""
        streams: dict[str, dict[str, None]] = {}
        for stream, writer in self.info.writers:
            streams.setdefault(str(writer), {})[stream] = None
        return "; ".join(f"{writer} ({', '.join(written)})" for writer, written in streams.items())

    def writer_name(self, session: int) -> str:
        """The writer with this session number."""
        names = {writer.session: str(writer) for _, writer in self.info.writers}
        return names.get(session, "an unannounced writer")

    def plugin_checks(self) -> Iterator[Check]:
        """The checks of plugins."""
        for plugin in self.collector.plugins:
            yield from plugin.checks(self)

    @property
    def is_incomplete(self) -> bool:
        """Whether announced data has not arrived yet."""
        if "robot_description" in self.streams and self.description is None:
            return True
        # The frames of measurements are checked, for which one of each sensor is needed.
        for stream in ("partial_joint_states", *filter(has_frame, self.streams)):
            if not {one.session for _, one in self.info.named(stream)} <= self._of(stream).writers.keys():
                return True
        if not all(plugin.is_complete(self.info) for plugin in self.collector.plugins):
            return True
        if self.followed not in self.streams:
            return False
        return self.samples.statistics.count < 2 or self._is_unplaced

    @property
    def _is_unplaced(self) -> bool:
        """Whether the listener has nothing yet of the samples that have arrived."""
        stats = self.stats
        is_usable = self.description is not None or self.followed == "tf"
        return is_usable and not (stats.received or stats.recalled or stats.late or stats.refused)

    @property
    def is_silent(self) -> bool:
        """Whether nothing has arrived except announcements."""
        frames = any(frame.kind == "static" for frame in self.frames)
        has_replied = self.description or self.statuses or self.offsets
        has_data = any(plugin.has_data(self.info.name) for plugin in self.collector.plugins)
        return not (has_replied or has_data or self.sample_count or frames)

    @property
    def sample_count(self) -> int:
        """How many joint states, transforms, odometry and messages of sensors have arrived."""
        all_samples = [self.samples, self.transforms, self.parts, *self.measured.values()]
        return sum(one.statistics.count for samples in all_samples for one in samples.writers.values())

    def statistics(self) -> list[IntervalStatistics]:
        """Those of the followed stream, and of each writer of partial joint states or of moving edges."""
        moving = (self.parts, *map(self._of, edge_streams()))
        writers = [writer for samples in moving for writer in samples.writers.values()]
        return [self.samples.statistics, *(writer.statistics for writer in writers)]

    @property
    def is_place(self) -> bool:
        """Whether it has maps, or other latched values of a plugin, and nothing that moves."""
        latched = frozenset(stream for stream in self.streams if is_latched(stream))
        is_described = "robot_description" in latched
        return latched == self.streams and not is_described and bool(latched - {"tf_static"})

    @property
    def has_only_transforms(self) -> bool:
        """Whether its writers publish moving edges, and no program publishes or reads joints or a model."""
        others = {*JOINT_STREAMS, "tf", "robot_description"}
        has_edges = not self.streams.isdisjoint(edge_streams())
        return has_edges and others.isdisjoint({*self.streams, *self.waits})

    def silent_writers(self) -> set[WriterId]:
        """The announced writers of which nothing has arrived, not even a reply with their clock."""
        streams: tuple[StreamName, ...] = ("tf", *_native_streams())
        known = {session for stream in streams for session in self._of(stream).writers}
        known.update(self.statuses, (offset.writer.session for offset in self.offsets))
        return {writer for _, writer in self.info.writers if writer.session not in known}


def unwritten_streams(info: RobotInfo, readers: Sequence[Announcement]) -> dict[StreamName, WriterId]:
    """The streams that programs of the robot ``info`` wait for, with such a program: none writes them.

    A program of the robot is one that also writes a stream of it. One that reads edges or latched streams,
    too, reads what there is, for instance a listener of poses.
    """
    written = {stream for stream, _ in info.writers}
    programs = {(writer.host, writer.pid) for _, writer in info.writers}
    streams: dict[WriterId, set[StreamName]] = {}
    for one in readers:
        if one.robot == info.name and (one.writer.host, one.writer.pid) in programs:
            streams.setdefault(one.writer, set()).add(one.stream)
    waits: dict[StreamName, WriterId] = {}
    for reader, read in streams.items():
        if read <= {*JOINT_STREAMS, *measured_streams()}:
            missing = read - written
            if not JOINT_STREAMS.isdisjoint(read):  # either of the two may have all joints
                missing -= {"partial_joint_states"} if written.isdisjoint(JOINT_STREAMS) else JOINT_STREAMS
            waits.update(dict.fromkeys(sorted(missing), reader))
    return waits


def find_unresponsive(session: Session, probes: Sequence[RobotProbe], within_s: float) -> None:
    """Query the clocks of the silent writers, and collect those that do not reply within ``within_s`` [s].

    A stopped process receives the query and lets it time out, or its lease ended after it was found, and
    it is not announced any more. Where a router denies the query, it ends at once without a reply, which
    is not counted; nor is a writer whose samples arrive before the replies.
    """
    silent = {(one.info.name, writer) for one in probes for writer in one.silent_writers()}
    if not silent:
        return
    queried = unanswered(session, silent, within_s)
    alive = silent
    with suppress(Unreachable):
        robots = discover(session, _REPLY_WITHIN_S)
        alive = {(robot.name, writer) for robot in robots for _, writer in robot.writers}
    for one in probes:
        for writer in one.silent_writers():
            key = one.info.name, writer
            if key in queried and (queried[key] or key not in alive):
                one.unresponsive.add(writer)


@contextmanager
def collected_probes(
    session: Session, selected: Sequence[RobotInfo], robots: Sequence[RobotInfo], wire: str, timeout_s: float
) -> Generator[Sequence[RobotProbe]]:
    """The probes of the ``selected`` of all announced ``robots``, after all that is announced has arrived.

    Waits at least 1.2 s and at most ``timeout_s`` [s] for it, and as long again for the replies of writers of
    which nothing has arrived.
    """
    waiter, is_native, messages = ConditionWaiter(), wire == "native", messages_for(wire)
    deadline_s = time.monotonic() + timeout_s
    with ExitStack() as opened:
        probes: list[RobotProbe] = []
        readers = discover_readers(session, _READERS_WITHIN_S) if is_native else ()
        sites = discover_sites(session) if is_native else NO_SITES
        for group in [selected] if is_native else [[info] for info in selected]:
            collector = opened.enter_context(StreamCollector(session, group, wire, waiter.notify))
            is_only = isinstance(messages, RosMessages) and messages.robot is not None
            probes += [
                RobotProbe(collector, info, robots, readers, sites=sites, is_only=is_only) for info in group
            ]
        window_end_s = time.monotonic() + min(_MIN_WINDOW_S, timeout_s)
        if is_native:
            offsets: dict[str, list[MeasuredOffset]] = {}
            for one in measure_offsets(session, ANY if len(selected) > 1 else selected[0].name):
                offsets.setdefault(one.robot, []).append(one)
            for probe in probes:
                probe.offsets = tuple(offsets.get(probe.info.name, ()))
        time.sleep(max(0.0, window_end_s - time.monotonic()))
        _wait_for_data(probes, waiter, deadline_s)
        if is_native:
            find_unresponsive(session, probes, timeout_s)
        yield probes


def _wait_for_data(probes: Sequence[RobotProbe], waiter: ConditionWaiter, until_s: float) -> None:
    """Wait until all announced data has arrived, at most until ``until_s`` (``time.monotonic``) [s]."""
    incomplete = list(probes)

    def is_complete() -> bool:
        incomplete[:] = [probe for probe in incomplete if probe.is_incomplete]
        return not incomplete

    waiter.wait_for(is_complete, max(0.0, until_s - time.monotonic()))
