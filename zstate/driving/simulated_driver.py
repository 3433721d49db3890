"""A driver without hardware: joints that follow setpoints at once, with a lag, or by rigid-body dynamics."""

from __future__ import annotations

import math
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate.driving.driver import Mode, Setpoint, StopMode
from zstate.errors import InvalidInput
from zstate.model.dynamics import ForwardDynamics
from zstate.model.robot import RobotModel
from zstate.sources import JointReading

Floats = NDArray[np.float64]
Plant: TypeAlias = Literal["mirror", "lag", "dynamics"]

_LAG_S = 0.05
"""Time constant of the plant "lag"."""

_NATURAL_FREQUENCY = 60.0
"""Of the position controller of the plant "dynamics" [rad/s]; critically damped."""

_STEP_S = 0.001
_LONGEST_STEP_S = 0.1
"""What is simulated at most for one reading: after a longer pause the plant stands still for the rest."""


class _Plant(Protocol):
    """The joints of a simulated robot; ``target`` is None without torque."""

    @property
    def efforts(self) -> Floats | None: ...

    def advance(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None: ...


class _Joints:
    """Positions and velocities, (n,) each."""

    def __init__(self, positions: Floats) -> None:
        self.positions = positions.copy()
        self.velocities = np.zeros(len(positions))


class _Mirror:
    """Joints are where they are commanded to be; without torque they rest."""

    efforts = None

    def advance(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        joints.velocities[:] = 0.0
        if target is not None:
            joints.positions[:] = target.positions


class _Lag:
    """First-order lag: the distance to the setpoint falls by a factor e in 50 ms."""

    efforts = None

    def advance(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        if target is None or dt_s <= 0.0:
            joints.velocities[:] = 0.0
            return
        step = (target.positions - joints.positions) * -math.expm1(-dt_s / _LAG_S)
        joints.positions += step
        joints.velocities[:] = step / dt_s


class _Dynamics:
    """Rigid bodies under gravity, friction and a position controller (computed torque), in steps of 1 ms."""

    def __init__(self, model: RobotModel) -> None:
        self._dynamics = ForwardDynamics(model)
        self.efforts: Floats | None = np.zeros(len(model.joint_names))

    def advance(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        steps = math.ceil(dt_s / _STEP_S)
        for _ in range(steps):
            self._step(joints, target, dt_s / steps)

    def _step(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        q, v = joints.positions, joints.velocities
        efforts = np.zeros(len(q))
        if target is not None:
            gain = _NATURAL_FREQUENCY
            wanted = gain**2 * (target.positions - q) + 2.0 * gain * (target.velocities - v)
            efforts = self._dynamics.limited(self._dynamics.efforts_to_hold(q, v, wanted))
        # Semi-implicit Euler, which is stable where the explicit one gains energy.
        v += dt_s * self._dynamics.accelerations(q, v, efforts)
        q += dt_s * v
        self.efforts = efforts


class SimulatedDriver:
    """A ``Driver`` without hardware; starts at ``model.neutral``, or at ``start`` (n,) [rad] or [m].

    The joints of ``plant`` "mirror" are at the last setpoint, those of "lag" follow it with a time constant
    of 50 ms, and those of "dynamics" are moved by Pinocchio's articulated-body algorithm with gravity,
    friction and the effort limits of the URDF; without torque they fall. Time is that of the stamps of
    ``read``. Raises InvalidInput as ``ForwardDynamics``, for an unknown plant, and for joints with several
    positions.
    """

    modes: frozenset[Mode] = frozenset({"position"})

    def __init__(self, model: RobotModel, plant: Plant = "lag", *, start: Floats | None = None) -> None:
        if model.position_count != len(model.joint_names):
            raise InvalidInput(f"{model.name!r} has joints with several positions, which have no setpoints")
        self.joint_names = model.joint_names
        self._joints = _Joints(model.neutral if start is None else model.check_positions(start))
        self._plant = _new_plant(model, plant)
        self._target: Setpoint | None = None
        self._is_enabled = False
        self._read_at: int | None = None

    def open(self) -> None:
        """Does nothing."""

    def enable(self, on: bool) -> None:
        """Hold the joints where they are, or switch their torque off."""
        self._is_enabled = on
        self.stop("hold" if on else "relax")

    def read(self, stamp: int) -> JointReading:
        """The joints at ``stamp`` [ns]; a stamp before the last one changes nothing."""
        past = 0 if self._read_at is None else stamp - self._read_at
        self._read_at = stamp
        if past > 0:
            self._plant.advance(self._joints, self._target, min(past * 1e-9, _LONGEST_STEP_S))
        efforts = self._plant.efforts
        return JointReading(
            self._joints.positions.copy(),
            self._joints.velocities.copy(),
            None if efforts is None else efforts.copy(),
            stamp,
        )

    def write(self, setpoint: Setpoint) -> None:
        """The next target of all joints. Raises InvalidInput while they are not enabled."""
        if not self._is_enabled:
            raise InvalidInput("setpoints are written to joints that are enabled; call enable(True) first")
        self._target = setpoint

    def stop(self, how: StopMode) -> None:
        """Hold the joints where they are, or switch their torque off."""
        resting = np.zeros(len(self.joint_names))
        positions = self._joints.positions.copy()
        self._target = Setpoint(self._read_at or 0, positions, resting) if how == "hold" else None

    def close(self) -> None:
        """Switches the torque off."""
        self.enable(False)


def _new_plant(model: RobotModel, plant: str) -> _Plant:
    if plant == "mirror":
        return _Mirror()
    if plant == "lag":
        return _Lag()
    if plant == "dynamics":
        return _Dynamics(model)
    raise InvalidInput(f"plant is 'mirror', 'lag' or 'dynamics', not {plant!r}")
