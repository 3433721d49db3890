"""EdgeFollower: ready transforms, into a buffer."""

from __future__ import annotations

from zstate.clock import SET_BACK_NS
from zstate.errors import InsertRefused, InvalidInput
from zstate.following.bounded import remember
from zstate.following.edge_claims import CONTESTED, Admitted, EdgeSource
from zstate.following.follower import Follower, SetBack
from zstate.following.ownership import FrameOwnership
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

    def __init__(self, robot: str, ownership: FrameOwnership, on_set_back: SetBack | None = None) -> None:
        super().__init__(robot, ownership, on_set_back)
        # By the digest of their edges, how far samples reach [ns]; here ``_newest`` is not used.
        self._newest_of: dict[bytes, int] = {}
        self._edges: Edges = ()
        self._order = b""
        self._described = EdgeSource(robot, "", is_model=True)
        self._undescribed = EdgeSource(robot, "")
        # The edges that samples name, in full; and which of them count.
        self._full_names: dict[Edges, Edges] = {}
        self._admitted: dict[Edges, Admitted] = {}
        self._last: tuple[Edges, Admitted] = (), Admitted()
        self._version = -1

    def describe(self, description: RobotDescription) -> None:
        self.heard = True
        self._learn_domain(description)
        with self._lock:
            order = order_digest(description.moving_edges)
            if order == self._order:
                return
            try:
                edges = self._named(description.moving_edges)
            except InvalidInput as error:
                self._tally.refuse("robot description", str(error))
                return
            self._release(self._described)
            self._edges, self._order = edges, order
            self._buffer.domain.place(self.robot, (child for _, child in edges))
            self._insert_early()

    def _named(self, edges: Edges) -> Edges:
        return tuple((full_name(self.robot, parent), full_name(self.robot, child)) for parent, child in edges)

    def _insert(self, sample: Sample) -> bool:
        assert isinstance(sample, TransformSample)
        edges, source = self._edges, self._described
        if sample.edges is not None:
            edges, source = self._edges_named_by(sample.edges), self._undescribed
        if not edges:
            return True  # a robot without moving parts
        admitted = self._admit(source, edges)
        try:
            return self._insert_admitted(sample, edges, admitted)
        except InsertRefused as error:
            if error is admitted.refusal or error.reason not in CONTESTED:
                raise
        # Something in the buffer stands against them that was not weighed yet.
        self._ownership.weigh()
        return self._insert_admitted(sample, edges, self._admit(source, edges))

    def _edges_named_by(self, said: Edges) -> Edges:
        edges = self._full_names.get(said)
        if edges is None:
            edges = self._named(said)
            remember(self._full_names, said, edges)
            new = {child for _, child in edges} - {child for _, child in self._undescribed.claims}
            self._ownership.take_over(self._undescribed, new)
            self._buffer.domain.place(self.robot, new)
        return edges

    def _admit(self, source: EdgeSource, edges: Edges) -> Admitted:
        """Which of ``edges`` count, asked anew when that may have changed."""
        if self._version == self._ownership.version:
            if edges is self._last[0]:
                return self._last[1]
            known = self._admitted.get(edges)
            if known is not None:
                self._last = edges, known
                return known
        source.name, source.session = self.writer or "", self._session or 0
        admitted = self._ownership.admit(source, edges)
        if self._version != self._ownership.version:
            self._admitted.clear()
            self._version = self._ownership.version
        remember(self._admitted, edges, admitted)
        self._last = edges, admitted
        return admitted

    def _insert_admitted(self, sample: TransformSample, edges: Edges, admitted: Admitted) -> bool:
        poses = poses_from_block(sample.poses)
        if admitted.refusal is None:
            return self._buffer.insert_many(edges, sample.stamp, poses, writer=self.writer)
        if not admitted.rows:
            raise admitted.refusal.with_traceback(None)  # it is raised for each sample
        self._refuse(admitted.refusal)
        chosen = [edges[row] for row in admitted.rows]
        return self._buffer.insert_many(chosen, sample.stamp, poses[list(admitted.rows)], writer=self.writer)

    def _can_read(self, sample: Sample) -> bool:
        assert isinstance(sample, TransformSample)
        return sample.edges is not None or sample.order == self._order

    def _reach(self, sample: Sample) -> bool:
        # One writer may stamp one edge later than another, as a camera that took time to look.
        known = self._newest_of.get(sample.order)
        if known is None:
            remember(self._newest_of, sample.order, sample.stamp)
            return False
        if sample.stamp >= known:
            self._newest_of[sample.order] = sample.stamp
            return False
        return sample.stamp < known - SET_BACK_NS

    def _reached(self, sample: Sample) -> int | None:
        return self._newest_of.get(sample.order)

    def _restart(self) -> None:
        self._newest_of.clear()
        self._release(self._described)
        self._release(self._undescribed)

    def _release(self, source: EdgeSource) -> None:
        self._ownership.release(source)
        self._full_names.clear()
        self._admitted.clear()
        self._last = (), Admitted()

    def _may_begin_again(self) -> bool:
        return not any(map(self._ownership.others_move, (self._described, self._undescribed)))

    def _writer_changed(self) -> None:
        pass  # each sample is inserted under its writer's name
