"""Records robot streams from the network into MCAP files, in the messages of ROS 2 where it has some."""

from __future__ import annotations

import atexit
import math
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate._util.html import html_of_fields
from zstate.clock import SystemClock, wait_interruptible
from zstate.errors import Closed, InvalidInput, MessageError
from zstate.ingest.counters import Counters
from zstate.net.at_exit import forked_text
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import WriterWatch, announce_reader
from zstate.net.session import Session
from zstate.net.streams import Receiver, StreamSubscriber, capacity_for
from zstate.rate import Rate
from zstate.recording.encode import RecordingEncoder
from zstate.recording.errors import RecordingError
from zstate.recording.gap_counter import GapCounter
from zstate.recording.mcap.writer import RecordingWriter
from zstate.stream_registry import (
    edge_streams,
    is_bulk,
    is_latched,
    is_named,
    latched_streams,
    measured_streams,
)
from zstate.streams import StreamName
from zstate.wire.identity import Announcement
from zstate.wire.keys import ANY, check_robot
from zstate.wire.messages import Message, StampedMessage, WriterTransforms, edge_of
from zstate.wire.protocol import SerializedSample, Wire
from zstate.wire.registry import get_wire
from zstate.wire.ros2.streams import recorded_forms
from zstate.wire.ros2.topics import SHARED

FLUSH_NS = 500_000_000
"""Interval at which everything received goes to the file, where ``kill -9`` cannot reach it."""

QUEUE_BYTES = 64 * 2**20
QUEUE_LENGTH = 8192
"""Samples that wait in the queue; more wait in the rings of the subscriptions, which drop the oldest."""
BULK_QUEUE_BYTES = QUEUE_BYTES // 2
"""Bulk data waits for room in this part of the queue, so that other samples have the rest."""

LARGE_BYTES = 1 << 16
"""Latched values from this size on are decoded and encoded in a thread of their own."""
_LARGE_WAITING_BYTES = 1 << 26

_WRITES_HZ = 20.0
# Robots that start together should be discovered together: it decides their namespaces in the file.
_DISCOVERY_NS = 300_000_000
# What was received is written in milliseconds, except on a busy machine or a slow disk. After the first time
# the rest is dropped; after the second the program goes on, as a disk may never answer.
_DRAIN_S = 5.0
_CLOSED_WITHIN_S = 8.0


class Batch(NamedTuple):
    """Samples of one stream, oldest first. ``robot`` is None if only their keys name it.

    ``stamp`` [ns] is when they were received, by the system clock; ``overflowed`` is True if a ring of this
    process dropped samples before or among them.
    """

    stream: StreamName
    robot: str | None
    arrivals: list[SerializedSample]
    stamp: int
    overflowed: bool


class MessageQueue(Closeable):
    """Samples of several subscriptions, with their time of reception, in one queue for one thread.

    ``on_batch()`` is called after each batch that was queued.
    """

    def __init__(self, session: Session, on_batch: Callable[[], object] = lambda: None) -> None:
        self._session = session
        self._on_batch = on_batch
        self._batches: list[Batch] = []
        self._waiting = self._bytes = 0
        self._has_room = fork_safe(threading.Condition())
        self._is_open = True
        self._subscribers: dict[StreamName, Receiver] = {}

    def subscribe(self, stream: StreamName, expressions: Sequence[str], robot: str | None) -> None:
        """Subscribe to a stream, in place of the last subscription to it.

        An empty payload of a latched stream is a withdrawn value.
        """
        self.unsubscribe(stream)
        has_bulk = is_bulk(stream)
        capacity = capacity_for(expressions, is_bulk=has_bulk)
        max_bytes = BULK_QUEUE_BYTES if has_bulk else QUEUE_BYTES

        def put(arrivals: list[SerializedSample]) -> None:
            batch = Batch(stream, robot, arrivals, time.time_ns(), len(arrivals) >= capacity)
            with self._has_room:
                # A slow reader must not fill the memory: the subscription's ring drops samples, and counts
                # them.
                while self._is_open and (self._waiting >= QUEUE_LENGTH or self._bytes >= max_bytes):
                    self._has_room.wait()
                if self._is_open:
                    self._batches.append(batch)
                    self._waiting += len(arrivals)
                    self._bytes += sum(len(arrival.payload) for arrival in arrivals)
            self._on_batch()

        if is_latched(stream):
            subscriber = LatchedSubscriber(self._session, expressions, lambda arrival: put([arrival]))
        else:
            subscriber = StreamSubscriber(self._session, expressions, put, is_bulk=has_bulk)
        self._subscribers[stream] = subscriber

    def unsubscribe(self, stream: StreamName) -> None:
        """End the subscription to a stream; what is in the queue can still be read."""
        subscriber = self._subscribers.pop(stream, None)
        if subscriber is not None:
            subscriber.close()

    def pop_all(self) -> list[Batch]:
        """Remove and return all batches, in the order of reception."""
        with self._has_room:
            batches, self._batches = self._batches, []
            self._waiting = self._bytes = 0
            self._has_room.notify_all()
        return batches

    def finish(self, timeout_s: float) -> None:
        """Unsubscribe once all that has arrived is in the queue, or after ``timeout_s`` [s]."""
        deadline = time.monotonic() + timeout_s
        for subscriber in list(self._subscribers.values()):
            subscriber.finish(max(0.0, deadline - time.monotonic()))

    def close(self) -> None:
        """Unsubscribe, within a second; what is in the queue can still be read."""
        with self._has_room:
            self._is_open = False
            self._has_room.notify_all()
        for stream in list(self._subscribers):
            self.unsubscribe(stream)


class SampleRecorder:
    """Decodes received samples of ``wire``, and writes their messages with a RecordingEncoder."""

    def __init__(self, wire: Wire, counters: Counters) -> None:
        self._wire = wire
        self._counters = counters
        self._gaps = GapCounter(counters)
        self._missing: Counter[tuple[str, StreamName]] = Counter()

    @property
    def missing(self) -> dict[tuple[str, StreamName], int]:
        """How many samples are missing between those written, by robot and stream."""
        return dict(self._missing)

    def start_batch(self, batch: Batch) -> None:
        """Begin with the samples of ``batch``."""
        self._gaps.start_batch(overflowed=batch.overflowed)

    def robot_of(self, batch: Batch, arrival: SerializedSample) -> str | None:
        """The robot of a sample; None, and counted, if its key has no valid names."""
        try:
            if is_named(batch.stream):
                self._wire.edge_writer_name(arrival.key)  # raises for a key without one
            return self._wire.robot_from_key(arrival.key) if batch.robot is None else batch.robot
        except InvalidInput as error:
            self._counters.count_refusal("foreign", str(error))
            return None

    def write(
        self, encoder: RecordingEncoder, robot: str, batch: Batch, arrival: SerializedSample
    ) -> Sequence[Message]:
        """Write the messages of a sample of ``batch``, and return them."""
        stream, stamp = batch.stream, batch.stamp
        edge_writer = self._wire.edge_writer_name(arrival.key) if is_named(stream) else None
        if not arrival.payload and is_latched(stream):
            if edge_writer is not None:
                encoder.withdraw(robot, stream, edge_writer, stamp)
            return ()
        messages: Sequence[Message] = ()
        try:
            messages = self._wire.decode(stream, arrival, robot)
        except MessageError as error:
            self._counters.count_refusal(error.reason, f"{arrival.key}: {error}")
        for message in messages:
            is_known = encoder.write_message(robot, message, stamp, edge_writer, stream=stream)
            is_edge = stream in self._wire.edges and stream != self._wire.transforms
            if is_edge and isinstance(message, WriterTransforms):
                # On /tf, where ROS tools and readers of recordings find edges; ROS nodes publish it there.
                encoder.write_message(robot, edge_of(message), stamp, edge_writer)
            # The numbers of stops rise by any steps.
            is_of_stops = is_named(stream) and stream in recorded_forms()
            if is_known and isinstance(message, StampedMessage) and not is_of_stops:
                missing = self._gaps.add((robot, stream, message.session), message.seq)
                if missing:
                    self._missing[robot, stream] += missing
        return messages


def recorded_streams(wire: Wire) -> tuple[StreamName, ...]:
    """The streams of robots that a recording of ``wire`` holds; the clock belongs to no robot."""
    # On a ROS wire all moving edges are on tf, and all joints on joint_states.
    named = wire.partial_joint_states, wire.transforms
    latched = latched_streams()
    driving = tuple(recorded_forms()) if wire.name == "native" else ()
    samples = ("joint_states", "tf", *named, *measured_streams(), *edge_streams(), *driving)
    return tuple(dict.fromkeys(stream for stream in (*latched, *samples) if wire.carries(stream)))


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """Counts since the recorder opened.

    ``messages`` were written, by robot and stream (the clock belongs to the robot "ros"); ``bytes`` is the
    size of all ``files``. Messages were ``dropped`` by a full ring of this process, by a full queue or at the
    end of the recording, ``missed`` between the writers' sequence numbers, ``unwritten`` without a matching
    description; ``refused`` counts others that could not be written, by reason. A disk that is full has
    ``lost`` that many of the ``messages``. ``missing`` has the dropped and missed ones between others of the
    same writer, by robot and stream.
    """

    messages: Mapping[tuple[str, StreamName], int]
    bytes: int
    files: tuple[Path, ...]
    dropped: int
    missed: int
    refused: Mapping[str, int]
    unwritten: int
    lost: int = 0
    missing: Mapping[tuple[str, StreamName], int] = field(default_factory=dict[tuple[str, StreamName], int])

    def _repr_html_(self) -> str:
        return html_of_fields(self)


class Recorder(Closeable):
    """Records ``robots``, or all robots, on ``wire`` into ``path``; a context manager.

    Subscribes to all of their streams, /tf too, which makes their publishers compute it, to their sensors,
    odometry and maps, and, on the wire "native", to the commands, states and stops of their drivers. A map is
    written when it changes, and at the start of each file. A single selected robot, or the only robot when
    the recording starts, is in the file's root with unchanged frame names; others have a namespace and a
    frame prefix. ``max_bytes``, ``max_seconds`` and ``overwrite`` are those of RecordingWriter. Raises
    RecordingError if the file cannot be created, InvalidInput for invalid names.

    When the disk is full or gone, the recording ends: ``wait`` returns, ``failure`` is the reason, and what
    was written stays readable.
    """

    def __init__(
        self,
        session: Session,
        path: str | os.PathLike[str],
        robots: Sequence[str] = (),
        *,
        wire: str = "native",
        max_bytes: int | None = None,
        max_seconds: float | None = None,
        overwrite: bool = False,
    ) -> None:
        self.failure: Exception | None = None
        selected = (robots,) if isinstance(robots, str) else tuple(dict.fromkeys(robots))
        self._selected = tuple(map(check_robot, selected))
        self._wire = get_wire(wire)
        self._streams = recorded_streams(self._wire)
        self._counters = Counters()
        self._samples = SampleRecorder(self._wire, self._counters)
        self._programs: BoundedDict[int, str] = BoundedDict()
        self._discovered: set[str] = set()
        self._pending: list[Batch] = []
        self._handled = 0
        """How many samples of ``_pending`` are written, queued or counted."""
        self._ends_at = math.inf
        self._starts_at: int | None = None
        self._encoder: RecordingEncoder | None = None
        self._closing = fork_safe_lock()
        self._stop = fork_safe(threading.Event())
        self._ended = fork_safe(threading.Event())
        self._large = _LargeValues(self._write_arrival, self._counters)
        with ExitStack() as opening:
            self._queue = opening.enter_context(MessageQueue(session))
            opening.enter_context(WriterWatch(session, self._selected or ANY, self._on_writer, wire))
            self._subscribe()
            for robot in self._selected or (ANY,):
                for announcement in announce_reader(session, self._wire, robot, self._streams):
                    opening.enter_context(announcement)
            self._writer = RecordingWriter(
                path, max_bytes=max_bytes, max_seconds=max_seconds, overwrite=overwrite
            )
            self._opened = opening.pop_all()
        self._pid = os.getpid()
        # Before sessions are closed at the exit of a program that forgets to close: it finishes the file.
        atexit.register(self.close)
        self._thread = threading.Thread(target=self._run, name="zstate recorder", daemon=True)
        self._thread.start()

    def _subscribe(self) -> None:
        """Subscribe to every stream; keys distinguish several robots."""
        robot = self._selected[0] if len(self._selected) == 1 else None
        for stream in self._streams:
            expressions = dict.fromkeys(
                self._wire.expression(name, stream) for name in self._selected or (ANY,)
            )
            self._queue.subscribe(stream, tuple(expressions), robot)
        clock = self._wire.expression(self._selected[0] if self._selected else ANY, "clock")
        self._queue.subscribe("clock", (clock,), SHARED)

    @property
    def stats(self) -> RecorderStats:
        """Counts so far."""
        received, encoder, writer = self._counters.stats(), self._encoder, self._writer
        return RecorderStats(
            messages={} if encoder is None else encoder.messages,
            bytes=writer.size,
            files=writer.files,
            dropped=received.dropped,
            missed=received.missed,
            refused=received.refused,
            unwritten=0 if encoder is None else encoder.unwritten,
            lost=writer.lost,
            missing=self._samples.missing,
        )

    def wait(self, timeout_s: float | None = None) -> bool:
        """Block until the recording has ended, or for ``timeout_s``; whether it has ended.

        Raises Closed in a forked process, where the recorder does not run.
        """
        if os.getpid() != self._pid:
            raise Closed(forked_text(f"this recorder belongs to process {self._pid}"))
        return wait_interruptible(self._ended, timeout_s)

    def close(self) -> None:
        """End the recording: write what was received, and finish the file.

        What is not written within 5 s is dropped and counted; a disk that does not answer is left after 8 s.
        """
        atexit.unregister(self.close)
        began = time.monotonic()
        self._ends_at = min(self._ends_at, began + _DRAIN_S)
        if os.getpid() == self._pid and not self._ended.is_set():
            self._queue.finish(_DRAIN_S)
        self._unsubscribe()
        self._stop.set()
        self._thread.join(max(0.0, began + _CLOSED_WITHIN_S - time.monotonic()))

    def _unsubscribe(self) -> None:
        with self._closing:
            self._opened.close()

    def _on_writer(self, announced: Announcement, alive: bool) -> None:
        if alive:
            self._programs[announced.writer.session] = str(announced.writer)
            if not self._selected:
                self._discovered.add(announced.robot)

    def _run(self) -> None:
        try:
            self._write_until_stopped()
        except Exception as error:  # any error is reported as ``failure``
            self.failure = error
            self._unsubscribe()
            self._pending += self._queue.pop_all()
            received = sum(len(batch.arrivals) for batch in self._pending)
            self._counters.count("dropped", received - self._handled)
        finally:
            self._large.close()
            self._ended.set()

    def _write_until_stopped(self) -> None:
        flushed = 0
        for now in Rate(_WRITES_HZ, SystemClock(), self._stop):
            self._write_pending()
            if now // FLUSH_NS != flushed:
                flushed = now // FLUSH_NS
                self._writer.flush()
            if self._large.failure is not None:
                raise self._large.failure
        self._write_pending()
        self._large.finish(self._ends_at)
        if missing := self._samples.missing:
            self._writer.state_missing({"/".join(source): count for source, count in missing.items()})
        self._writer.close()

    def _write_pending(self) -> None:
        self._pending += self._queue.pop_all()
        if self._encoder is None:
            self._encoder = self._new_encoder()
        if self._encoder is None:
            return
        for batch in self._pending:
            self._samples.start_batch(batch)
            for arrival in batch.arrivals:
                if time.monotonic() > self._ends_at:
                    self._counters.count("dropped")
                elif (robot := self._samples.robot_of(batch, arrival)) is None:
                    pass  # counted
                elif is_latched(batch.stream) and self._large.accepts(robot, len(arrival.payload)):
                    self._large.put(robot, batch, arrival)
                else:
                    self._write_arrival(robot, batch, arrival)
                self._handled += 1
        self._pending, self._handled = [], 0

    def _new_encoder(self) -> RecordingEncoder | None:
        """None until it is known which robots the recording starts with."""
        robots = set(self._selected)
        if not robots:
            for batch in self._pending:
                if batch.stream != "clock":
                    named = (self._samples.robot_of(batch, arrival) for arrival in batch.arrivals)
                    robots.update(robot for robot in named if robot is not None)
            robots |= self._discovered.copy()
            if robots and self._starts_at is None:
                self._starts_at = time.monotonic_ns() + _DISCOVERY_NS
            is_complete = self._starts_at is not None and time.monotonic_ns() >= self._starts_at
            if not is_complete and not self._stop.is_set():
                return None
        others = robots - {SHARED}
        alone = others.pop() if len(others) == 1 else None
        return RecordingEncoder(
            self._writer, self._counters.count_refusal, alone=alone, programs=self._programs
        )

    def _write_arrival(self, robot: str, batch: Batch, arrival: SerializedSample) -> None:
        assert self._encoder is not None
        self._samples.write(self._encoder, robot, batch, arrival)


class _LargeValues:
    """Writes large latched values in a thread of its own, so that they do not block samples.

    A latched value that follows a large one of the same robot waits behind it. Beyond the maximum of waiting
    bytes, the oldest values are dropped and counted.
    """

    def __init__(self, write: Callable[[str, Batch, SerializedSample], None], counters: Counters) -> None:
        self.failure: Exception | None = None
        self._write = write
        self._counters = counters
        self._waiting: deque[tuple[str, Batch, SerializedSample]] = deque()
        self._bytes = 0
        self._behind: Counter[str] = Counter()
        self._changed = fork_safe(threading.Condition())
        self._is_open = True
        self._thread: threading.Thread | None = None

    def accepts(self, robot: str, size: int) -> bool:
        """Whether a latched value of ``robot`` with this size is written here."""
        return size >= LARGE_BYTES or self._behind[robot] > 0

    def put(self, robot: str, batch: Batch, arrival: SerializedSample) -> None:
        """Queue a value."""
        with self._changed:
            self._waiting.append((robot, batch, arrival))
            self._behind[robot] += 1
            self._bytes += len(arrival.payload)
            while self._bytes > _LARGE_WAITING_BYTES and len(self._waiting) > 1:
                self._drop_oldest()
            self._changed.notify_all()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="zstate recorder latched", daemon=True)
            self._thread.start()

    def finish(self, until_s: float) -> None:
        """Wait until all is written, or the monotonic clock reads ``until_s``; the rest is dropped."""
        with self._changed:
            self._changed.wait_for(lambda: not +self._behind, max(0.0, until_s - time.monotonic()))
        self.close()
        if self.failure is not None:
            raise self.failure

    def close(self) -> None:
        """Drop what waits, and end the thread."""
        with self._changed:
            self._is_open = False
            while self._waiting:
                self._drop_oldest()
            self._changed.notify_all()

    def _drop_oldest(self) -> None:
        robot, _, arrival = self._waiting.popleft()
        self._bytes -= len(arrival.payload)
        self._behind[robot] -= 1
        self._counters.count("dropped")

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or not self._is_open)
                if not self._is_open:
                    return
                robot, batch, arrival = self._waiting.popleft()
                self._bytes -= len(arrival.payload)
            try:
                self._write(robot, batch, arrival)
            except RecordingError as error:
                if self._is_open:  # else the recording ended first
                    self.failure = error
                self._counters.count("dropped")
            except Exception as error:  # it ends the recording, as it would in its own thread
                self.failure = error
            with self._changed:
                self._behind[robot] -= 1
                self._changed.notify_all()
