"""Publisher of some joints of a robot: the program of one of its drivers, such as that of a gripper."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.clock import Clock, check_stamp
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.model.joint_limits import JointLimits
from zstate.model.robot import RobotModel, coordinate_names, velocity_columns_by_position
from zstate.net.ownership import WriterClaim, claim_edges
from zstate.net.presence import local_writer
from zstate.net.sample_history import SampleCache, serve_history
from zstate.net.session import Session
from zstate.net.status import StatusPublisher
from zstate.net.writer import WireWriter
from zstate.nodes.publisher import Positions, positions_block
from zstate.nodes.publisher_status import LimitWatch, StatusReporter
from zstate.nodes.sample_publisher import SamplePublisher
from zstate.nodes.static_publisher import edge_writer_name
from zstate.rate import RateReport
from zstate.sources.joint_source import JointReading, JointSource
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.native import encode
from zstate.wire.registry import get_wire


class PartialStatePublisher(SamplePublisher):
    """Publishes the joint states of some ``joints`` of a robot; other drivers publish the rest.

    ``model`` is the whole robot's. Listeners interpolate each joint between the samples of its own driver;
    ``zstate publish`` and ``JointStateListener`` merge the drivers' newest values into whole readings. Model,
    fixed edges and transforms come from ``zstate publish``, or from a ``StatePublisher`` with those streams.
    ``writer`` is the name of this part of the robot; default: the program, its process id and a random
    number. ``program`` is the script's name by default.

    On the native wire each joint has one writer: SecondWriter, which names both, is raised if another active
    writer publishes one of the joints, or all joints of the robot, or has the same name. If two open at once,
    ``publish`` of the later one may raise it, and closes that publisher. In ROS a part is a JointState with
    fewer joints on /joint_states, where every node may write.

    On the native wire the last ``cache_s`` seconds of samples are cached for joining listeners (0: only the
    newest sample), and the status is published once a second while it has a reader. A context manager; safe
    from any thread.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        joints: Sequence[str],
        robot: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        writer: str | None = None,
        clock: Clock | None = None,
        program: str = "",
        cache_s: float = 2.0,
    ) -> None:
        identity = local_writer(secrets.randbits(32), program)
        super().__init__(robot or model.name, wires, clock, identity.session)
        self.model = model.part(joints)
        """The part of the model that this publisher moves; its ``joint_names`` are the joints in order."""
        self.writer = edge_writer_name(writer, identity)
        self._names = coordinate_names(self.model)
        self._order = order_digest(self._names)
        self._slots = np.array(velocity_columns_by_position(self.model), dtype=np.intp)
        limits = JointLimits(self.model)
        self._limits = LimitWatch(limits, self.robot) if limits else None
        self._claim: WriterClaim | None = None
        self._cache: SampleCache | None = None
        with ExitStack() as opening:
            if "native" in self._wires:
                self._own_joints(session, identity, cache_s, opening)
            for name in self._wires:
                wire = get_wire(name)
                wire_writer = opening.enter_context(WireWriter(session, wire, self.robot, identity))
                stream = wire.partial_joint_states
                self._writers[name, stream] = wire_writer.open_stream(stream, self.writer)
            if self._cache is not None:
                status = StatusReporter(identity, lambda: self.stats).status
                opening.enter_context(StatusPublisher(session, self.robot, identity.identity, status))
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        closed = ", closed" if self._stop.is_set() else ""
        joints = ", ".join(self.model.joint_names)
        return f"<PartialStatePublisher of {joints} of {self.robot!r}: {self._seq} samples{closed}>"

    def _own_joints(self, session: Session, identity: WriterId, cache_s: float, opening: ExitStack) -> None:
        """Become the one writer of the joints on the native wire, until ``opening`` is closed."""
        announced = Announcement(self.robot, "partial_joint_states", identity, self.writer)
        self._claim = opening.enter_context(WriterClaim(session, [announced]))
        self._serve_clock(session, identity, opening)
        # Its queryable is also how writers that claim joints at the same time find each other.
        numbers = 3 * self.model.position_count
        self._cache = self._new_cache(cache_s, numbers)
        history = serve_history(session, self.robot, "partial_joint_states", self._cache, writer=self.writer)
        opening.enter_context(history)
        movers = {f"{self.robot}/{joint.child}": joint for joint in self.model.joints}
        edges = [(f"{self.robot}/{joint.parent}", child) for child, joint in movers.items()]
        try:
            opening.enter_context(claim_edges(session, announced, edges))
        except SecondWriter as error:
            assert error.edge is not None
            joint = self.model.mimic_of(movers[error.edge[1]]).joint
            raise SecondWriter(
                f"{str(error.first)!r} already publishes the joint {joint!r} of {self.robot!r}; refused: "
                f"{str(identity)!r}; one joint has one writer: stop the first, or leave that joint to it",
                robot=self.robot,
                stream="partial_joint_states",
                first=error.first,
                edge=error.edge,
            ) from None

    def publish(
        self,
        positions: Positions,
        velocities: ArrayLike | None = None,
        efforts: ArrayLike | None = None,
        stamp: int | None = None,
    ) -> None:
        """Publish one sample: these joints at ``stamp`` [ns]; default: now.

        ``positions`` [rad] or [m] are in the order of the ``joints``, or a mapping from all their names;
        ``velocities`` per second and ``efforts`` [Nm] or [N], if known, are in the same order. Positions
        outside joint limits are published, counted in ``stats``, and logged once. Raises InvalidInput as
        ``StatePublisher.publish``; SecondWriter; and Closed. If it raises, nothing was sent.
        """
        try:
            block = positions_block(self.model, positions)
            rates = None if velocities is None else self._spread(self.model.check_velocities(velocities))
            forces = None if efforts is None else self._spread(self.model.check_efforts(efforts))
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            with self._lock:
                if self._stop.is_set():
                    raise Closed(f"the publisher of joints of {self.robot!r} is closed")
                if self._claim is not None:
                    self._claim.check()
                head = (stamp, self._seq, self._session_id, self._order)
                state = JointState(*head, block, rates, forces, self._names)
                # Encode for all wires before sending on any: a wire may be unable to represent the stamp.
                payloads = {place: writer.encoder.encode(state) for place, writer in self._writers.items()}
                native = payloads.get(("native", "partial_joint_states")) or encode(state)
                self._seq += 1
                if self._cache is not None:
                    # Before sending: a reader that misses this sample can then request it as history.
                    self._cache.append(stamp, state.seq, native)
                for place, writer in self._writers.items():
                    writer.write(payloads[place])
            if self._limits is not None:
                self._limits.add(stamp, native)
        except InvalidInput as error:
            self._count_refusal(error)
            raise
        except SecondWriter:
            with self._lock:
                self._opened.close()
            raise

    def _spread(self, numbers: NDArray[np.float64]) -> bytes:
        """One number for each coordinate: a floating joint has fewer velocities than positions."""
        if len(numbers) == len(self._names):
            return to_block(numbers)
        spread = np.full(len(self._names), np.nan)
        spread[self._slots] = numbers
        return to_block(spread)

    def run(self, source: JointSource, rate_hz: float = 100.0, *, seconds: float | None = None) -> RateReport:
        """Publish the readings of ``source``, of these joints, as ``StatePublisher.run``."""

        def publish(reading: JointReading, now: int) -> None:
            stamp = now if reading.stamp is None else reading.stamp
            self.publish(reading.positions, reading.velocities, reading.efforts, stamp)

        return self._publish_at(rate_hz, seconds, source.read, publish)
