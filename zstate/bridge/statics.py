"""StaticCarrier: the static edges around a robot, from one wire to another."""

from __future__ import annotations

from contextlib import suppress

from zstate.buffer.buffer import TransformBuffer
from zstate.closing import Closing
from zstate.errors import Closed, InvalidInput, MessageError
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.static_transforms import StaticTransformIngest
from zstate.model.robot import RobotModel
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.net.wires import wire_named
from zstate.nodes.static_publisher import StaticPublisher
from zstate.transform import Transform
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import StaticTransforms, poses_from_block, to_block
from zstate.wire.protocol import SerializedSample


class StaticCarrier(Closing):
    """Publishes with ``publisher`` the static edges of its robot that ``model`` does not place.

    Where a key tells whose edges are on it, they are also withdrawn with it. Where all robots share
    one, those are taken that place a frame of this robot.
    """

    def __init__(
        self, session: Session, model: RobotModel, publisher: StaticPublisher, counters: Counters, wire: str
    ) -> None:
        self._robot = publisher.robot
        self._counters = counters
        self._buffer = _PublishedBuffer(publisher)
        self._buffer.add_robot(model, self._robot)
        self._ownership = FrameOwnership(self._buffer, counters, is_shared=True)
        self._ingests: dict[str, StaticTransformIngest] = {}
        self._wire = wire_named(wire)
        key = self._wire.expression(self._robot, "tf_static")
        self._subscriber = LatchedSubscriber(session, key, self._take)

    def close(self) -> None:
        """Follow the edges no more; those that were published stay. A second call does nothing."""
        self._subscriber.close()

    def _take(self, arrival: SerializedSample) -> None:
        try:
            writer = self._wire.statics_writer(arrival.key)
        except InvalidInput as error:
            self._counters.count_refusal("foreign", str(error))
            return
        if writer == MODEL_WRITER:
            return
        make = StaticTransformIngest(self._robot, writer or self._wire.name, self._ownership)
        ingest = self._ingests.setdefault(arrival.key, make)
        try:
            messages = self._wire.decode("tf_static", arrival, self._robot) if arrival.payload else ()
        except MessageError as error:
            self._counters.count_refusal(error.reason, f"{arrival.key}: {error}")
            return
        # The publisher may have gone with its session.
        with suppress(Closed):
            if not arrival.payload:
                ingest.withdraw()
            for message in messages:
                assert isinstance(message, StaticTransforms)
                ingest.add(self._ours(message)) if writer is None else ingest.replace(message)

    def _ours(self, message: StaticTransforms) -> StaticTransforms:
        is_ours = [child.partition("/")[0] == self._robot or "/" not in child for _, child in message.edges]
        edges = tuple(edge for edge, ours in zip(message.edges, is_ours, strict=True) if ours)
        return StaticTransforms(message.session, edges, to_block(poses_from_block(message.poses)[is_ours]))


class _PublishedBuffer(TransformBuffer):
    """A buffer whose static edges are published."""

    def __init__(self, publisher: StaticPublisher) -> None:
        super().__init__()
        self._publisher = publisher

    def insert_static(self, transform: Transform, *, writer: str | None = None) -> None:
        super().insert_static(transform, writer=writer)
        self._publisher.set(transform)

    def withdraw(self, child: str) -> None:
        super().withdraw(child)
        self._publisher.withdraw(child)
