"""EdgeFollower: ready transforms, into a buffer."""

from __future__ import annotations

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.frames import FrameInfo
from zstate.errors import InvalidInput
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
    """Follows ready transforms, without a model. ``live`` names the writers there are, by session."""

    def __init__(self, robot: str, buffer: TransformBuffer, tally: Tally, live: dict[int, str]) -> None:
        super().__init__(robot, buffer, tally)
        self._live = live
        self._edges: Edges = ()
        self._order = b""
        self._undescribed: set[str] = set()

    def describe(self, description: RobotDescription) -> None:
        self.heard = True
        if not self._keeps_our_time(description):
            return
        with self._lock:
            order = order_digest(description.moving_edges)
            if order == self._order:
                return
            try:
                edges = self._named(description.moving_edges)
            except InvalidInput as error:
                self._tally.refuse("robot description", str(error))
                return
            # What samples named in full stands for itself.
            self._withdraw({child for _, child in self._edges} - self._undescribed)
            self._edges, self._order = edges, order
            self._insert_early()

    def _named(self, edges: Edges) -> Edges:
        return tuple((full_name(self.robot, parent), full_name(self.robot, child)) for parent, child in edges)

    def _insert(self, sample: Sample) -> bool:
        assert isinstance(sample, TransformSample)
        edges = self._edges
        if sample.edges is not None:
            edges = self._named(sample.edges)
            self._take_over({child for _, child in edges} - self._undescribed)
        if not edges:
            return True  # a robot without moving parts
        poses = poses_from_block(sample.poses)
        return self._buffer.insert_many(edges, sample.stamp, poses, writer=self.writer)

    def _can_read(self, sample: Sample) -> bool:
        assert isinstance(sample, TransformSample)
        return sample.edges is not None or sample.order == self._order

    def _restart(self) -> None:
        self._withdraw(self._children())
        self._undescribed = set()

    def _withdraw(self, children: set[str]) -> None:
        for frame in self._placed(children):
            self._buffer.withdraw(frame.name)

    def _take_over(self, children: set[str]) -> None:
        """Edges that this writer has not said before: what one said of them that is gone is another epoch."""
        if children:
            others = self._others()
            for frame in self._buffer.frames(children):
                if frame.kind == "pose" and frame.writer not in others:
                    self._buffer.withdraw(frame.name)
            self._undescribed |= children

    def _may_begin_again(self) -> bool:
        others = self._others()
        return all(frame.writer not in others for frame in self._placed(self._children()))

    def _others(self) -> set[str]:
        """The names of the other writers there are."""
        # Ours may not be known yet; and what else our program writes goes by the same name.
        others = {name for session, name in self._live.copy().items() if session != self._session}
        return others - {self.writer or ""}

    def _children(self) -> set[str]:
        """The frames that we place."""
        return {child for _, child in self._edges} | self._undescribed

    def _placed(self, children: set[str]) -> list[FrameInfo]:
        """Their edges, without those that a model or a static writer places by now."""
        return [frame for frame in self._buffer.frames(children) if frame.kind == "pose"]

    def _writer_changed(self) -> None:
        pass  # each sample is inserted under its writer's name
