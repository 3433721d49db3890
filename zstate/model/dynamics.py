"""Forward dynamics of a robot: its motion under the efforts of its actuators, gravity and friction.

Pinocchio's articulated-body algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008) on the inertias of
the URDF. Joints that mimic others are held at their rest positions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zstate.errors import InvalidInput
from zstate.model.pinocchio_solver import load_pinocchio
from zstate.model.robot import POSITION_COUNTS, RobotModel

Floats = NDArray[np.float64]

_SLIP = 1e-3
"""Below this speed, per second, dry friction falls to zero with the speed, so that a joint can rest."""


class ForwardDynamics:
    """Forward dynamics of a robot whose joints have one position each. Not thread-safe.

    Vectors are in the order of ``model.joint_names``: positions [rad] or [m], velocities per second, efforts
    [Nm] or [N]. Gravity points along -z of the root. Raises InvalidInput for other joints and for links
    without inertia, and LibraryMissing.
    """

    def __init__(self, model: RobotModel) -> None:
        several = [joint.name for joint in model.driven_joints if POSITION_COUNTS[joint.type] != 1]
        if several or not model.joint_names:
            names = ", ".join(map(repr, several)) or "none"
            raise InvalidInput(
                f"dynamics of {model.name!r} need joints with one position each; not so: {names}"
            )
        self._pin = load_pinocchio()
        whole: Any = self._pin.buildModelFromXML(model.urdf)
        locked = [index for index, name in enumerate(whole.names) if index and name not in model.joint_names]
        self._model: Any = self._pin.buildReducedModel(whole, locked, self._pin.neutral(whole))
        self._data: Any = self._model.createData()
        joints = [self._model.joints[self._model.getJointId(name)] for name in model.joint_names]
        self._q_rows = np.array([joint.idx_q for joint in joints], dtype=np.intp)
        self._v_rows = np.array([joint.idx_v for joint in joints], dtype=np.intp)
        # Pinocchio has cosine and sine of the angle of a continuous joint.
        self._is_turning = np.array([joint.nq == 2 for joint in joints])
        self._effort = np.array([joint.limits.effort for joint in model.driven_joints])
        self._damping: Floats = np.asarray(self._model.damping, dtype=np.float64)[self._v_rows]
        self._friction: Floats = np.asarray(self._model.upperDryFrictionLimit, dtype=np.float64)[self._v_rows]
        mass: Floats = np.diag(self._pin.crba(self._model, self._data, self._pin.neutral(self._model)))
        if not (mass > 0.0).all():
            light = [
                name for name, row in zip(model.joint_names, self._v_rows, strict=True) if mass[row] <= 0.0
            ]
            raise InvalidInput(
                f"the links that {', '.join(map(repr, light))} move have no <inertial> in the URDF of "
                f"{model.name!r}, which dynamics need; use plant='lag'"
            )

    def efforts_to_hold(self, positions: Floats, velocities: Floats, accelerations: Floats) -> Floats:
        """The efforts for these ``accelerations``, without those against friction (n,)."""
        q, v = self._configuration(positions), self._spread(velocities)
        efforts: Floats = self._pin.rnea(self._model, self._data, q, v, self._spread(accelerations))
        return efforts[self._v_rows]

    def accelerations(self, positions: Floats, velocities: Floats, efforts: Floats) -> Floats:
        """The accelerations under ``efforts``, which are cut at the limits of the URDF, and friction (n,)."""
        q, v = self._configuration(positions), self._spread(velocities)
        slip = np.clip(velocities / _SLIP, -1.0, 1.0)
        driving = self.limited(efforts) - self._damping * velocities - self._friction * slip
        found: Floats = self._pin.aba(self._model, self._data, q, v, self._spread(driving))
        return found[self._v_rows]

    def limited(self, efforts: Floats) -> Floats:
        """``efforts`` cut at the limits of the URDF (n,)."""
        return np.clip(efforts, -self._effort, self._effort)

    def _spread(self, numbers: Floats) -> Floats:
        """``numbers`` in Pinocchio's order."""
        spread = np.zeros(self._model.nv)
        spread[self._v_rows] = numbers
        return spread

    def _configuration(self, positions: Floats) -> Floats:
        q = np.zeros(self._model.nq)
        q[self._q_rows] = np.where(self._is_turning, np.cos(positions), positions)
        turning = self._q_rows[self._is_turning] + 1
        q[turning] = np.sin(positions[self._is_turning])
        return q
