"""StatePublisher: joint positions in, the state of a robot out on Zenoh."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack

from numpy.typing import ArrayLike

from zstate.clock import SYSTEM, Clock, SystemClock, check_stamp
from zstate.closing import Closing
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.locks import new_lock, outlive_fork
from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.limits import JointLimits
from zstate.model.robot import RobotModel
from zstate.moving_edges import MovingEdges, Positions
from zstate.net.claims import Claim
from zstate.net.clock_offset import ClockService
from zstate.net.history import Memory, answer_past
from zstate.net.outlets import Outlets, StreamOutlet
from zstate.net.presence import writer_here
from zstate.net.session import Session
from zstate.net.status import StatusPublisher
from zstate.net.wires import wire_named, wire_names
from zstate.nodes.lookup_service import LookupService, RecentBuffer
from zstate.rate import Rate, RateReport
from zstate.sources.source import JointSource
from zstate.status import Beat, LimitWatch, PublisherStats, StreamStats
from zstate.wire.keys import MODEL_WRITER, Stream, check_robot
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    order_digest,
    to_block,
)
from zstate.wire.sample_names import SampleNames
from zstate.wire.writer import Announced, Writer

STREAMS: tuple[Stream, ...] = ("joint_states", "tf", "tf_static", "robot_description")
"""What a robot's state consists of on the network."""

_NEWEST_ONLY_S = 1e-9
"""Of the memory that answers lookups where there is no cache for listeners that join."""


class StatePublisher(Closing):
    """Publishes the state of one robot: each sample is the whole robot at one instant.

    Whoever joins, at any time, is given the model (``robot_description``) and its fixed edges
    (``tf_static``). Samples go out on ``joint_states``; the moving edges also on ``tf``, while somebody
    reads that. ``robot`` is its name on the network, the model's name unless given. ``streams`` names
    what this publisher writes, where another program writes the rest. ``program`` is who others see
    writing, the script's name unless given.

    Where somebody else who lives writes one of its streams on the native wire, SecondWriter is raised and
    names the first; of two that open at once the later one gets it from ``publish``, and is closed by it.
    With ``takeover`` it writes nevertheless, and readers follow whoever came last.

    On the native wire it says once a second how it does, to
    those who ask (``zstate.net.status``); it remembers the last ``cache_s`` seconds of samples for
    listeners that join (``zstate.net.history``; 0 for none); and it answers lookups of its own frames on
    ``zstate/<robot>/lookup`` from these, or from the newest sample without a cache
    (``zstate.nodes.lookup_service``). A context manager; safe from any thread.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        robot: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        streams: Sequence[Stream] = STREAMS,
        clock: Clock | None = None,
        program: str = "",
        takeover: bool = False,
        cache_s: float = 2.0,
    ) -> None:
        self.model = model
        self.robot = check_robot(robot or model.name)
        self._clock: Clock = clock or SystemClock()
        self._lock = new_lock()
        self._stop = outlive_fork(threading.Event())
        self._opened = ExitStack()
        self._edges = MovingEdges(model, self.robot)
        self._session_id = secrets.randbits(32)
        self._seq = 0
        self._refused = 0
        self._last_refusal = ""
        self._rate: Rate | None = None
        self._wires = wires = wire_names(wires)
        self._joint_order = order_digest(model.joint_names)
        _check_streams(streams)
        limits = JointLimits(model)
        self._limits = LimitWatch(limits, self.robot) if limits and wires else None
        sample_names = SampleNames(coordinate_names(model), velocity_slots(model), self._edges.names)
        writer = writer_here(self._session_id, program)
        with ExitStack() as opening:
            self._claim = self._claimed(session, writer, streams, opening) if not takeover else None
            if "native" in wires and self._clock.domain == SYSTEM:
                # Before anybody is told of this writer: who is told asks what time it is here.
                opening.enter_context(ClockService(session, self.robot, writer, self._clock))
            outlets = [
                opening.enter_context(Outlets(session, wire_named(wire), self.robot, writer, sample_names))
                for wire in wires
            ]
            self._outputs = [self._output(out, streams) for out in outlets]
            if "native" in wires and {"joint_states", "tf"}.intersection(streams):
                status = Beat(writer, lambda: self.stats).status
                opening.enter_context(StatusPublisher(session, self.robot, writer.identity, status))
            self._kept = self._remembering(session, streams, cache_s, opening)
            self.memory = self._kept if cache_s else None
            if self._kept is not None and {"joint_states", "tf"}.intersection(streams):
                recent = RecentBuffer(model, self.robot, self._kept)
                opening.enter_context(LookupService(session, recent.buffer, self.robot))
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        closed = ", closed" if self._stop.is_set() else ""
        return f"<StatePublisher of {self.robot!r} on {', '.join(self._wires)}: {self._seq} samples{closed}>"

    def _remembering(
        self, session: Session, streams: Sequence[Stream], cache_s: float, opening: ExitStack
    ) -> Memory | None:
        if "native" not in self._wires:
            return None
        numbers = self.model.position_count + 2 * self.model.velocity_count
        memory = Memory(cache_s or _NEWEST_ONLY_S, numbers, self._session_id)
        if cache_s == 0.0:
            return memory
        output = self._outputs[self._wires.index("native")]
        for stream, say in output.sayings.items():
            if stream in streams:
                service = answer_past(session, self.robot, stream, memory, say)
                opening.enter_context(service)
        return memory

    def _claimed(
        self, session: Session, writer: Writer, streams: Sequence[Stream], opening: ExitStack
    ) -> Claim | None:
        # In ROS several writers of a topic are normal, and nobody could be refused.
        if "native" not in self._wires or not streams:
            return None
        wanted = [
            Announced(self.robot, stream, writer, MODEL_WRITER if stream == "tf_static" else "")
            for stream in streams
        ]
        return opening.enter_context(Claim(session, wanted))

    def _output(self, outlets: Outlets, streams: Sequence[Stream]) -> _Output:
        if "robot_description" in streams:
            outlets.latched("robot_description", MODEL_WRITER).set(self.description())
        if "tf_static" in streams:
            outlets.latched("tf_static", MODEL_WRITER).set(self.statics())
        return _Output(outlets, streams, self._edges)

    def description(self) -> RobotDescription:
        """What late joiners are told of the robot."""
        model = self.model
        return RobotDescription(
            self._session_id,
            model.urdf,
            model.digest,
            model.joint_names,
            self._edges.names,
            self._clock.domain,
        )

    def statics(self) -> StaticTransforms:
        """The robot's fixed edges, for readers without its model."""
        return self._edges.statics(self._session_id)

    @property
    def stats(self) -> PublisherStats:
        """What has been published, suppressed and refused so far."""
        streams: dict[tuple[str, Stream], StreamStats] = {
            (wire, stream): StreamStats(outlet.samples, outlet.bytes, self._seq - outlet.samples)
            for wire, output in zip(self._wires, self._outputs, strict=True)
            for stream, outlet in output.outlets.items()
        }
        rate = None if self._rate is None else self._rate.report()
        counts = (self._seq, self._refused, self._last_refusal, streams, rate)
        limits = self._limits
        return (
            PublisherStats(*counts) if limits is None else PublisherStats(*counts, limits.count, limits.last)
        )

    def publish(
        self,
        positions: Positions,
        velocities: ArrayLike | None = None,
        efforts: ArrayLike | None = None,
        stamp: int | None = None,
    ) -> None:
        """Send one sample: the robot at ``stamp`` [ns], which is now unless given.

        ``positions`` [rad] or [m] are in the order of ``model.joint_names``, or a mapping of joint names
        that has all of them; ``velocities`` per second and ``efforts`` [Nm] or [N] likewise in that order
        where they are known. Positions outside joint limits are published, counted in ``stats``, and
        logged once. Raises InvalidInput for wrong counts, unknown or missing names, NaN and infinity, a
        floating joint without a unit quaternion, a stamp that a wire cannot say, and Closed and
        SecondWriter; then nothing was sent.
        """
        try:
            self._publish(positions, velocities, efforts, stamp)
        except InvalidInput as error:
            self._last_refusal = str(error)
            self._refused += 1
            raise

    def _publish(
        self,
        positions: Positions,
        velocities: ArrayLike | None,
        efforts: ArrayLike | None,
        stamp: int | None,
    ) -> None:
        block = self._edges.block(positions)
        rates = None if velocities is None else to_block(self.model.check_velocities(velocities))
        forces = None if efforts is None else to_block(self.model.check_efforts(efforts))
        stamp = self._clock.now() if stamp is None else check_stamp(stamp)
        with self._lock:
            if self._stop.is_set():
                raise Closed(f"the publisher of {self.robot!r} is closed")
            self._yield_to_the_first()
            head = (stamp, self._seq, self._session_id)
            state = JointState(*head, self._joint_order, block, rates, forces)
            said = [one for output in self._outputs for one in output.said(state)]
            self._seq += 1
            if self._kept is not None:
                # First: who hears nothing of this sample yet can then be told of it.
                self._kept.keep(state)
            for outlet, payload in said:
                outlet.put(payload)
            if self._limits is not None:
                self._limits.add(stamp, block)

    def _yield_to_the_first(self) -> None:
        try:
            if self._claim is not None:
                self._claim.check()
        except SecondWriter:
            self._opened.close()  # also what late joiners would be given
            raise

    def run(self, source: JointSource, rate_hz: float = 100.0, *, seconds: float | None = None) -> RateReport:
        """Publish what ``source`` reads, at exactly ``rate_hz``, for ``seconds`` or until ``close()``.

        Each tick has an absolute deadline (see ``Rate`` for what becomes of late ones). A tick for
        which the source has nothing new sends nothing. Raises SecondWriter.
        """
        self._rate = rate = Rate(rate_hz, self._clock, self._stop, seconds)
        for now in rate:
            reading = source.read(now)
            if reading is not None:
                stamp = now if reading.stamp is None else reading.stamp
                try:
                    self.publish(reading.positions, reading.velocities, reading.efforts, stamp)
                except Closed:
                    break
        return rate.report()

    def close(self) -> None:
        """Stop publishing; ``run`` returns. A second call does nothing."""
        self._stop.set()
        with self._lock:
            self._opened.close()


class _Output:
    """The streams of one wire."""

    def __init__(self, outlets: Outlets, streams: Sequence[Stream], edges: MovingEdges) -> None:
        self._edges = edges
        said: tuple[Stream, ...] = ("joint_states", "tf")
        self.outlets: dict[Stream, StreamOutlet] = {
            stream: outlets.stream(stream) for stream in said if stream in streams
        }
        self._joints = self.outlets.get("joint_states")
        self._transforms = self.outlets.get("tf")

    def said(self, state: JointState) -> Iterator[tuple[StreamOutlet, bytes]]:
        """What this wire says of ``state``: the transforms only while somebody reads them."""
        if self._joints is not None:
            yield self._joints, self._joints.encode(state)
        if self._transforms is not None and self._transforms.has_readers:
            yield self._transforms, self._transforms.encode(self._edges.sample(state))

    @property
    def sayings(self) -> dict[Stream, Callable[[JointState], bytes]]:
        """How this wire says of a state again what it said when that was new."""

        def say_transforms(state: JointState) -> bytes:
            return self.outlets["tf"].encode(self._edges.sample(state))

        says: dict[Stream, Callable[[JointState], bytes]] = {"tf": say_transforms}
        return says if self._joints is None else {**says, "joint_states": self._joints.encode}


def _check_streams(streams: Sequence[Stream]) -> None:
    for stream in streams:
        if stream not in STREAMS:
            raise InvalidInput(f"{stream!r} is not one of the streams {', '.join(map(repr, STREAMS))}")
