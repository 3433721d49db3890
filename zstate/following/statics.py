"""StaticFollower: the static edges of one writer, as they come and go."""

from __future__ import annotations

from numpy.typing import ArrayLike

from zstate.errors import InvalidInput
from zstate.following.edge_claims import EdgeSource
from zstate.following.ownership import FrameOwnership
from zstate.transform import Transform
from zstate.wire.keys import EdgeNames, full_name
from zstate.wire.messages import StaticTransforms, poses_from_block


class StaticFollower:
    """Holds in a buffer what one writer of static edges says now: no edge more, none less.

    ``children`` are the frames that it places, or would if they were not refused. ``is_model`` says that
    the edges are those of the robot's model.
    """

    def __init__(self, robot: str, writer: str, ownership: FrameOwnership, *, is_model: bool = False) -> None:
        self.children: frozenset[str] = frozenset()
        self._ownership = ownership
        self._source = EdgeSource(robot, writer, is_model=is_model)

    def name_writer(self, writer: str) -> None:
        """Who the writer is, if that is learned later than what it says."""
        self._ownership.rename(self._source, writer)

    def replace(self, statics: StaticTransforms) -> None:
        """Take these edges; withdraw those that are named no more, or on another parent."""
        self._source.session = statics.session
        edges = self._edges(statics)
        self.children = frozenset(child for _, child in edges)
        self._ownership.set_statics(self._source, edges)

    def add(self, statics: StaticTransforms) -> None:
        """Take these edges besides those that were named before, as ROS does: nothing is withdrawn there."""
        self._source.session = statics.session
        self._ownership.set_statics(self._source, self._edges(statics), adds=True)

    def withdraw(self) -> None:
        """Take all of this writer's edges away."""
        self.children = frozenset()
        self._ownership.release(self._source)

    def _edges(self, statics: StaticTransforms) -> dict[EdgeNames, Transform]:
        edges: dict[EdgeNames, Transform] = {}
        for (parent, child), pose in zip(statics.edges, poses_from_block(statics.poses), strict=True):
            transform = self._transform(parent, child, pose)
            if transform is not None:
                edges[transform.target, transform.source] = transform
        return edges

    def _transform(self, parent: str, child: str, pose: ArrayLike) -> Transform | None:
        robot = self._source.robot
        try:
            names = full_name(robot, parent), full_name(robot, child)
        except InvalidInput as error:
            self._refuse("frame name", error)
            return None
        try:
            return Transform.from_pose7(*names, pose)
        except InvalidInput as error:
            self._refuse("bad numbers", error)
            return None

    def _refuse(self, reason: str, error: InvalidInput) -> None:
        self._ownership.tally.of(self._source.robot).refuse(
            reason, f"static edge of {self._source.name!r}: {error}"
        )
