"""Gathered: static edges that add up, as those of a ROS node do."""

from __future__ import annotations

from zstate.wire.messages import POSE_BYTES, StaticTransforms


class Gathered:
    """All static edges that one session has said so far; of each child the last."""

    def __init__(self, session: int) -> None:
        self._session = session
        self._edges: dict[str, tuple[str, bytes]] = {}

    def with_edges(self, statics: StaticTransforms) -> StaticTransforms:
        """Everything, these edges included."""
        for row, (parent, child) in enumerate(statics.edges):
            self._edges[child] = parent, statics.poses[row * POSE_BYTES : (row + 1) * POSE_BYTES]
        edges = tuple((parent, child) for child, (parent, _) in self._edges.items())
        return StaticTransforms(self._session, edges, b"".join(pose for _, pose in self._edges.values()))
