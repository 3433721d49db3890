"""Unmodelled: what is said of frames that no model places."""

from __future__ import annotations

from zstate.errors import InvalidInput
from zstate.model.robot import RobotModel
from zstate.wire.keys import full_name
from zstate.wire.messages import (
    POSE_BYTES,
    Edges,
    StaticTransforms,
    TransformSample,
    order_digest,
)


class Unmodelled:
    """Takes the edges of known models out of messages that name edges: the models say the same, better."""

    def __init__(self) -> None:
        self._links: dict[str, frozenset[str]] = {}
        self._rows: dict[tuple[str, Edges], list[int]] = {}

    def learn(self, robot: str, model: RobotModel) -> None:
        """The links of ``robot`` are known from now on."""
        self._links[robot] = frozenset(f"{robot}/{joint.child}" for joint in model.joints)
        self._rows.clear()

    def sample(self, robot: str, sample: TransformSample) -> TransformSample | None:
        """What is left of a sample that names its edges; None when nothing is."""
        said = sample.edges or ()
        rows = self._kept(robot, said)
        if len(rows) == len(said):
            return sample if said else None
        edges = tuple(said[row] for row in rows)
        head = (sample.stamp, sample.seq, sample.session, order_digest(edges))
        return TransformSample(*head, _picked(sample.poses, rows), edges) if rows else None

    def statics(self, robot: str, statics: StaticTransforms) -> StaticTransforms:
        """What is left of static edges."""
        rows = self._kept(robot, statics.edges)
        edges = tuple(statics.edges[row] for row in rows)
        return StaticTransforms(statics.session, edges, _picked(statics.poses, rows))

    def _kept(self, robot: str, edges: Edges) -> list[int]:
        rows = self._rows.get((robot, edges))
        if rows is None:
            rows = [row for row, (_, child) in enumerate(edges) if not self._is_link(robot, child)]
            self._rows[robot, edges] = rows
        return rows

    def _is_link(self, robot: str, child: str) -> bool:
        try:
            name = full_name(robot, child)
        except InvalidInput:
            return False  # refused, and counted, by whoever uses it
        return any(name in links for links in self._links.values())


def _picked(block: bytes, rows: list[int]) -> bytes:
    return b"".join(block[row * POSE_BYTES : (row + 1) * POSE_BYTES] for row in rows)
