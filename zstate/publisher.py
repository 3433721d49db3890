"""StatePublisher: joint positions in, the state of a robot out on Zenoh."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.clock import Clock, SystemClock, check_stamp
from zstate.closing import Closing
from zstate.errors import Closed, InvalidInput
from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.edges import EdgeTable
from zstate.model.robot import RobotModel
from zstate.net.outlets import Outlets, StreamOutlet
from zstate.net.presence import writer_here
from zstate.net.session import Session
from zstate.net.status import StatusPublisher
from zstate.net.wires import wire_named
from zstate.rate import Rate, RateReport
from zstate.sources.source import JointSource
from zstate.status import Beat, PublisherStats, StreamStats
from zstate.wire.keys import MODEL_WRITER, Stream, check_robot, wire_name
from zstate.wire.layout import Layout
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    to_block,
)

STREAMS: tuple[Stream, ...] = ("joint_states", "tf", "tf_static", "robot_description")
"""What a robot's state consists of on the network."""

Positions = ArrayLike | Mapping[str, float | Sequence[float]]


class StatePublisher(Closing):
    """Publishes the state of one robot: each sample is the whole robot at one instant.

    Whoever joins, at any time, is given the model (``robot_description``) and its fixed edges
    (``tf_static``). Samples go out on ``joint_states``; the moving edges also on ``tf``, while somebody
    reads that. ``robot`` is its name on the network, the model's name unless given. ``streams`` names
    what this publisher writes, where another program writes the rest. ``program`` is who others see
    writing, the script's name unless given. On the native wire it says once a second how it does, to
    those who ask (``zstate.net.status``). A context manager; safe from any thread.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        robot: str | None = None,
        wires: Sequence[str] = ("native",),
        *,
        streams: Sequence[Stream] = STREAMS,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        self.model = model
        self.robot = check_robot(robot or model.name)
        self._clock: Clock = clock or SystemClock()
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._opened = ExitStack()
        self._edges = _MovingEdges(model, self.robot)
        self._session_id = secrets.randbits(32)
        self._seq = 0
        self._refused = 0
        self._last_refusal = ""
        self._rate: Rate | None = None
        self._wires = tuple(wires)
        self._joint_order = order_digest(model.joint_names)
        _check_streams(streams)
        layout = Layout(coordinate_names(model), velocity_slots(model), self._edges.names)
        writer = writer_here(self._session_id, program)
        with ExitStack() as opening:
            outlets = [
                opening.enter_context(Outlets(session, wire_named(wire), self.robot, writer, layout))
                for wire in wires
            ]
            self._outputs = [self._output(out, streams) for out in outlets]
            if "native" in wires and {"joint_states", "tf"}.intersection(streams):
                status = Beat(writer, lambda: self.stats).status
                opening.enter_context(StatusPublisher(session, self.robot, writer.identity, status))
            self._opened = opening.pop_all()

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
            self._session_id, model.urdf, model.digest, model.joint_names, self._edges.names
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
        return PublisherStats(self._seq, self._refused, self._last_refusal, streams, rate)

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
        where they are known. Raises InvalidInput for wrong counts, unknown or missing names, NaN and
        infinity, a floating joint without a unit quaternion, a stamp that a wire cannot say, and Closed;
        then nothing was sent.
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
        model = self.model
        numbers = (
            model.positions(positions) if isinstance(positions, Mapping) else model.check_positions(positions)
        )
        self._edges.check(numbers)
        rates = None if velocities is None else to_block(model.check_velocities(velocities))
        forces = None if efforts is None else to_block(model.check_efforts(efforts))
        stamp = self._clock.now() if stamp is None else check_stamp(stamp)
        with self._lock:
            if self._stop.is_set():
                raise Closed(f"the publisher of {self.robot!r} is closed")
            head = (stamp, self._seq, self._session_id)
            state = JointState(*head, self._joint_order, to_block(numbers), rates, forces)
            said = [one for output in self._outputs for one in output.said(state, numbers)]
            self._seq += 1
            for outlet, payload in said:
                outlet.put(payload)

    def run(self, source: JointSource, rate_hz: float = 100.0, *, seconds: float | None = None) -> RateReport:
        """Publish what ``source`` reads, at exactly ``rate_hz``, for ``seconds`` or until ``close()``.

        Each tick has an absolute deadline (see ``Rate`` for what becomes of late ones). A tick for
        which the source has nothing new sends nothing.
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

    def __init__(self, outlets: Outlets, streams: Sequence[Stream], edges: _MovingEdges) -> None:
        self._edges = edges
        said: tuple[Stream, ...] = ("joint_states", "tf")
        self.outlets: dict[Stream, StreamOutlet] = {
            stream: outlets.stream(stream) for stream in said if stream in streams
        }
        self._joints = self.outlets.get("joint_states")
        self._transforms = self.outlets.get("tf")

    def said(self, state: JointState, positions: NDArray[np.float64]) -> Iterator[tuple[StreamOutlet, bytes]]:
        """What this wire says of ``state``: the transforms only while somebody reads them."""
        if self._joints is not None:
            yield self._joints, self._joints.encode(state)
        if self._transforms is not None and self._transforms.has_readers:
            poses = to_block(self._edges.poses(positions))
            sample = TransformSample(state.stamp, state.seq, state.session, self._edges.order, poses)
            yield self._transforms, self._transforms.encode(sample)


def _check_streams(streams: Sequence[Stream]) -> None:
    for stream in streams:
        if stream not in STREAMS:
            raise InvalidInput(f"{stream!r} is not one of the streams {', '.join(map(repr, STREAMS))}")


class _MovingEdges:
    """The edges of a model as they are called on the network, moving and fixed apart."""

    def __init__(self, model: RobotModel, robot: str) -> None:
        self._table = EdgeTable(model)
        forms = self._table.forms
        names = [(wire_name(robot, form.parent), wire_name(robot, form.child)) for form in forms]
        fixed = [form.kind == "fixed" for form in forms]
        self._rows = np.flatnonzero(~np.array(fixed, dtype=np.bool_))
        self.names = tuple(names[row] for row in self._rows)
        self.order = order_digest(self.names)
        self._fixed_names = tuple(name for name, is_fixed in zip(names, fixed, strict=True) if is_fixed)
        self._fixed_poses = [form.origin for form in forms if form.kind == "fixed"]

    def check(self, positions: NDArray[np.float64]) -> None:
        """Raise InvalidInput for a floating joint's quaternion that is not of unit length."""
        self._table.normalised(positions)

    def poses(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """``parent_from_child`` of each of ``names``: (n, 7)."""
        return self._table.poses(positions).take(self._rows, axis=0)

    def statics(self, session: int) -> StaticTransforms:
        return StaticTransforms(session, self._fixed_names, to_block(self._fixed_poses))
