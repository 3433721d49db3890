"""Check of positions against the limits of their joints, with a hint at degrees."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zstate.model.robot import Joint, RobotModel

TOLERANCE = 1e-3
"""[rad] or [m]; an encoder at its end stop may exceed the limit by less."""

_MOST_NAMED = 3


class JointLimits:
    """The position limits of a model's revolute and prismatic joints.

    Continuous joints have no limits, and equal limits count as none: neither is checked.
    """

    def __init__(self, model: RobotModel) -> None:
        self._joints = [
            joint
            for joint in model.driven_joints
            if joint.type in ("revolute", "prismatic") and joint.limits.lower < joint.limits.upper
        ]
        self._columns = np.array([model.columns[joint.name] for joint in self._joints], dtype=np.intp)
        self._lower = np.array([joint.limits.lower for joint in self._joints]) - TOLERANCE
        self._upper = np.array([joint.limits.upper for joint in self._joints]) + TOLERANCE

    def __bool__(self) -> bool:
        """Whether any joint has limits."""
        return bool(self._joints)

    def bounds(self, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The least and the greatest of ``count`` positions that are within; infinite without limits."""
        lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
        lower[self._columns], upper[self._columns] = self._lower, self._upper
        return lower, upper

    def are_exceeded(self, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        """For each row of ``positions``, (n, position_count), whether any joint is outside its limits."""
        values = positions[:, self._columns]
        exceeded: NDArray[np.bool_] = (values < self._lower) | (values > self._upper)
        return np.logical_or.reduce(exceeded, axis=1)

    def explanation(self, positions: NDArray[np.float64]) -> str:
        """The joints outside their limits in any row, each with its worst value; empty if there are none.

        Names a probable cause: an angle beyond a full turn that is within the limits once converted from
        degrees.
        """
        values = positions[:, self._columns]
        excess = np.maximum(self._lower - values, values - self._upper)
        rows = excess.argmax(axis=0)
        found = [
            (joint, float(values[rows[column], column]))
            for column, joint in enumerate(self._joints)
            if excess[rows[column], column] > 0.0
        ]
        parts = [
            f"{joint.name!r} at {round(value, 4)} {'rad' if joint.type == 'revolute' else 'm'} "
            f"is outside {joint.limits.lower:g} to {joint.limits.upper:g}"
            for joint, value in found[:_MOST_NAMED]
        ]
        if len(found) > _MOST_NAMED:
            parts.append(f"{len(found) - _MOST_NAMED} more joints are outside theirs")
        degrees = any(_looks_like_degrees(joint, value) for joint, value in found)
        return ", ".join(parts) + "; this looks like degrees: convert with math.radians" * degrees


def _looks_like_degrees(joint: Joint, value: float) -> bool:
    within = joint.limits.lower - TOLERANCE <= math.radians(value) <= joint.limits.upper + TOLERANCE
    return joint.type == "revolute" and abs(value) > math.tau and within
