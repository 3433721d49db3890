"""Ingest of the static transforms of one writer."""

from __future__ import annotations

from zstate.errors import InvalidInput
from zstate.ingest.edge_claims import EdgeSource
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.transform import Transform
from zstate.wire.keys import EdgeNames, full_name
from zstate.wire.messages import StaticTransforms, poses_from_block


class StaticTransformIngest:
    """Keeps exactly the static edges that one writer publishes now in a buffer.

    ``children`` are the child frames of these edges, refused ones included. ``is_model`` marks the edges of
    the robot's model.
    """

    def __init__(self, robot: str, writer: str, ownership: FrameOwnership, *, is_model: bool = False) -> None:
        self.children: frozenset[str] = frozenset()
        self._ownership = ownership
        self._source = EdgeSource(robot, writer, is_model=is_model)

    def name_writer(self, writer: str) -> None:
        """Set the printed name of the writer, if it is announced later than its edges."""
        self._ownership.rename(self._source, writer)

    def replace(self, statics: StaticTransforms) -> None:
        """Insert these edges; withdraw earlier ones that are missing or have another parent."""
        self._source.session = statics.session
        edges = self._edges(statics)
        self.children = frozenset(child for _, child in edges)
        self._ownership.set_statics(self._source, edges)

    def add(self, statics: StaticTransforms) -> None:
        """Insert these edges and keep the earlier ones: in ROS no static edge is ever withdrawn."""
        self._source.session = statics.session
        self._ownership.set_statics(self._source, self._edges(statics), adds=True)

    def withdraw(self) -> None:
        """Withdraw all of this writer's edges."""
        self.children = frozenset()
        self._ownership.release(self._source)

    def _edges(self, statics: StaticTransforms) -> dict[EdgeNames, Transform]:
        edges: dict[EdgeNames, Transform] = {}
        robot = self._source.robot
        for names, pose in zip(statics.edges, poses_from_block(statics.poses), strict=True):
            reason = "frame name"
            try:
                parent, child = (full_name(robot, frame) for frame in names)
                reason = "bad numbers"
                edges[parent, child] = Transform.from_pose7(parent, child, pose)
            except InvalidInput as error:
                text = f"static edge of {self._source.name!r}: {error}"
                self._ownership.counters.for_robot(robot).count_refusal(reason, text)
        return edges
