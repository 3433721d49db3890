"""Interface of joint sources, the check of joint states against a model, and a test signal."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from zstate.errors import InvalidInput
from zstate.ingest.joint_parts import joint_order
from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import Joint, RobotModel, velocity_columns_by_position
from zstate.wire.joint_order import JointNumbers
from zstate.wire.messages import JointState

_LARGEST_SWING = {"revolute": 1.2, "continuous": math.pi, "prismatic": 0.5, "planar": 0.5, "floating": 0.0}
# The phase between neighbouring joints, which makes their curves distinguishable.
_PHASE_STEP = 0.5


@dataclass(frozen=True, eq=False, slots=True)
class JointReading:
    """The joints of a robot at one instant, in the order of its model's ``joint_names``.

    ``positions`` [rad] or [m], ``velocities`` per second, ``efforts`` [Nm] or [N]; the last two are
    None when they are not known. ``stamp`` [ns] is None if the reading is of the requested instant. Merged
    from several drivers, ``stamp`` is that of the newest part and ``oldest_stamp`` that of the oldest one.
    """

    positions: NDArray[np.float64]
    velocities: NDArray[np.float64] | None = None
    efforts: NDArray[np.float64] | None = None
    stamp: int | None = None
    oldest_stamp: int | None = None


class JointSource(Protocol):
    """Interface of drivers, simulators and test signals."""

    def read(self, stamp: int) -> JointReading | None:
        """The joints at ``stamp`` [ns], the present instant; None when there is nothing new."""
        ...


class JointStateValidator:
    """Reads joint states of a robot with ``model``, with the checks of a StatePublisher."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        self._table = JointTransforms(model)
        self._order = joint_order(model)

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of a sample. Raises MessageError or InvalidInput if they cannot be used."""
        numbers = self._order.read(state)
        self._table.normalised(self._model.check_positions(numbers.positions))
        if numbers.velocities is not None:
            self._model.check_velocities(numbers.velocities)
        if numbers.efforts is not None:
            self._model.check_efforts(numbers.efforts)
        return numbers


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
