"""MovingEdges: the edges of a model, as they are said on the network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zstate.model.edges import EdgeTable
from zstate.model.robot import RobotModel
from zstate.wire.keys import wire_name
from zstate.wire.messages import JointState, StaticTransforms, TransformSample, order_digest, to_block


class MovingEdges:
    """The edges of a model as they are called on the network, moving and fixed apart."""

    def __init__(self, model: RobotModel, robot: str) -> None:
        self._table = EdgeTable(model)
        forms = self._table.forms
        names = [(wire_name(robot, form.parent), wire_name(robot, form.child)) for form in forms]
        fixed = [form.kind == "fixed" for form in forms]
        self._rows = np.flatnonzero(~np.array(fixed, dtype=np.bool_))
        self.names = tuple(names[row] for row in self._rows)
        self.order = order_digest(self.names)
        self._fixed_names = tuple(name for name, is_fixed in zip(names, fixed, strict=True) if is_fixed)
        self._fixed_poses = [form.origin for form in forms if form.kind == "fixed"]

    def check(self, positions: NDArray[np.float64]) -> None:
        """Raise InvalidInput for a floating joint's quaternion that is not of unit length."""
        self._table.normalised(positions)

    def poses(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """``parent_from_child`` of each of ``names``: (n, 7)."""
        return self._table.poses(positions).take(self._rows, axis=0)

    def sample(self, state: JointState, positions: NDArray[np.float64]) -> TransformSample:
        """What ``state`` means for the moving edges."""
        poses = to_block(self.poses(positions))
        return TransformSample(state.stamp, state.seq, state.session, self.order, poses)

    def statics(self, session: int) -> StaticTransforms:
        return StaticTransforms(session, self._fixed_names, to_block(self._fixed_poses))
