"""Filter of the edges that known models define, in transforms that others published."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from zstate.errors import InvalidInput
from zstate.model.robot import RobotModel
from zstate.wire.keys import full_name
from zstate.wire.messages import (
    POSE_BYTES,
    Edges,
    StaticTransforms,
    TransformSample,
    WriterTransforms,
    covariances_of,
    order_digest,
    poses_from_block,
    to_block,
)


class ModelEdgeFilter:
    """Removes the edges of known models from messages that name edges; the models define them exactly."""

    def __init__(self) -> None:
        self._links: dict[str, frozenset[str]] = {}
        self._rows: dict[tuple[str, Edges], list[int]] = {}

    def set_model(self, robot: str, model: RobotModel) -> None:
        """Remove the links of ``robot`` from now on."""
        self._links[robot] = frozenset(f"{robot}/{joint.child}" for joint in model.joints)
        self._rows.clear()

    def filter_sample(self, robot: str, sample: TransformSample) -> TransformSample | None:
        """The rest of a sample that names its edges; None if nothing is left."""
        named = sample.edges or ()
        rows = self._kept(robot, named)
        if len(rows) == len(named):
            return sample if named else None
        return select_edges(sample, named, rows) if rows else None

    def filter_statics(self, robot: str, statics: StaticTransforms) -> StaticTransforms:
        """The rest of a message of static edges."""
        rows = self._kept(robot, statics.edges)
        edges = tuple(statics.edges[row] for row in rows)
        return StaticTransforms(statics.session, edges, _rows_of(statics.poses, rows))

    def removes_all(self, robot: str, edges: Edges) -> bool:
        """Whether known models define all of ``edges``, of which nothing is left then."""
        return not self._kept(robot, edges)

    def _kept(self, robot: str, edges: Edges) -> list[int]:
        rows = self._rows.get((robot, edges))
        if rows is None:
            rows = list[int]()
            for row, (_, child) in enumerate(edges):
                name = ""  # an invalid name is refused and counted when it is inserted
                with suppress(InvalidInput):
                    name = full_name(robot, child)
                if not any(name in links for links in self._links.values()):
                    rows.append(row)
            self._rows[robot, edges] = rows
        return rows


def _rows_of(block: bytes, rows: list[int]) -> bytes:
    return b"".join(block[row * POSE_BYTES : (row + 1) * POSE_BYTES] for row in rows)


def select_edges(sample: TransformSample, edges: Edges, rows: Sequence[int]) -> TransformSample:
    """The ``rows`` of a sample of ``edges``."""
    chosen = tuple(edges[row] for row in rows)
    head = (sample.stamp, sample.seq, sample.session, order_digest(chosen))
    poses, covariances = poses_from_block(sample.poses), covariances_of(sample)
    if covariances is None:
        return TransformSample(*head, to_block(poses[rows]), chosen)
    return WriterTransforms(*head, to_block(poses[rows]), chosen, to_block(covariances[rows]))
