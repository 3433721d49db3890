"""TransformListener: subscribes to robots on the network and fills a transform buffer."""

from __future__ import annotations

import os
import time
import weakref
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Literal, ParamSpec, TypeVar

from zstate._util.closeable import Closeable
from zstate._util.format import did_you_mean
from zstate.buffer.buffer import DEFAULT_HISTORY_S, TransformBuffer
from zstate.clock import SYSTEM, Clock, SystemClock
from zstate.errors import InvalidInput, MessageError
from zstate.extension import kernel
from zstate.ingest.base import StreamIngest
from zstate.ingest.counters import Counters, ListenerStats
from zstate.ingest.events import EventLog, WriterEvent
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_parts import PartialJointStateIngest, RobotParts
from zstate.ingest.joint_states import JointStateIngest
from zstate.ingest.stamp_checks import FAR_NS, LATE_NS, StampCheck
from zstate.ingest.stream_ingests import StreamIngests
from zstate.ingest.transforms import StaticTransformIngests, TransformIngest
from zstate.net.clock_offset import ClockOffsetMonitor
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import OtherTfSubscription, WriterWatch, announce_reader, announced_robots
from zstate.net.sample_history import HistoryReader
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber, capacity_for
from zstate.plugins import edge_streams, is_named
from zstate.streams import StreamName
from zstate.wire.identity import Announcement
from zstate.wire.keys import ANY, MODEL_WRITER, check_robot, shortened, stream_from_key, stream_key
from zstate.wire.messages import Message, RobotDescription, Sample, StaticTransforms
from zstate.wire.protocol import SerializedSample, Wire, selected_robots
from zstate.wire.registry import get_wire

Follow = Literal["joint_states", "tf"]

P = ParamSpec("P")
R = TypeVar("R")


class TransformListener(Closeable):
    """Fills ``buffer`` with the transforms of one robot, of several, or of all robots with ``robot="*"``.

    On the native wire ``robot`` may be a sequence of names. Nothing of other robots crosses the link, and
    the named robots share the threads of one listener; its attribute ``robot`` is then ``"*"``. Raises
    InvalidInput if the sequence is empty, or contains ``"*"``, an invalid name or a name twice; on the ROS
    wires if it has more than one name.

    Frames are named ``robot/frame`` in the buffer; bare names work while they are unique.
    ``follow="joint_states"`` subscribes to joint positions and the model and computes the kinematics here;
    ``follow="tf"`` subscribes to transforms and needs no model. Joint positions may come from several
    drivers, each with its own joints (``PartialStatePublisher``, in ROS any node): each joint is interpolated
    between the samples of its own driver, and one that stops leaves exactly its own links behind. The edges
    of other writers of the robot, of a ``StaticPublisher``, a ``TransformPublisher`` or an
    ``OdometryPublisher``, come in either way;
    on the ROS wires these are all edges of /tf and /tf_static but those of a model, which
    robot_state_publisher repeats. With ``history_on_join``
    the buffer also gets the samples that publishers of the native wire cached in the seconds before (their
    ``cache_s``). A context manager.

    The clock domain of each robot is the one in its description, and robots of different domains may share
    the buffer; a lookup across two of them raises ClockMismatch. ``clock`` is the one that ages are measured
    with (default: the system clock); for simulated robots pass a ``SimulatedClock``. Input that cannot be
    used is counted in ``stats``, logged once through ``logging``, and never stops the stream.

    In a forked process nothing fills the buffer: it answers from the samples it has, waits end at once, and
    errors name this as the reason.

    A frame ``robot/...`` is placed by that robot's own writers; its root may also be placed by writers of
    other robots, in their frames. ``placers`` names the robots that may; None: every robot.

    ``on_event(event)`` is called on a thread of its own when a writer joins, leaves, is restarted, is cut off
    or comes back, falls silent, or conflicts with another one: see ``WriterEvent``.
    """

    def __init__(  # noqa: PLR0917 - the order is that of the published contract
        self,
        session: Session,
        robot: str | Sequence[str] = ANY,
        buffer: TransformBuffer | None = None,
        wire: str = "native",
        follow: Follow = "joint_states",
        history_s: float = DEFAULT_HISTORY_S,
        *,
        clock: Clock | None = None,
        history_on_join: bool = True,
        on_event: Callable[[WriterEvent], None] | None = None,
        placers: Collection[str] | None = None,
    ) -> None:
        if follow not in ("joint_states", "tf"):
            raise InvalidInput(f"follow is 'joint_states' or 'tf', not {follow!r}")
        self._wire = get_wire(wire)
        self._robots = selected_robots(robot, self._wire)
        self.robot = self._robots[0] if len(self._robots) == 1 else ANY
        self.buffer = TransformBuffer(history_s, clock) if buffer is None else buffer
        if clock is not None:
            self.buffer.use_clock(clock)
        self._robot_from_key: Callable[[str], str] = (
            self._wire.robot_from_key if self.robot == ANY else lambda _: self.robot
        )
        self._has_fast_path = kernel == "c" and type(self.buffer.clock) is SystemClock
        self._follow: Follow = follow
        self._on_event = on_event
        self._counters = Counters()
        self._stamp_check = StampCheck(self.buffer, self._counters, is_described=not self._wire.shared)
        self._samples = StreamIngests(follow, is_shared=follow in self._wire.shared)
        self._parts = StreamIngests(self._wire.partial_joint_states, is_shared=True, has_parts=True)
        self._sample_streams = self._received_streams()
        streams: tuple[StreamName, ...] = ("robot_description", "tf_static", *self._sample_streams)
        self._events = EventLog(streams, follow, self._wire.shared, on_event)
        self._ownership = FrameOwnership(
            self.buffer,
            self._counters,
            is_shared=bool(self._wire.shared),
            placers=_checked_placers(placers, self._wire),
            on_conflict=self._events.add_second_edge,
        )
        self._names = self._ownership.live
        self._statics = StaticTransformIngests(self._ownership, self._events.set_static_children)
        self._history: HistoryReader | None = None
        self._clock_offsets: ClockOffsetMonitor | None = None
        self._other_tf: OtherTfSubscription | None = None
        self._observers: tuple[Callable[[], object], ...] = ()
        with ExitStack() as opening:
            opening.enter_context(self._events)
            latched: dict[StreamName, Callable[[SerializedSample], None]] = {
                "robot_description": self._on_description,
                "tf_static": self._on_statics,
            }
            for stream, handle in latched.items():
                opening.enter_context(LatchedSubscriber(session, self._keys(stream), self._observed(handle)))
            if len(self._sample_streams) > 1 and self._wire.shared:
                subscribe = partial(self._subscribe, session, [self._wire.transforms])
                self._other_tf = opening.enter_context(OtherTfSubscription(subscribe))
                opening.enter_context(self._subscribe(session, [follow]))
            else:
                opening.enter_context(self._subscribe(session, tuple(self._sample_streams)))
            if history_on_join and self._wire.name == "native":
                on_history = self._observed(self._on_history)
                self._history = opening.enter_context(
                    HistoryReader(session, on_history, self._count_undecodable)
                )
            if not self._wire.shared and self.buffer.clock.domain == SYSTEM:
                self._clock_offsets = opening.enter_context(
                    ClockOffsetMonitor(session, self.buffer.clock, self.buffer.clock_offsets)
                )
            # History is requested from each writer found: after subscribing, so that no sample falls between.
            on_writer, on_cut_off = self._observed(self._on_writer), self._observed(self._on_cut_off)
            opening.enter_context(WriterWatch(session, self._robots, on_writer, wire, on_cut_off))
            for name in self._robots:
                for announcement in announce_reader(session, self._wire, name, streams):
                    opening.enter_context(announcement)
            self._opened = opening.pop_all()
        self._session, self._pid = session, os.getpid()
        self.buffer.explain_emptiness(self._explain_emptiness)
        _LISTENERS.add(self)

    def _received_streams(self) -> dict[StreamName, StreamIngests]:
        received: dict[StreamName, StreamIngests] = {self._follow: self._samples}
        if self._follow == "joint_states":
            received[self._parts.stream] = self._parts  # in ROS any joint state may be a part
        for stream in self._wire.edges:
            if stream != self._follow:
                received[stream] = StreamIngests(stream, is_shared=True)
        return received

    def _subscribe(self, session: Session, streams: Sequence[StreamName]) -> ExitStack:
        """Receive the samples of ``streams`` until the stack is closed."""
        with ExitStack() as opening:
            for stream in streams:
                samples, keys = self._sample_streams[stream], self._keys(stream)
                samples.capacity = capacity_for(keys)
                opening.enter_context(self._subscriber(session, keys, samples))
            return opening.pop_all()

    def _keys(self, stream: StreamName) -> list[str]:
        """The key expressions of ``stream`` of the robots."""
        return [self._wire.expression(robot, stream) for robot in self._robots]

    def __repr__(self) -> str:
        robots, received = len(self.robots()), self.stats.received
        names = ", ".join(map(repr, self._robots))
        return f"<TransformListener of {names}: {robots} robots, {received} samples received>"

    @property
    def stats(self) -> ListenerStats:
        """Counts of samples received, lost and refused so far."""
        return self._counters.stats()

    def stats_of(self, robot: str) -> ListenerStats:
        """The part of ``stats`` that concerns one robot."""
        return self._counters.for_robot(robot).stats()

    @property
    def refusals(self) -> dict[str, str]:
        """The text of the first refusal of each reason in ``stats.refused``."""
        return self._counters.refusals()

    def refusals_of(self, robot: str) -> dict[str, str]:
        """The part of ``refusals`` that concerns one robot."""
        return self._counters.for_robot(robot).refusals()

    def robots(self) -> tuple[str, ...]:
        """The robots that sent any message so far, sorted by name."""
        ingests = (
            one for samples in {self._samples, *self._sample_streams.values()} for one in samples.all()
        )
        return tuple(sorted({ingest.robot for ingest in ingests if ingest.has_data}))

    def events(self) -> tuple[WriterEvent, ...]:
        """The last 1024 events of writers, oldest first.

        Without ``on_event`` there are no "stale" events, and a writer that froze before it disappeared has
        "left".
        """
        return self._events.recent()

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

    def close(self) -> None:
        """Stop listening; the buffer keeps its samples. A second call does nothing."""
        _LISTENERS.discard(self)
        self.buffer.explain_emptiness(None)
        self._opened.close()

    def _explain_emptiness(self) -> str:
        """Why no frame has been received, for an error: the robots that are missing, and similar names.

        Queries the tokens of all robots if one is missing, which takes up to a second.
        """
        if self._wire.shared:
            return ""
        present = {robot for robot, _ in list(self._names)}
        missing = [name for name in self._robots if name not in (ANY, *present)]
        if missing:
            robots = announced_robots(self._session, self._wire)
            names = (f"robot {name!r} is not announced{did_you_mean(name, robots)}" for name in missing)
            return f"{'; '.join(names)} (announced: {shortened(', '.join(robots) or 'no robot')})"
        if not present:
            return ""
        return f"{shortened(', '.join(sorted(present)))} is announced, but no frame of it has arrived yet"

    def end_after_fork(self) -> None:
        """End the buffer in a forked child, where nothing fills it."""
        self.buffer.stop(
            f"its listener belongs to process {self._pid} and does not run after a fork: no more data comes; "
            "call connect() and open a listener in the child processes alone, or start them with the 'spawn' "
            "or 'forkserver' method"
        )

    def _subscriber(self, session: Session, keys: Sequence[str], samples: StreamIngests) -> StreamSubscriber:
        on_samples = partial(self._on_samples, samples)
        envelope = self._wire.usual_envelope(samples.stream)
        if not self._has_fast_path or envelope is None:
            return StreamSubscriber(session, keys, on_samples)
        insert_next = partial(self._insert_next, samples)
        return StreamSubscriber(session, keys, on_samples, insert_next=insert_next, envelope=envelope)

    def _ingest_for(self, samples: StreamIngests, robot: str, session: int) -> StreamIngest:
        ingest = samples.find(robot, session)
        if ingest is None:
            self._ownership.add_robot(robot)
            ingest = samples.add(self._new_ingest(samples, robot), session)
        return ingest

    def _new_ingest(self, samples: StreamIngests, robot: str) -> StreamIngest:
        on_set_back = self._events.add_set_back
        if samples.has_parts:
            others = bool(self._wire.shared)
            return PartialJointStateIngest(
                robot, self._ownership, self._joint_parts(robot), on_set_back, others=others
            )
        make = JointStateIngest if samples.stream == "joint_states" else TransformIngest
        return make(robot, self._ownership, on_set_back)

    def _joint_parts(self, robot: str) -> RobotParts:
        ingest = self._ingest_for(self._samples, robot, 0)
        assert isinstance(ingest, JointStateIngest)
        return ingest.parts

    def _insert_next(self, samples: StreamIngests, key: str, message: bytes | None) -> bool:
        """Insert a sample in one call of the extension if it is the usual next one on its key."""
        ingest = samples.newest_by_key.get(key)
        now = time.time_ns()
        if ingest is None or not ingest.insert_next(message, now - LATE_NS, now + FAR_NS):
            return False
        if samples.overflowed:
            samples.overflowed.discard(ingest)
        if self._on_event is not None and ingest.session is not None:
            self._events.on_sample(ingest.robot, ingest.session)
        for notify in self._observers:
            notify()
        return True

    def _on_samples(self, samples: StreamIngests, arrivals: list[SerializedSample]) -> None:
        is_full = len(arrivals) >= samples.capacity
        if is_full:
            # A full ring has lost samples of any of the writers, and loses more while it is drained.
            samples.overflowed = set(samples.all())
        # The samples of full batches take the long way.
        is_fast = (
            self._has_fast_path and not is_full and self._wire.usual_envelope(samples.stream) is not None
        )
        earliest, latest = self._stamp_check.accepted_range()
        failure: Exception | None = None
        for arrival in arrivals:
            try:
                robot = self._robot_from_key(arrival.key)
                for sample in self._decode(samples.stream, arrival, robot):
                    if isinstance(sample, Sample):
                        ingest = self._ingest_for(samples, robot, sample.session)
                        overflowed = is_full or ingest in samples.overflowed
                        message = arrival.payload + (arrival.attachment or b"") if is_fast else None
                        ingest.insert_sample(sample, overflowed=overflowed, message=message)
                        samples.overflowed.discard(ingest)
                        if is_fast and samples.newest_by_key.get(arrival.key) is not ingest:
                            samples.newest_by_key[arrival.key] = ingest
                        self._events.on_sample(robot, sample.session)
                        if not earliest <= sample.stamp <= latest:
                            writer = self._names.get((robot, sample.session))
                            self._stamp_check.check(robot, writer, sample)
            except InvalidInput as error:
                self._count_foreign(arrival.key, error)
            except Exception as error:  # raised below, after the other samples
                failure = error
        for notify in self._observers:  # not by _observed(), whose call costs 0.2 us
            notify()
        if failure is not None:
            raise failure

    def _on_history(self, arrivals: list[SerializedSample], writer: int) -> bool:
        robot = self._robot_from_key(arrivals[0].key)  # the key of the request
        stream = stream_from_key(arrivals[0].key)
        messages = (message for one in arrivals for message in self._decode(stream, one, robot))
        samples = [message for message in messages if isinstance(message, Sample)]
        if any(sample.session != writer for sample in samples):
            text = f"{robot!r}: samples of another session than {writer}, whose history was requested"
            self._counters.count_refusal("foreign answer", text)
            return False
        if not samples:
            return False
        return self._ingest_for(self._sample_streams[stream], robot, writer).insert_history(samples)

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
                self._ingest_for(self._samples, robot, description.session).describe(description)
                for part in self._parts.all(robot):
                    part.describe(description)

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
                    self._ingest_for(self._samples, robot, message.session).has_data = True
                    self._statics.insert(arrival.key, robot, writer, message)
        elif writer is not None:
            self._statics.withdraw(arrival.key, robot, writer)

    def _is_withdrawn(self, arrival: SerializedSample) -> bool:
        # In ROS nothing can be withdrawn: an empty payload there is a broken message.
        return not arrival.payload and not self._wire.shared

    def _decode(self, stream: StreamName, arrival: SerializedSample, robot: str) -> Sequence[Message]:
        try:
            return self._wire.decode(stream, arrival, robot)
        except MessageError as error:
            self._counters.for_robot(robot).count_refusal(error.reason, f"{arrival.key}: {error}")
            return ()

    def _count_undecodable(self, key: str, error: MessageError) -> None:
        self._counters.count_refusal(error.reason, f"{key}: {error}")

    def _count_foreign(self, key: str, error: InvalidInput) -> None:
        self._counters.count_refusal("foreign", f"{shortened(key)}: {error}")

    def _on_cut_off(self, announced: Announcement) -> None:
        self._events.on_cut_off(announced)
        self._on_writer(announced, alive=False)  # adds no second event

    def _on_writer(self, announced: Announcement, alive: bool) -> None:
        self._events.on_writer(announced, alive)
        robot, session, stream = announced.robot, announced.writer.session, announced.stream
        name = str(announced.writer)
        if self._other_tf is not None:
            self._other_tf.on_writer(announced, alive=alive)
        if alive:
            self._names[robot, session] = name
            self._ownership.add_robot(robot)
        else:
            self._names.pop((robot, session), None)
        if stream == "tf_static" and alive:
            self._ownership.add_writer(robot, session)
            self._statics.name_writer(session, name)
        elif stream == "tf_static":
            self._ownership.remove_writer(robot, session)
        elif stream == "robot_description" and self._follow == "joint_states" and alive:
            self._ingest_for(self._samples, robot, session).name_writer(session, name)
        elif stream in self._sample_streams:
            self._set_followed_writer(self._sample_streams[stream], announced, alive=alive)

    def _set_followed_writer(self, samples: StreamIngests, announced: Announcement, *, alive: bool) -> None:
        robot, session = announced.robot, announced.writer.session
        if samples.stream in edge_streams() or (samples.stream == "tf" and not self._wire.shared):
            (self._ownership.add_writer if alive else self._ownership.remove_writer)(robot, session)
        elif self._follow == "joint_states":
            parts = self._joint_parts(robot)
            if alive:
                parts.add_writer(session, announced.writer.since)
            else:
                parts.remove_writer(session)
        if self._clock_offsets is not None and alive:
            self._clock_offsets.watch(robot, announced.writer)
        elif self._clock_offsets is not None:
            self._clock_offsets.unwatch(announced.writer)
        # A token without a name leaves open on which key of a named stream its writer publishes.
        has_key = bool(announced.name) or not is_named(samples.stream)
        if alive and self._history is not None and has_key:
            self._history.request(stream_key(robot, samples.stream, announced.name), session)
        if not alive:
            samples.writer_left(robot, session)
        elif samples.is_shared:
            samples.announce(robot, session, str(announced.writer))
        else:
            self._ingest_for(samples, robot, session).name_writer(session, str(announced.writer))


def _checked_placers(placers: Collection[str] | None, wire: Wire) -> frozenset[str] | None:
    if placers is None:
        return None
    if isinstance(placers, str):
        raise InvalidInput(f"placers is a collection of robot names, for instance {[placers]!r}")
    if wire.shared:
        raise InvalidInput(f"placers need the native wire; on {wire.name!r} no frame belongs to a robot")
    return frozenset(map(check_robot, placers))


_LISTENERS: weakref.WeakSet[TransformListener] = weakref.WeakSet()
os.register_at_fork(after_in_child=lambda: [listener.end_after_fork() for listener in tuple(_LISTENERS)])
