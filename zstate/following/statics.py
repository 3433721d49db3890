"""StaticFollower: the static edges of one writer, as they come and go."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InsertRefused, InvalidInput
from zstate.following.tally import Tally
from zstate.transform import Transform
from zstate.wire.keys import full_name
from zstate.wire.messages import StaticTransforms, poses_from_block

# A static edge that is this near to a model's [m, or the sine of a turn] was computed from the same URDF.
_SAME = 1e-6

_CONFLICTS = ("second writer", "second parent")


def are_same(one: Transform, other: Transform) -> bool:
    """Whether two poses of one frame are the same but for how they were computed."""
    return bool(np.allclose(one.matrix, other.matrix, rtol=0.0, atol=_SAME))


class StaticFollower:
    """Holds in a buffer what one writer of static edges says now: no edge more, none less.

    ``children`` are the frames that it places, or would if they were not refused. Where another one
    keeps it from placing a child, ``on_conflict(robot, writer, child, text)`` is called.
    """

    def __init__(
        self,
        robot: str,
        writer: str,
        buffer: TransformBuffer,
        tally: Tally,
        on_conflict: Callable[[str, str, str, str], None] | None = None,
    ) -> None:
        self._robot = robot
        self._writer = writer
        self._buffer = buffer
        self._tally = tally
        self._on_conflict = on_conflict
        self._edges: dict[str, Transform] = {}
        self.children: frozenset[str] = frozenset()

    def name_writer(self, writer: str) -> None:
        """Who the writer is, if that is learned later than what it says."""
        ours = self._still_ours(self._edges)
        self._writer = writer
        for child in ours:
            self._buffer.insert_static(self._edges[child], writer=writer)

    def replace(self, statics: StaticTransforms) -> None:
        """Take these edges; withdraw those that are named no more, or on another parent."""
        named = [self._named(*edge) for edge in statics.edges]
        wanted = {edge[1]: edge[0] for edge in named if edge is not None}
        self.children = frozenset(wanted)
        self._withdraw([child for child, edge in self._edges.items() if wanted.get(child) != edge.target])
        for edge, pose in zip(named, poses_from_block(statics.poses), strict=True):
            if edge is not None:
                self._insert(*edge, pose)

    def add(self, statics: StaticTransforms, departed: Iterable[StaticFollower] = ()) -> None:
        """Take these edges besides those that were named before, as ROS does: nothing is withdrawn there.

        A child that a writer of ``departed`` placed on another parent may be placed anew.
        """
        for names, pose in zip(statics.edges, poses_from_block(statics.poses), strict=True):
            edge = self._named(*names)
            if edge is not None:
                for writer in (self, *departed):
                    writer._give_way(*edge)
                self._insert(*edge, pose, beside_model=True)

    def _give_way(self, parent: str, child: str) -> None:
        known = self._edges.get(child)
        if known is not None and known.target != parent:
            self._withdraw([child])

    def withdraw(self) -> None:
        """Take all of this writer's edges away."""
        self.children = frozenset()
        self._withdraw(list(self._edges))

    def _named(self, parent: str, child: str) -> tuple[str, str] | None:
        try:
            return full_name(self._robot, parent), full_name(self._robot, child)
        except InvalidInput as error:
            self._refuse("frame name", error)
            return None

    def _insert(self, parent: str, child: str, pose: ArrayLike, *, beside_model: bool = False) -> None:
        try:
            transform = Transform.from_pose7(parent, child, pose)
        except InvalidInput as error:
            self._refuse("bad numbers", error)
            return
        try:
            self._buffer.insert_static(transform, writer=self._writer)
            self._edges[child] = transform
        except InvalidInput as error:
            reason = error.reason if isinstance(error, InsertRefused) else "frame name"
            if not (beside_model and reason == "second writer" and self._is_known(transform)):
                self._refuse(reason, error)
                if reason in _CONFLICTS and self._on_conflict is not None:
                    self._on_conflict(self._robot, self._writer, child, str(error))

    def _is_known(self, transform: Transform) -> bool:
        """Whether a model fixes just this edge: a ROS state publisher calls these static, too."""
        names = transform.target, transform.source
        known = self._buffer.lookup(*names) if self._buffer.can_lookup(*names) else None
        return known is not None and known.kind == "static" and are_same(known, transform)

    def _withdraw(self, children: list[str]) -> None:
        for child in children:
            del self._edges[child]
        for child in self._still_ours(children):
            self._buffer.withdraw(child)

    def _still_ours(self, children: Iterable[str]) -> list[str]:
        # A model or another writer may have taken an edge over meanwhile: then it is theirs.
        return [frame.name for frame in self._buffer.frames(children) if frame.writer == self._writer]

    def _refuse(self, reason: str, error: InvalidInput) -> None:
        self._tally.refuse(reason, f"static edge of {self._writer!r}: {error}")
