"""MovingEdges: the edges of a model, as they are said on the network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.extension import kernel
from zstate.model.edges import EdgeTable
from zstate.model.robot import RobotModel
from zstate.wire.keys import wire_name
from zstate.wire.messages import (
    JointState,
    StaticTransforms,
    TransformSample,
    from_block,
    order_digest,
    to_block,
)

if TYPE_CHECKING or kernel == "c":
    from zstate._kernel import block_of
else:

    def block_of(numbers: object, count: int) -> None:
        """None: how to take them has to be found out."""


Positions: TypeAlias = ArrayLike | Mapping[str, float | Sequence[float]]


class MovingEdges:
    """The edges of a model as they are called on the network, moving and fixed apart."""

    def __init__(self, model: RobotModel, robot: str) -> None:
        self._model = model
        self._count = model.position_count
        self._table = EdgeTable(model)
        forms = self._table.forms
        names = [(wire_name(robot, form.parent), wire_name(robot, form.child)) for form in forms]
        fixed = [form.kind == "fixed" for form in forms]
        self._rows = np.flatnonzero(~np.array(fixed, dtype=np.bool_))
        self.names = tuple(names[row] for row in self._rows)
        self.order = order_digest(self.names)
        self._fixed_names = tuple(name for name, is_fixed in zip(names, fixed, strict=True) if is_fixed)
        self._fixed_poses = [form.origin for form in forms if form.kind == "fixed"]

    def block(self, positions: Positions) -> bytes:
        """``positions`` as a block, once they are known to be a posture of the robot. Raises InvalidInput."""
        block = block_of(positions, self._count)
        if block is None:
            model = self._model
            is_named = isinstance(positions, Mapping)
            block = to_block(model.positions(positions) if is_named else model.check_positions(positions))
        if self._table.has_floats:
            self._table.normalised(from_block(block))
        return block

    def poses(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """``parent_from_child`` of each of ``names``: (n, 7)."""
        return self._table.poses(positions).take(self._rows, axis=0)

    def sample(self, state: JointState) -> TransformSample:
        """What ``state`` means for the moving edges."""
        poses = to_block(self.poses(from_block(state.positions)))
        return TransformSample(state.stamp, state.seq, state.session, self.order, poses)

    def statics(self, session: int) -> StaticTransforms:
        return StaticTransforms(session, self._fixed_names, to_block(self._fixed_poses))
