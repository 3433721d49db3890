"""StateReader: subscribes to the state of robots, decodes it, and inserts it into a transform buffer."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from zstate._util.closeable import Closeable
from zstate.buffer.buffer import TransformBuffer
from zstate.clock import FAR_NS, LATE_NS, SystemClock
from zstate.errors import InvalidInput, MessageError
from zstate.extension import kernel
from zstate.ingest.base import StreamIngest
from zstate.ingest.counters import Counters
from zstate.ingest.diagnostics import Diagnostics
from zstate.ingest.robot_ingests import Follow, RobotIngests
from zstate.ingest.stream_ingests import StreamIngests
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import WriterWatch, announce_reader
from zstate.net.requests import Requests
from zstate.net.sample_history import MAX_IN_FLIGHT, HistoryRequest
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber, capacity_for
from zstate.stream_registry import is_named
from zstate.streams import StreamName
from zstate.wire.identity import Announcement
from zstate.wire.keys import ANY, MODEL_WRITER, shortened, stream_key
from zstate.wire.messages import Message, RobotDescription, Sample, StaticTransforms
from zstate.wire.protocol import SerializedSample, Wire

if TYPE_CHECKING:
    from zstate.net.other_tf import OtherTfSubscription

P = ParamSpec("P")
R = TypeVar("R")


class StateReader(Closeable):
    """Inserts the state of ``robots``, received on ``wire``, into ``buffer``, until it is closed.

    The part of a TransformListener that the poses in its buffer need. Latched values and history are handled
    in ``thread``, samples in others. ``diagnostics`` observe it; without them the same samples are inserted.
    Counts everything in ``counters``; no input ends it.
    """

    def __init__(
        self,
        session: Session,
        robots: Sequence[str],
        wire: Wire,
        follow: Follow,
        buffer: TransformBuffer,
        *,
        thread: ServiceThread,
        counters: Counters,
        history_on_join: bool = True,
        placers: Collection[str] | None = None,
        diagnostics: Diagnostics | None = None,
    ) -> None:
        self._session, self._robots, self._wire = session, robots, wire
        self._follow: Follow = follow
        self._counters = counters
        self._diagnostics = diagnostics or Diagnostics()
        self._on_usual_sample = self._diagnostics.on_usual_sample
        self._robot_from_key: Callable[[str], str] = wire.robot_from_key
        if len(robots) == 1 and robots[0] != ANY:
            self._robot_from_key = lambda _: robots[0]
        self._has_fast_path = kernel == "c" and type(buffer.clock) is SystemClock
        self.ingests = RobotIngests(
            buffer, counters, wire, follow, placers=placers, diagnostics=self._diagnostics
        )
        self._has_history = history_on_join
        self._requests = Requests(session, thread, MAX_IN_FLIGHT)
        self._announced: set[Announcement] = set()
        """The writers with a cache of samples."""
        self._observers: tuple[Callable[[], object], ...] = ()
        with ExitStack() as opening:
            latched: dict[StreamName, Callable[[SerializedSample], None]] = {
                "robot_description": self._on_description,
                "tf_static": self._on_statics,
            }
            for stream, handle in latched.items():
                opening.enter_context(
                    LatchedSubscriber(session, self._keys(stream), self._observed(handle), thread=thread)
                )
            self._other_tf = self._subscribe_to_samples(opening)
            # History is requested from each writer found: after subscribing, so that no sample falls between.
            on_writer, before_losses = self._observed(self._on_writer), self._diagnostics.before_losses
            opening.enter_context(WriterWatch(session, robots, on_writer, wire, before_losses))
            for name in robots:
                for announcement in announce_reader(session, wire, name, (*latched, *self.ingests.streams)):
                    opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def close(self) -> None:
        """Stop reading; the buffer keeps its samples. A second call does nothing."""
        self._opened.close()

    def add_observer(self, notify: Callable[[], object]) -> None:
        """Call ``notify()`` after each batch of messages that was processed, on its thread: keep it short."""
        self._observers = (*self._observers, notify)

    def _observed(self, handle: Callable[P, R]) -> Callable[P, R]:
        """``handle``, followed by the calls of the observers."""

        def handle_and_notify(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return handle(*args, **kwargs)
            finally:
                for notify in self._observers:
                    notify()

        return handle_and_notify

    def _keys(self, stream: StreamName) -> list[str]:
        """The key expressions of ``stream`` of the robots."""
        return [self._wire.expression(robot, stream) for robot in self._robots]

    def _subscribe_to_samples(self, opening: ExitStack) -> OtherTfSubscription | None:
        """Receive all streams of samples; in ROS /tf only while nodes add edges to those of models."""
        opening.enter_context(self._subscriber(self._follow))
        others = [stream for stream in self.ingests.streams if stream != self._follow]
        if others and self._wire.shared:
            from zstate.net.other_tf import OtherTfSubscription  # noqa: PLC0415 - on ROS wires alone

            subscribe = partial(self._subscriber, self._wire.transforms)
            return opening.enter_context(OtherTfSubscription(subscribe))
        for stream in others:
            opening.enter_context(self._subscriber(stream, is_dormant=True))
        return None

    def _subscriber(self, stream: StreamName, *, is_dormant: bool = False) -> StreamSubscriber:
        keys, samples = self._keys(stream), self.ingests.streams[stream]
        samples.capacity = capacity_for(keys)
        make = partial(
            StreamSubscriber, self._session, keys, partial(self._on_samples, samples), is_dormant=is_dormant
        )
        envelope = self._wire.usual_envelope(stream)
        if not self._has_fast_path or envelope is None:
            return make()
        return make(insert_next=partial(self._insert_next, samples), envelope=envelope)

    def _insert_next(self, samples: StreamIngests, key: str, message: bytes | None) -> bool:
        """Insert a sample in one call of the extension if it is the usual next one on its key."""
        ingest = samples.newest_by_key.get(key)
        now = time.time_ns()
        if ingest is None or not ingest.insert_next(message, now - LATE_NS, now + FAR_NS):
            return False
        if samples.overflowed:
            samples.overflowed.discard(ingest)
        if self._on_usual_sample is not None and ingest.session is not None:
            self._on_usual_sample(ingest.robot, ingest.session)
        for notify in self._observers:
            notify()
        return True

    def _on_samples(self, samples: StreamIngests, arrivals: list[SerializedSample]) -> None:
        """Insert a batch of samples of one stream."""
        is_full = samples.start_batch(len(arrivals))
        # The samples of full batches take the long way.
        is_fast = (
            self._has_fast_path and not is_full and self._wire.usual_envelope(samples.stream) is not None
        )
        handled: list[tuple[str, Sample]] = []
        failure: Exception | None = None
        for arrival in arrivals:
            message = arrival.payload + (arrival.attachment or b"") if is_fast else None
            try:
                robot = self._robot_from_key(arrival.key)
                for sample in self._decode(samples.stream, arrival, robot):
                    if isinstance(sample, Sample):
                        ingest = self.ingests.find(samples, robot, sample.session)
                        samples.insert(ingest, sample, arrival.key, is_full=is_full, message=message)
                        handled.append((robot, sample))
            except InvalidInput as error:
                self._count_foreign(arrival.key, error)
            except Exception as error:  # raised below, after the other samples
                failure = error
        try:
            self._diagnostics.on_samples(handled, self.ingests.writers)
            if failure is not None:
                raise failure
        finally:
            for notify in self._observers:  # not by _observed(), whose call costs 0.2 us
                notify()

    @property
    def announced(self) -> frozenset[Announcement]:
        """The writers of samples that may have a cache."""
        return frozenset(self._announced.copy())

    def request_history(
        self,
        writer: Announcement,
        on_samples: Callable[[StreamIngest, list[Sample]], bool],
        on_done: Callable[[], object] = lambda: None,
    ) -> None:
        """Request the samples that a writer has cached, page by page from the newest.

        ``on_samples(ingest, samples)`` is called with those of a page, oldest first, in the thread of the
        reader, and returns whether older ones are wanted; ``on_done()`` is called once no more follow.
        """
        robot, stream = writer.robot, writer.stream

        def on_page(arrivals: list[SerializedSample], session: int) -> bool:
            messages = (message for one in arrivals for message in self._decode(stream, one, robot))
            samples = [message for message in messages if isinstance(message, Sample)]
            if any(sample.session != session for sample in samples):
                text = f"{robot!r}: samples of another session than {session}, whose history was requested"
                self._counters.count_refusal("foreign answer", text)
                return False
            if not samples:
                return False
            return on_samples(self.ingests.find(self.ingests.streams[stream], robot, session), samples)

        key, page = stream_key(robot, stream, writer.name), self._observed(on_page)
        session = writer.writer.session
        self._requests.add(HistoryRequest(key, session, page, self._count_undecodable, on_done))

    def _on_description(self, arrival: SerializedSample) -> None:
        try:
            robot = self._robot_from_key(arrival.key)
        except InvalidInput as error:
            self._count_foreign(arrival.key, error)
            return
        if self._is_withdrawn(arrival):
            return
        for description in self._decode("robot_description", arrival, robot):
            if isinstance(description, RobotDescription):
                self.ingests.describe(robot, description)

    def _on_statics(self, arrival: SerializedSample) -> None:
        try:
            robot, writer = self._robot_from_key(arrival.key), self._wire.edge_writer_name(arrival.key)
        except InvalidInput as error:
            self._count_foreign(arrival.key, error)
            return
        if writer == MODEL_WRITER and self._follow == "joint_states":
            return  # the model has the same edges
        if not self._is_withdrawn(arrival):
            for message in self._decode("tf_static", arrival, robot):
                if isinstance(message, StaticTransforms):
                    self.ingests.insert_statics(arrival.key, robot, writer, message)
        elif writer is not None:
            self.ingests.withdraw_statics(arrival.key, robot, writer)

    def _is_withdrawn(self, arrival: SerializedSample) -> bool:
        # In ROS nothing can be withdrawn: an empty payload there is a broken message.
        return not arrival.payload and not self._wire.shared

    def _decode(self, stream: StreamName, arrival: SerializedSample, robot: str) -> Sequence[Message]:
        """The messages of ``arrival``; none, counted, if it cannot be decoded."""
        try:
            return self._wire.decode(stream, arrival, robot)
        except MessageError as error:
            self._counters.for_robot(robot).count_refusal(error.reason, f"{arrival.key}: {error}")
            return ()

    def _count_undecodable(self, key: str, error: MessageError) -> None:
        self._counters.count_refusal(error.reason, f"{key}: {error}")

    def _count_foreign(self, key: str, error: InvalidInput) -> None:
        self._counters.count_refusal("foreign", f"{shortened(key)}: {error}")

    def _on_writer(self, announced: Announcement, alive: bool) -> None:
        if self._other_tf is not None:
            self._other_tf.on_writer(announced, alive=alive)
        if alive:
            self.ingests.add_writer(announced)
            if self._has_cache(announced):
                self._announced.add(announced)
                if self._has_history:
                    self.request_history(announced, StreamIngest.insert_history)
        else:
            self._announced.discard(announced)
            self.ingests.remove_writer(announced)

    def _has_cache(self, announced: Announcement) -> bool:
        """Whether an announced writer may have cached samples, on a key that is known."""
        stream = announced.stream
        # A token without a name leaves open on which key of a named stream its writer publishes.
        has_key = bool(announced.name) or not is_named(stream)
        return self._wire.name == "native" and stream in self.ingests.streams and has_key
