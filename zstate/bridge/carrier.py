"""Carrier: one robot, one way."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Literal, NamedTuple

from zstate.bridge.statics import StaticCarrier
from zstate.closing import Closing
from zstate.errors import Closed, InvalidInput, ZStateError
from zstate.ingest.counters import Counters
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.sources.descriptions import Descriptions
from zstate.sources.source import JointReading
from zstate.sources.subscribed import SubscribedSource

PROGRAM = "zstate_bridge"
"""As whom a bridge writes, on both wires: by this name bridges know what was carried already."""

Way = Literal["native to ROS", "ROS to native"]


class Side(NamedTuple):
    """One of two networks: a place on it, what is spoken there, and where that is carried."""

    session: Session
    wire: str
    way: Way


class Carrier(Closing):
    """Writes on ``target`` what others write of ``robot`` on ``source``, from its first model on.

    Every joint state keeps its stamp and its numbers; model and static edges are there for late
    joiners, too. ``on_begin()`` is called with each model. What ``target`` cannot say is counted in
    ``refused``, and the first of each kind is logged.
    """

    def __init__(self, robot: str, source: Side, target: Side, on_begin: Callable[[], object]) -> None:
        self.robot = robot
        self.source = source
        self.target = target
        self.has_begun = False
        self._on_begin = on_begin
        self._counters = Counters()
        self._lock = threading.Lock()
        self._closed = False
        self._carrying = ExitStack()
        self._descriptions = Descriptions(source.session, robot, self._carry, source.wire)

    @property
    def refused(self) -> dict[str, int]:
        """How many joint states, static edges and models could not be carried."""
        return self._counters.stats().refused

    def _carry(self, robot: str, model: RobotModel) -> None:
        with self._lock:
            self._carrying.close()
            if self._closed:
                return
            try:
                self._begin(model)
            except ZStateError as error:
                self._counters.count_refusal("model", f"{robot!r} is not carried: {error}")
                return
        self.has_begun = True
        self._on_begin()

    def _begin(self, model: RobotModel) -> None:
        robot, source, target = self.robot, self.source, self.target
        with ExitStack() as opening:
            publisher = opening.enter_context(
                # Beside other bridges, too; which way a robot is carried was decided before.
                StatePublisher(target.session, model, robot, (target.wire,), program=PROGRAM, takeover=True)
            )
            statics = opening.enter_context(
                StaticPublisher(target.session, robot, wires=(target.wire,), program=PROGRAM, takeover=True)
            )
            opening.enter_context(StaticCarrier(source.session, model, statics, self._counters, source.wire))
            readings = opening.enter_context(SubscribedSource(source.session, model, robot, wire=source.wire))
            self._carrying = opening.pop_all()
        threading.Thread(
            target=self._publish, args=(readings, publisher), name=f"zstate bridge {robot}", daemon=True
        ).start()

    def _publish(self, readings: SubscribedSource, publisher: StatePublisher) -> None:
        with suppress(Closed):
            for reading in readings:
                self._publish_one(reading, publisher)

    def _publish_one(self, reading: JointReading, publisher: StatePublisher) -> None:
        try:
            publisher.publish(reading.positions, reading.velocities, reading.efforts, reading.stamp)
        except InvalidInput as error:
            self._counters.count_refusal("joint state", f"{self.robot!r}: {error}")

    def close(self) -> None:
        """Carry no more, and withdraw what was written. A second call does nothing."""
        self._descriptions.close()
        with self._lock:
            self._closed = True
            self._carrying.close()
