"""Publisher of some joints of a robot: the program of one of its drivers, such as that of a gripper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.clock import Clock, check_stamp
from zstate.errors import SecondWriter
from zstate.model.joint_limits import JointLimits
from zstate.model.robot import RobotModel, coordinate_names, velocity_columns_by_position
from zstate.net.edge_monitor import EdgeMonitor
from zstate.net.edge_ownership import claim_edges
from zstate.net.session import Session
from zstate.nodes.publisher import Positions, positions_block
from zstate.nodes.publisher_status import LimitWatch
from zstate.nodes.sample_publisher import SamplePublisher
from zstate.rate import RateReport
from zstate.sources.joint_source import JointReading, JointSource
from zstate.wire.identity import Announcement
from zstate.wire.messages import JointState, order_digest, to_block


class PartialStatePublisher(SamplePublisher):
    """Publishes the joint states of some ``joints`` of a robot; other drivers publish the rest.

    Listeners interpolate each joint between the samples of its own driver;
    ``zstate publish`` and ``JointStateListener`` merge the drivers' newest values into whole readings. Model,
    fixed edges and transforms come from ``zstate publish``, or from a ``StatePublisher`` with those streams.

    - ``model``: that of the whole robot.
    - ``joints``: those that this publisher has, by name; their order is that of its samples.
    - ``robot``: the name on the network; default: the model's name.
    - ``wires``: what it publishes on, "native", "ros2" with options, or several.
    - ``writer``: the name of this part of the robot; default: the program, its process id and a random
      number.
    - ``clock``: gives the stamps of samples without one; default: the system's.
    - ``program``: the writer's name for others; default: the script's name.
    - ``cache_s``: the last seconds of samples that joining listeners of the native wire receive; 0: only the
      newest sample.

    On the native wire each joint has one writer: SecondWriter, which names both, is raised if another active
    writer publishes one of the joints, or all joints of the robot, or has the same name. If two open at once,
    ``publish`` of the later one may raise it, and closes that publisher. In ROS a part is a JointState with
    fewer joints on /joint_states, where every node may write.

    On the native wire the status is published once a second while it has a reader. A context manager; safe
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
        super().__init__(session, robot or model.name, wires, clock, program)
        out = self._out
        out.title = f"the publisher of joints of {self.robot!r}"
        self.model = model.part(joints)
        """The part of the model that this publisher moves; its ``joint_names`` are the joints in order."""
        self.writer = out.edge_writer_name(writer)
        self._names = coordinate_names(self.model)
        self._order = order_digest(self._names)
        self._slots = np.array(velocity_columns_by_position(self.model), dtype=np.intp)
        limits = JointLimits(self.model)
        self._limits = LimitWatch(limits, self.robot) if limits else None
        announced = out.announcement("partial_joint_states", self.writer)
        with out.opening():
            out.own([announced])
            # Its queryable is also how writers that claim joints at the same time find each other.
            out.open_cache(cache_s, 3 * self.model.position_count)
            out.serve_history("partial_joint_states", self.writer)
            if out.is_native:
                self._own_joints(announced)
            for name, wire_writer in out.open_wires().items():
                out.open_stream(name, wire_writer.wire.partial_joint_states, self.writer)
            out.report_status(lambda: self.stats)

    def __repr__(self) -> str:
        closed = ", closed" if self._out.is_closed else ""
        joints = ", ".join(self.model.joint_names)
        return f"<PartialStatePublisher of {joints} of {self.robot!r}: {self._sent} samples{closed}>"

    def _own_joints(self, announced: Announcement) -> None:
        """Become the one writer of the joints on the native wire. Raises SecondWriter."""
        session, opened = self._out.session, self._out.opened
        movers = {
            joint.child: (f"{self.robot}/{joint.parent}", f"{self.robot}/{joint.child}")
            for joint in self.model.joints
        }
        edges = list(movers.values())
        coordinates = {
            name: movers[joint.child]
            for joint in self.model.driven_joints
            for name in coordinate_names(self.model.part([joint.name]))
        }
        monitor = opened.enter_context(EdgeMonitor(session, announced, joints=coordinates))

        def check() -> None:
            try:
                monitor.check()
            except SecondWriter as error:
                raise self._second_writer(error) from None

        try:
            opened.enter_context(claim_edges(session, announced, edges))
        except SecondWriter as error:
            raise self._second_writer(error) from None
        monitor.add(edges)
        self._out.checks.append(check)

    def _second_writer(self, error: SecondWriter) -> SecondWriter:
        """``error`` about an edge, with the joint that moves it."""
        assert error.edge is not None
        child = error.edge[1].removeprefix(f"{self.robot}/")
        moved = next(joint for joint in self.model.joints if joint.child == child)
        return SecondWriter(
            f"{str(error.first)!r} already publishes the joint {self.model.mimic_of(moved).joint!r} of "
            f"{self.robot!r}; refused: {str(self._out.identity)!r}; one joint has one writer: stop the "
            "first, or leave that joint to it",
            robot=self.robot,
            stream="partial_joint_states",
            first=error.first,
            edge=error.edge,
        )

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
        with self._refusals:
            block = positions_block(self.model, positions)
            rates = None if velocities is None else self._spread(self.model.check_velocities(velocities))
            forces = None if efforts is None else self._spread(self.model.check_efforts(efforts))
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            out = self._out
            with out.lock:
                out.check()
                head = (stamp, out.seq, out.session_id, self._order)
                out.send(JointState(*head, block, rates, forces, self._names))
        if self._limits is not None:
            self._limits.add(stamp, block)

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
