"""EdgeFollower: ready transforms, into a buffer."""

from __future__ import annotations

from zstate.buffer.buffer import TransformBuffer
from zstate.following.follower import Follower
from zstate.following.tally import Tally
from zstate.wire.keys import full_name
from zstate.wire.messages import (
    Edges,
    RobotDescription,
    Sample,
    TransformSample,
    order_digest,
    poses_from_block,
)


class EdgeFollower(Follower):
    """Follows ready transforms, without a model."""

    def __init__(self, robot: str, buffer: TransformBuffer, tally: Tally) -> None:
        super().__init__(robot, buffer, tally)
        self._edges: Edges = ()
        self._order = b""

    def describe(self, description: RobotDescription) -> None:
        self.heard = True
        with self._lock:
            order = order_digest(description.moving_edges)
            if order == self._order:
                return
            self._restart()
            self._edges = self._named(description.moving_edges)
            self._order = order
            self._insert_early()

    def _named(self, edges: Edges) -> Edges:
        return tuple((full_name(self.robot, parent), full_name(self.robot, child)) for parent, child in edges)

    def _insert(self, sample: Sample) -> bool:
        assert isinstance(sample, TransformSample)
        edges = self._edges if sample.edges is None else self._named(sample.edges)
        poses = poses_from_block(sample.poses)
        return self._buffer.insert_many(edges, sample.stamp, poses, writer=self.writer)

    def _can_read(self, sample: Sample) -> bool:
        assert isinstance(sample, TransformSample)
        return sample.edges is not None or sample.order == self._order

    def _restart(self) -> None:
        for _, child in self._edges:
            self._buffer.withdraw(child)

    def _writer_changed(self) -> None:
        pass  # each sample is inserted under its writer's name
