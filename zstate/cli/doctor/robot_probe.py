"""Collects everything one robot publishes during a short window."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate.cli.waiting import ConditionWaiter
from zstate.driving.driver_state import DriverStateListener, ReceivedState
from zstate.errors import Unreachable
from zstate.ingest.events import WriterEvent
from zstate.model.robot import RobotModel, coordinate_names
from zstate.net.clock_offset import MeasuredOffset
from zstate.net.presence import RobotInfo, discover
from zstate.net.queryable import query
from zstate.net.session import Session
from zstate.net.status import StatusSubscriber
from zstate.net.subscription import Received, subscribe
from zstate.net.topic_statistics import IntervalStatistics, TopicStatistics
from zstate.nodes.listener import Follow, TransformListener
from zstate.wire.identity import WriterId
from zstate.wire.keys import EDGE_STREAMS, JOINT_STREAMS, Stream, clock_key
from zstate.wire.messages import (
    Imu,
    JointState,
    LaserScan,
    OccupancyGrid,
    RobotDescription,
    StampedMessage,
    Status,
    TransformSample,
    Velocity,
    from_block,
    order_digest,
)
from zstate.wire.protocol import Wire
from zstate.wire.registry import get_wire

_MIN_WINDOW_S = 1.2  # writers publish their status once a second
_REPLY_WITHIN_S = 0.4
_ROS_STREAMS: tuple[Stream, ...] = ("joint_states", "tf")
_MEASURED: tuple[Stream, ...] = ("imu", "velocity", "pose", "odometry")
_ALL = ""


class WriterSamples:
    """Samples of one writer: ``statistics``, ``names`` of joints or frames, and ranges of positions.

    The frames are those that its edges place, or those of its measurements.
    """

    def __init__(self, statistics: IntervalStatistics) -> None:
        self.statistics = statistics
        self.names: dict[str, None] = {}
        self._joints: tuple[str, ...] | None = None
        self._order = b""
        self._extremes = np.empty((2, 0))

    def add(self, sample: StampedMessage) -> None:
        """Include ``sample``; positions in another joint order replace all before."""
        if isinstance(sample, LaserScan | Imu | Velocity):
            self.names[sample.frame] = None
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


class StreamSamples(Closeable):
    """Subscribes to ``stream`` of ``robot``; counts its samples together and by writer."""

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: Stream,
        wire: Wire,
        on_change: Callable[[], object] = lambda: None,
    ) -> None:
        self._writers: dict[int, WriterSamples] = {}

        def on_sample(_: Stream, sample: StampedMessage) -> None:
            writer = self._writers.get(sample.session)
            if writer is None:
                statistics = self.topic.get(sample.session)
                assert statistics is not None
                writer = self._writers[sample.session] = WriterSamples(statistics)
            writer.add(sample)
            on_change()

        self.topic = TopicStatistics(
            session, wire, sources=lambda _, __, sample: iter((_ALL, sample.session)), on_sample=on_sample
        )
        self.topic.subscribe(stream, robot)

    def close(self) -> None:
        self.topic.close()

    @property
    def statistics(self) -> IntervalStatistics:
        """Of all writers together."""
        return self.topic.get(_ALL) or IntervalStatistics()

    @property
    def writers(self) -> dict[int, WriterSamples]:
        """By session, each writer whose samples have arrived."""
        return self._writers.copy()


class RobotProbe(Closeable):
    """Subscribes to the streams of ``info`` and to the status of its writers.

    ``neighbours`` are all announced robots. ``on_change()`` is called after each description and sample.
    ``nodes`` are the samples of each stream by ROS node, on a ROS wire; ``transforms`` and ``parts``, the
    partial joint states, are the samples of these streams by writer, on the native wire. ``scans`` are those
    of its laser scanners, ``measured`` those of its other sensors and its odometry; ``maps`` are its maps by
    name; ``driver`` is the state of its driver.
    """

    def __init__(
        self,
        session: Session,
        info: RobotInfo,
        wire: str,
        neighbours: Sequence[RobotInfo],
        on_change: Callable[[], object],
    ) -> None:
        self.info, self.neighbours = info, neighbours
        self.streams = frozenset(stream for stream, _ in info.writers)
        is_native = wire == "native"
        moves_by_joints = not JOINT_STREAMS.isdisjoint(self.streams) or "tf" not in self.streams
        self.followed: Follow = "joint_states" if is_native and moves_by_joints else "tf"
        self.description: RobotDescription | None = None
        self.statuses: dict[int, Status] = {}
        self.maps: dict[str, OccupancyGrid] = {}
        self.events: list[WriterEvent] = []
        self.offsets: tuple[MeasuredOffset, ...] = ()
        self.unresponsive: set[WriterId] = set()
        self.nodes: dict[Stream, StreamSamples] = {}
        self._session, self._on_change = session, on_change
        self._wire = wire_format = get_wire(wire)
        with ExitStack() as opening:
            description = subscribe(
                session, wire_format, info.name, "robot_description", self._on_description
            )
            opening.enter_context(description)
            samples = StreamSamples(session, info.name, self.followed, wire_format, on_change)
            self.samples = opening.enter_context(samples)
            self.transforms: StreamSamples | None = None
            self.parts: StreamSamples | None = None
            self._drivers: DriverStateListener | None = None
            scans = StreamSamples(session, info.name, "scan", wire_format, on_change)
            self.scans = opening.enter_context(scans)
            self.measured: dict[Stream, StreamSamples] = {
                stream: opening.enter_context(
                    StreamSamples(session, info.name, stream, wire_format, on_change)
                )
                for stream in _MEASURED
            }
            if info.map_names:
                maps = subscribe(session, wire_format, info.name, "map", self._on_maps)
                opening.enter_context(maps)
            if is_native:
                parts = StreamSamples(session, info.name, "partial_joint_states", wire_format, on_change)
                self.parts = opening.enter_context(parts)
                transforms = StreamSamples(session, info.name, "transforms", wire_format)
                self.transforms = opening.enter_context(transforms)
                opening.enter_context(StatusSubscriber(session, info.name, self._on_status))
                self._drivers = opening.enter_context(DriverStateListener(session, info.name))
            for stream in () if is_native else _ROS_STREAMS:
                nodes = StreamSamples(session, info.name, stream, wire_format)
                self.nodes[stream] = opening.enter_context(nodes)
            listener = TransformListener(
                session, info.name, wire=wire, follow=self.followed, on_event=self.events.append
            )
            self.listener = opening.enter_context(listener)
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def _on_description(self, received: list[Received]) -> None:
        for _, _, message in received:
            if isinstance(message, RobotDescription):
                self.description = message
                self._on_change()

    def _on_maps(self, received: list[Received]) -> None:
        for _, key, message in received:
            if isinstance(message, OccupancyGrid):
                self.maps[self._wire.edge_writer_name(key) or ""] = message
                self._on_change()

    def _on_status(self, _: str, status: Status) -> None:
        self.statuses[status.session] = status

    def writers(self, stream: Stream) -> list[WriterId]:
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

    @property
    def driver(self) -> ReceivedState | None:
        """The newest state of the robot's driver; None if none has arrived."""
        return None if self._drivers is None else self._drivers.get(self.info.name)

    @property
    def is_incomplete(self) -> bool:
        """Whether announced data has not arrived yet."""
        lacks_model = "robot_description" in self.streams and self.description is None
        for samples, names in ((self.parts, self.info.part_names), (self.scans, self.info.scan_names)):
            if samples is not None and not {one.session for _, one in names} <= samples.writers.keys():
                return True
        if not {name for name, _ in self.info.map_names} <= self.maps.keys():
            return True
        return lacks_model or (self.followed in self.streams and self.samples.statistics.count < 2)

    @property
    def is_silent(self) -> bool:
        """Whether nothing has arrived except announcements."""
        frames = any(frame.kind == "static" for frame in self.listener.buffer.frames())
        has_replied = self.description or self.statuses or self.offsets or self.maps
        return not (has_replied or self.sample_count or frames)

    @property
    def sample_count(self) -> int:
        """How many joint states, transforms, odometry and messages of sensors have arrived."""
        all_samples = [self.samples, self.transforms, self.parts, self.scans, *self.measured.values()]
        return sum(samples.statistics.count for samples in all_samples if samples is not None)

    def statistics(self) -> list[IntervalStatistics]:
        """Those of the followed stream, and of each writer of partial joint states or of moving edges."""
        moving = self.parts, self.transforms, self.measured["odometry"]
        named = [samples for samples in moving if samples is not None]
        writers = [writer for samples in named for writer in samples.writers.values()]
        return [self.samples.statistics, *(writer.statistics for writer in writers)]

    @property
    def is_place(self) -> bool:
        """Whether it has a map, and nothing that moves."""
        return "map" in self.streams and self.streams <= {"map", "tf_static"}

    @property
    def has_only_transforms(self) -> bool:
        """Whether its writers publish moving edges, and no joints or model."""
        others = {*JOINT_STREAMS, "tf", "robot_description"}
        return not self.streams.isdisjoint(EDGE_STREAMS) and self.streams.isdisjoint(others)

    def find_unresponsive(self) -> None:
        """Query the writers that have not reported their clocks, and collect those that do not reply.

        A stopped process receives the query and lets it time out, or its lease ended after it was found, and
        it is not announced any more. Where a router denies the query, it ends at once without a reply, which
        is not counted.
        """
        known = {offset.writer.session for offset in self.offsets}
        for writer in {writer for _, writer in self.info.writers if writer.session not in known}:
            began, key = time.monotonic(), clock_key(self.info.name, writer.identity)
            replies = list(query(self._session.zenoh, key, _REPLY_WITHIN_S))
            has_timed_out = time.monotonic() - began > 0.9 * _REPLY_WITHIN_S
            has_replied = any(reply.ok is not None for reply in replies)
            if not has_replied and (has_timed_out or not self._is_announced(writer)):
                self.unresponsive.add(writer)

    def _is_announced(self, writer: WriterId) -> bool:
        try:
            robots = discover(self._session, _REPLY_WITHIN_S)
        except Unreachable:
            return True
        return any(writer == one for robot in robots for _, one in robot.writers)


def wait_for_probes(probes: Sequence[RobotProbe], waiter: ConditionWaiter, timeout_s: float) -> None:
    """Wait until all announced data has arrived, at least 1.2 s, at most ``timeout_s``.

    ``waiter`` is notified by the probes.
    """
    time.sleep(min(_MIN_WINDOW_S, timeout_s))
    waiter.wait_for(lambda: not any(probe.is_incomplete for probe in probes), timeout_s - _MIN_WINDOW_S)
