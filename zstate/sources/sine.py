"""Test signal: a sine on every joint."""

from __future__ import annotations

import math

import numpy as np

from zstate.errors import InvalidInput
from zstate.model.robot import Joint, RobotModel, velocity_columns_by_position
from zstate.sources.joint_source import JointReading

_LARGEST_SWING = {"revolute": 1.2, "continuous": math.pi, "prismatic": 0.5, "planar": 0.5, "floating": 0.0}
# The phase between neighbouring joints, which makes their curves distinguishable.
_PHASE_STEP = 0.5


class SineSource:
    """Every driven joint swings about the middle of its range, inside its limits of position and speed.

    A function of the stamp alone: two sources of one model agree at every instant. All joints have the
    period ``period_s`` [s]; a velocity limit reduces the amplitude. Planar joints circle, floating joints
    rest at their origin.
    """

    def __init__(self, model: RobotModel, period_s: float = 6.0) -> None:
        if not (math.isfinite(period_s) and period_s > 0.0):
            raise InvalidInput(f"period_s is a positive number of seconds, not {period_s!r}")
        self._period_ns = round(period_s * 1e9)
        self._omega = math.tau / period_s
        self._center = model.neutral.copy()
        self._swing = np.zeros(model.position_count)
        self._phase = np.zeros(model.position_count)
        for number, joint in enumerate(model.driven_joints):
            self._set_swing(joint, model.columns[joint.name], number * _PHASE_STEP)
        # A floating joint has fewer velocities (6) than positions (7), and it rests.
        self._rates = np.array(velocity_columns_by_position(model), dtype=np.intp)

    def _set_swing(self, joint: Joint, column: int, phase: float) -> None:
        limits = joint.limits
        swing = min(_LARGEST_SWING[joint.type], limits.velocity / self._omega)
        if joint.type == "planar":
            self._swing[column : column + 3] = swing
            self._phase[column : column + 3] = (phase, phase + math.pi / 2, phase)
        elif joint.type != "floating":
            if math.isfinite(limits.upper - limits.lower) and joint.type != "continuous":
                self._center[column] = 0.5 * (limits.lower + limits.upper)
                swing = min(swing, 0.45 * (limits.upper - limits.lower))
            self._swing[column] = swing
            self._phase[column] = phase

    def read(self, stamp: int) -> JointReading:
        """Positions and velocities at ``stamp`` [ns]."""
        # Reduced to one period as integers: nanoseconds since 1970 exceed the precision of a float.
        angle = self._phase + math.tau * (stamp % self._period_ns) / self._period_ns
        positions = self._center + self._swing * np.sin(angle)
        rates = self._swing * self._omega * np.cos(angle)
        return JointReading(positions, rates[self._rates])
