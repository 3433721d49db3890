"""TransformListener: follows robots on the network and keeps a buffer filled."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from typing import Literal

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import Clock
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.following.edges import EdgeFollower
from zstate.following.events import Event, Events
from zstate.following.follower import Follower
from zstate.following.joints import JointFollower
from zstate.following.off_clock import OffClock
from zstate.following.ownership import FrameOwnership
from zstate.following.statics import StaticFollower
from zstate.following.tally import Stats, Tally
from zstate.following.writer_clocks import WriterClocks
from zstate.net.history import PastReader
from zstate.net.latched import LatchedSubscriber
from zstate.net.presence import announce_reader, watch
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber, capacity_for
from zstate.net.wires import wire_named
from zstate.wire.keys import ANY, MODEL_WRITER, Stream, shortened
from zstate.wire.messages import Message, RobotDescription, Sample, StaticTransforms
from zstate.wire.wire import Arrival
from zstate.wire.writer import Announced

Follow = Literal["joint_states", "tf"]


class TransformListener(Closing):
    """Fills ``buffer`` with what a robot's publishers say; ``robot="*"`` follows every robot.

    Frames are called ``robot/frame`` in the buffer, and answer to their bare names while those are
    unique. ``follow="joint_states"`` takes joint positions and the model and does the kinematics here;
    ``follow="tf"`` takes ready transforms and needs no model. With ``history_on_join`` the buffer learns
    from the publishers of the native wire what they said in the seconds before (``StatePublisher``'s
    ``cache_s``). A context manager.

    Each robot has the clock domain that its description names, and robots of different domains may share the
    buffer; a lookup across two of them raises ClockMismatch. ``clock`` is the one that ages are measured
    with (default: the system's); for robots of a simulation give a ``SimulatedClock``. What cannot be used is
    counted in ``stats``, reported once through ``logging``, and never stops the stream.

    In a forked process nothing fills the buffer: there it answers from what it held, waits end at once, and
    the errors say so.

    A frame ``robot/...`` is placed by that robot's own writers; its root may also be placed by writers of
    other robots, in their frames. ``placers`` names the robots that may; None: every robot.

    ``on_event(event)`` is called, from a thread of its own, when a writer joins, leaves, is restarted or
    cut off and comes back, falls silent, or fights with another one: see ``Event``.
    """

    def __init__(  # noqa: PLR0917 - the order is that of the published contract
        self,
        session: Session,
        robot: str = ANY,
        buffer: TransformBuffer | None = None,
        wire: str = "native",
        follow: Follow = "joint_states",
        history_s: float = 10.0,
        *,
        clock: Clock | None = None,
        history_on_join: bool = True,
        on_event: Callable[[Event], None] | None = None,
        placers: Collection[str] | None = None,
    ) -> None:
        if isinstance(placers, str):
            raise InvalidInput(f"placers is a collection of robot names, for instance {[placers]!r}")
        if follow not in ("joint_states", "tf"):
            raise InvalidInput(f"follow is 'joint_states' or 'tf', not {follow!r}")
        self.robot = robot
        self.buffer = TransformBuffer(history_s, clock) if buffer is None else buffer
        if clock is not None:
            self.buffer.use_clock(clock)
        self._wire = wire_named(wire)
        self._follow: Follow = follow
        self._is_shared = follow in self._wire.shared
        self._recalls = history_on_join
        self._tally = Tally()
        self._off_clock = OffClock(self.buffer, self._tally, is_described=not self._wire.shared)
        self._clocks: WriterClocks | None = None
        self._heard: tuple[Stream, ...] = ("robot_description", "tf_static", follow)
        self._events = Events(self._heard, follow, self._wire.shared, on_event)
        self._ownership = FrameOwnership(
            self.buffer,
            self._tally,
            is_shared=bool(self._wire.shared),
            placers=placers,
            on_conflict=self._events.note_second_edge,
        )
        self._names = self._ownership.live
        self._followers: dict[tuple[str, int], Follower] = {}
        self._statics: dict[tuple[str, int], StaticFollower] = {}
        self._overflowed: set[Follower] = set()
        self._past: PastReader | None = None
        with ExitStack() as opening:
            opening.enter_context(self._events)
            self._open(session, wire, opening)
            self._opened = opening.pop_all()
        self._pid = os.getpid()
        _LISTENERS.add(self)

    def _open(self, session: Session, wire: str, opening: ExitStack) -> None:
        expression, robot = self._wire.expression, self.robot
        key = expression(robot, "robot_description")
        opening.enter_context(LatchedSubscriber(session, key, self._on_description))
        key = expression(robot, "tf_static")
        opening.enter_context(LatchedSubscriber(session, key, self._on_statics))
        key = expression(robot, self._follow)
        self._capacity = capacity_for(key)
        opening.enter_context(StreamSubscriber(session, key, self._on_samples))
        if self._recalls and self._wire.name == "native":
            self._past = PastReader(session, self._on_past, self._note_broken)
            opening.enter_context(self._past)
        if not self._wire.shared:
            self._clocks = opening.enter_context(WriterClocks(session, self.buffer))
        # After the subscription: who is asked for the past then has everything newer sent to us.
        opening.enter_context(watch(session, robot, self._on_writer, wire, self._on_cut_off))
        for announcement in announce_reader(session, self._wire, robot, self._heard):
            opening.enter_context(announcement)

    def __repr__(self) -> str:
        robots, received = len(self.robots()), self.stats.received
        return f"<TransformListener of {self.robot!r}: {robots} robots, {received} samples received>"

    @property
    def stats(self) -> Stats:
        """What has been received, lost and refused so far."""
        return self._tally.stats()

    def stats_of(self, robot: str) -> Stats:
        """The part of ``stats`` that concerns one robot."""
        return self._tally.of(robot).stats()

    @property
    def refusals(self) -> dict[str, str]:
        """What could not be used, by reason as in ``stats.refused``: the first of each, in words."""
        return self._tally.refusals()

    def robots(self) -> tuple[str, ...]:
        """The robots that were heard so far, sorted by name."""
        return tuple(sorted({robot.robot for robot in list(self._followers.values()) if robot.heard}))

    def events(self) -> tuple[Event, ...]:
        """What happened to the writers lately: the last 1024 events, oldest first.

        Without ``on_event`` nobody looks how long a writer has been silent: none is "stale", and one that
        froze before it vanished has "left".
        """
        return self._events.recent()

    def close(self) -> None:
        """Stop listening; the buffer keeps what it has. A second call does nothing."""
        _LISTENERS.discard(self)
        self._opened.close()

    def end_after_fork(self) -> None:
        """In a forked child: nothing fills the buffer there."""
        self.buffer.stop(
            f"its listener belongs to process {self._pid} and does not run after a fork: no more data comes; "
            "call connect() and open a listener in the child processes alone, or start them with the 'spawn' "
            "or 'forkserver' method"
        )

    def _robot_of(self, key: str) -> str:
        return self._wire.robot_of(key) if self.robot == ANY else self.robot

    def _follower(self, robot: str, session: int) -> Follower:
        key = (robot, session if self._is_shared else 0)
        follower = self._followers.get(key)
        if follower is None:
            if self._follow == "joint_states":
                follower = JointFollower(robot, self._ownership, self._events.note_set_back)
            else:
                follower = EdgeFollower(robot, self._ownership, self._events.note_set_back)
            follower = self._followers.setdefault(key, follower)
            self._ownership.add_robot(robot)
            if self._is_shared and (robot, session) in self._names:
                follower.name_writer(session, self._names[robot, session])
        return follower

    def _on_samples(self, arrivals: list[Arrival]) -> None:
        is_full = len(arrivals) >= self._capacity
        if is_full:
            # A ring that is full has lost samples, of whoever sent any, and loses more while it is emptied.
            self._overflowed = set(self._followers.values())
        earliest, latest = self._off_clock.look()
        failure: Exception | None = None
        for arrival in arrivals:
            try:
                robot = self._robot_of(arrival.key)
                for sample in self._decode(self._follow, arrival, robot):
                    if isinstance(sample, Sample):
                        follower = self._follower(robot, sample.session)
                        follower.take(sample, overflowed=is_full or follower in self._overflowed)
                        self._overflowed.discard(follower)
                        self._events.note_sample(robot, sample.session)
                        if not earliest <= sample.stamp <= latest:
                            self._off_clock.note(robot, self._names.get((robot, sample.session)), sample)
            except InvalidInput as error:  # noqa: PERF203 - not a function of its own: runs for each sample
                self._note_foreign(arrival.key, error)
            except Exception as error:  # the samples behind it are not to blame
                failure = error
        if failure is not None:
            raise failure

    def _on_past(self, arrivals: list[Arrival], writer: int) -> bool:
        robot = self._robot_of(arrivals[0].key)  # that was asked for
        samples = [
            sample
            for arrival in arrivals
            for sample in self._decode(self._follow, arrival, robot)
            if isinstance(sample, Sample)
        ]
        if any(sample.session != writer for sample in samples):
            text = f"{robot!r}: samples of another session than {writer}, whose past was requested"
            self._tally.refuse("foreign answer", text)
            return False
        return bool(samples) and self._follower(robot, writer).take_past(samples)

    def _note_broken(self, key: str, error: MessageError) -> None:
        self._tally.refuse(error.reason, f"{key}: {error}")

    def _note_foreign(self, key: str, error: InvalidInput) -> None:
        self._tally.refuse("foreign", f"{shortened(key)}: {error}")

    def _on_description(self, arrival: Arrival) -> None:
        try:
            robot = self._robot_of(arrival.key)
        except InvalidInput as error:
            self._note_foreign(arrival.key, error)
            return
        if self._is_withdrawn(arrival):
            return
        for description in self._decode("robot_description", arrival, robot):
            if isinstance(description, RobotDescription):
                self._follower(robot, description.session).describe(description)

    def _on_statics(self, arrival: Arrival) -> None:
        try:
            robot, writer = self._robot_of(arrival.key), self._wire.statics_writer(arrival.key)
        except InvalidInput as error:
            self._note_foreign(arrival.key, error)
            return
        if writer == MODEL_WRITER and self._follow == "joint_states":
            return  # the model itself says the same
        if not self._is_withdrawn(arrival):
            for message in self._decode("tf_static", arrival, robot):
                if isinstance(message, StaticTransforms):
                    self._take_statics(arrival.key, robot, writer, message)
        elif writer is not None:
            self._static_follower(arrival.key, robot, writer).withdraw()
            self._statics.pop((arrival.key, 0), None)
            self._events.note_statics(robot, writer, frozenset())

    def _is_withdrawn(self, arrival: Arrival) -> bool:
        # In ROS nothing can be taken back: what is empty there is a broken message.
        return not arrival.payload and not self._wire.shared

    def _take_statics(self, key: str, robot: str, writer: str | None, message: StaticTransforms) -> None:
        self._follower(robot, message.session).note_heard()
        if writer is not None:
            follower = self._static_follower(key, robot, writer)
            follower.replace(message)
            self._events.note_statics(robot, writer, follower.children)
        else:
            # A ROS node may not have announced itself yet: told from others by its number.
            name = self._names.get((robot, message.session), f"a ROS node {message.session:016x}")
            self._static_follower(key, robot, name, message.session).add(message)

    def _static_follower(self, key: str, robot: str, writer: str, session: int = 0) -> StaticFollower:
        make = StaticFollower(robot, writer, self._ownership, is_model=writer == MODEL_WRITER)
        return self._statics.setdefault((key, session), make)

    def _decode(self, stream: Stream, arrival: Arrival, robot: str) -> Sequence[Message]:
        try:
            return self._wire.decode(stream, arrival, robot)
        except MessageError as error:
            self._tally.of(robot).refuse(error.reason, f"{arrival.key}: {error}")
            return ()

    def _on_writer(self, announced: Announced, alive: bool) -> None:
        self._events.note_writer(announced, alive)
        self._follow_writer(announced, alive=alive)

    def _on_cut_off(self, announced: Announced) -> None:
        self._events.note_cut_off(announced)
        self._follow_writer(announced, alive=False)

    def _follow_writer(self, announced: Announced, *, alive: bool) -> None:
        robot, session = announced.robot, announced.writer.session
        if alive:
            self._names[robot, session] = str(announced.writer)
            self._ownership.add_robot(robot)
        else:
            self._names.pop((robot, session), None)
        if announced.stream == "tf_static":
            self._note_static_writer(robot, session, alive=alive)
        if announced.stream == "robot_description" and self._follow == "joint_states" and alive:
            self._follower(robot, session).name_writer(session, self._names[robot, session])
        if announced.stream != self._follow:
            return
        if self._clocks is not None:
            self._clocks.note(announced, alive=alive)
        if alive and self._past is not None:
            self._past.ask(self._wire.expression(robot, self._follow), session)
        if not self._is_shared:
            self._note_writer(self._follower(robot, session), session, alive=alive)
        elif (robot, session) in self._followers:
            self._note_writer(self._followers[robot, session], session, alive=alive)
            if not alive:
                del self._followers[robot, session]

    def _note_static_writer(self, robot: str, session: int, *, alive: bool) -> None:
        if not alive:
            self._ownership.remove_writer(robot, session)
            return
        self._ownership.add_writer(robot, session)
        for (_, writing), follower in list(self._statics.items()):
            if writing == session:  # of a ROS node, whose edges may have come before its name
                follower.name_writer(self._names[robot, session])

    def _note_writer(self, follower: Follower, session: int, *, alive: bool) -> None:
        if alive:
            follower.name_writer(session, self._names[follower.robot, session])
        else:
            follower.writer_left(session)


_LISTENERS: weakref.WeakSet[TransformListener] = weakref.WeakSet()


def _end_after_fork() -> None:
    for listener in tuple(_LISTENERS):
        listener.end_after_fork()


os.register_at_fork(after_in_child=_end_after_fork)
