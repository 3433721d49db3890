"""Closed forms of ``parent_from_child`` as a function of the joint's positions.

With ``x = scale * position + shift``,

- a revolute or continuous joint turns by ``x`` about a fixed axis: ``q = q_cos cos(x/2) + q_sin sin(x/2)``,
  where ``q_cos`` is the origin's rotation and ``q_sin`` is that times the half turn about the axis;
- a prismatic joint moves by ``x`` along a fixed axis: ``t = t0 + t1 x``;
- a planar joint moves by x, y in the plane of its frame and then turns by yaw about its z;
- a floating joint is its origin times the given pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from zstate.model.robot import Joint, Pose7, RobotModel, Vector3
from zstate.se3 import SCALARS, Pose, compose, multiply, normalize, rotate

EdgeKind = Literal["fixed", "revolute", "prismatic", "planar", "floating"]
KINDS: tuple[EdgeKind, ...] = get_args(EdgeKind)
"""In the order of the extension's StepKind."""

Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class JointTransform:
    """``parent_from_child`` as a function of the position vector.

    ``column`` and ``velocity_column`` are the indices of the joint's first number (its master's, for a
    mimic) in the vectors of positions and velocities; -1 for a fixed edge. ``scale`` and ``shift`` are
    1 and 0 except for mimics. ``q_cos``, ``q_sin``, ``t0`` and ``t1`` stand in the module's formulas
    (quaternions x y z w; a planar joint's turn by yaw); ``origin`` is ``parent_from_joint`` as pose7
    with a unit quaternion and ``axis`` the unit axis in the joint's frame, z for planar joints.
    """

    parent: str
    child: str
    kind: EdgeKind
    column: int
    velocity_column: int
    scale: float
    shift: float
    q_cos: Quaternion
    q_sin: Quaternion
    t0: Vector3
    t1: Vector3
    origin: Pose7
    axis: Vector3

    def numbers(self, before: Pose) -> tuple[float, ...]:
        """The numbers of this edge in the extension, for ``before`` times ``parent_from_child``."""
        if self.kind not in ("revolute", "prismatic"):
            return compose(before, self.origin)
        placed, q = compose(before, (*self.t0, *self.q_cos)), before[3:]
        axis = multiply(q, self.q_sin) if self.kind == "revolute" else rotate(q, self.t1)
        return (self.scale, self.shift, *placed[3:], *placed[:3], *axis)


def edge_forms(model: RobotModel) -> tuple[JointTransform, ...]:
    """The closed form of every edge, fixed ones included, in the order of ``model.joints``."""
    return tuple(_form(model, joint) for joint in model.joints)


def _form(model: RobotModel, joint: Joint) -> JointTransform:
    kind: EdgeKind = "revolute" if joint.type == "continuous" else joint.type
    axis = joint.axis
    if kind != "fixed":
        x, y, z = (0.0, 0.0, 1.0) if kind == "planar" else joint.axis
        length = math.hypot(x, y, z)
        axis = (x / length, y / length, z / length)
    rotation = normalize(joint.origin, SCALARS)[3:]
    still = (0.0, 0.0, 0.0)
    master = model.mimic_of(joint)
    return JointTransform(
        parent=joint.parent,
        child=joint.child,
        kind=kind,
        column=model.columns.get(master.joint, -1),
        velocity_column=model.velocity_columns.get(master.joint, -1),
        scale=master.multiplier,
        shift=master.offset,
        q_cos=rotation,
        q_sin=multiply(rotation, (*axis, 0.0)) if kind in ("revolute", "planar") else (*still, 0.0),
        t0=joint.origin[:3],
        t1=rotate(rotation, axis) if kind == "prismatic" else still,
        origin=(*joint.origin[:3], *rotation),
        axis=axis,
    )
