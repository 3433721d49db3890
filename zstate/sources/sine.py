"""A sine on every joint, so that something moves."""

from __future__ import annotations

import math

import numpy as np

from zstate.errors import InvalidInput
from zstate.model.robot import Joint, RobotModel
from zstate.sources.joint_source import JointReading

_LARGEST_SWING = {"revolute": 1.2, "continuous": math.pi, "prismatic": 0.5, "planar": 0.5, "floating": 0.0}
# Joints side by side move a little apart, so that each can be told from its neighbour.
_PHASE_STEP = 0.5


class SineSource:
    """Every driven joint swings about the middle of its range, inside its limits of position and speed.

    A function of the stamp alone: two sources of one model agree at every instant. ``period_s`` is
    the shortest period [s]; a joint that would exceed its velocity limit swings less far. Planar joints
    circle, floating joints rest at their origin.
    """

    def __init__(self, model: RobotModel, period_s: float = 6.0) -> None:
        if not (math.isfinite(period_s) and period_s > 0.0):
            raise InvalidInput(f"period_s is a positive number of seconds, not {period_s!r}")
        self._period_ns = round(period_s * 1e9)
        self._omega = math.tau / period_s
        self._model = model
        self._center = model.neutral.copy()
        self._swing = np.zeros(model.position_count)
        self._phase = np.zeros(model.position_count)
        for number, joint in enumerate(model.driven_joints):
            self._plan(joint, number * _PHASE_STEP)
        # A floating joint has one number less in its velocity than in its pose, and it rests.
        self._rates = np.array(
            [c for j in model.driven_joints for c in _rate_columns(model, j)], dtype=np.intp
        )

    def _plan(self, joint: Joint, phase: float) -> None:
        column, limits = self._model.columns[joint.name], joint.limits
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
        # Reduced to one period in integers first: nanoseconds since 1970 have no room in a float.
        angle = self._phase + math.tau * (stamp % self._period_ns) / self._period_ns
        positions = self._center + self._swing * np.sin(angle)
        rates = self._swing * self._omega * np.cos(angle)
        return JointReading(positions, rates[self._rates])


def _rate_columns(model: RobotModel, joint: Joint) -> range:
    start = model.columns[joint.name]
    count = {"floating": 6, "planar": 3}.get(joint.type, 1)
    return range(start, start + count)
