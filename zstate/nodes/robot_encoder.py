"""Encoder of one robot's state: positions to blocks, joint states to transform samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from zstate.extension import kernel
from zstate.model.joint_transforms import JointTransforms
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
        """None: the caller checks them with numpy."""


Positions: TypeAlias = ArrayLike | Mapping[str, float | Sequence[float]]


class RobotEncoder:
    """Checks and encodes the samples of a model published under the name ``robot``.

    ``names`` are the moving edges (parent, child) in the order of a transform sample's poses, with the
    frame names of the wire; ``order`` is their digest.
    """

    def __init__(self, model: RobotModel, robot: str) -> None:
        self._model = model
        self._count = model.position_count
        self._table = JointTransforms(model)
        forms = self._table.forms
        names = [(wire_name(robot, form.parent), wire_name(robot, form.child)) for form in forms]
        fixed = [form.kind == "fixed" for form in forms]
        self._rows = np.flatnonzero(~np.array(fixed, dtype=np.bool_))
        self.names = tuple(names[row] for row in self._rows)
        self.order = order_digest(self.names)
        self._fixed_names = tuple(name for name, is_fixed in zip(names, fixed, strict=True) if is_fixed)
        self._fixed_poses = [form.origin for form in forms if form.kind == "fixed"]

    def encode_positions(self, positions: Positions) -> bytes:
        """``positions`` as a block. Raises InvalidInput unless they are a configuration of the robot."""
        block = block_of(positions, self._count)
        if block is None:
            model = self._model
            is_named = isinstance(positions, Mapping)
            block = to_block(model.positions(positions) if is_named else model.check_positions(positions))
        if self._table.has_floats:
            self._table.normalised(from_block(block))
        return block

    def transform_sample(self, state: JointState) -> TransformSample:
        """The pose of each moving edge, ``parent_from_child``, in ``state``."""
        poses = self._table.poses(from_block(state.positions)).take(self._rows, axis=0)
        return TransformSample(state.stamp, state.seq, state.session, self.order, to_block(poses))

    def statics(self, session: int) -> StaticTransforms:
        """The fixed edges of the model."""
        return StaticTransforms(session, self._fixed_names, to_block(self._fixed_poses))
