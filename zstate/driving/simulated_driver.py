"""A driver without hardware: joints that follow setpoints at once, with a lag, or by rigid-body dynamics."""

from __future__ import annotations

import math
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate.checks import Floats
from zstate.driving.driver import Mode, Setpoint, StopMode
from zstate.errors import InvalidInput
from zstate.model.pinocchio_solver import load_pinocchio
from zstate.model.robot import POSITION_COUNTS, RobotModel
from zstate.sources import JointReading

Plant: TypeAlias = Literal["mirror", "lag", "dynamics"]

_LAG_S = 0.05
"""Time constant of the plant "lag"."""

_NATURAL_FREQUENCY = 60.0
"""That of the position controller of the plant "dynamics" [rad/s]; critically damped."""

_STEP_S = 0.001
_LONGEST_STEP_S = 0.1
"""What is simulated at most for one reading: after a longer pause the plant stands still for the rest."""

_SLIP = 1e-3
"""Below this speed, per second, dry friction falls to zero with the speed, so that a joint can rest."""


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
    """Joints are where, or as fast as, they are commanded to be; without torque they rest."""

    efforts = None

    def advance(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        joints.velocities[:] = 0.0
        if target is not None:
            is_turning = _in_mode(target, "velocity")
            joints.velocities[is_turning] = target.velocities[is_turning]
            moved = joints.positions + dt_s * joints.velocities
            joints.positions[:] = np.where(is_turning, moved, target.positions)


class _Lag:
    """First-order lag: the distance to the setpoint, or to its velocity, falls by a factor e in 50 ms."""

    efforts = None

    def advance(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        if target is None or dt_s <= 0.0:
            joints.velocities[:] = 0.0
            return
        share = -math.expm1(-dt_s / _LAG_S)
        is_turning = _in_mode(target, "velocity")
        step = (target.positions - joints.positions) * share
        short = target.velocities - joints.velocities
        turned = target.velocities * dt_s - short * share * _LAG_S
        joints.positions += np.where(is_turning, turned, step)
        joints.velocities[:] = np.where(is_turning, joints.velocities + short * share, step / dt_s)


class _Dynamics:
    """Rigid bodies under gravity, friction and controllers, in steps of 1 ms.

    They control position or velocity by computed torque; efforts act as they are.
    """

    def __init__(self, model: RobotModel) -> None:
        self._dynamics = ForwardDynamics(model)
        self.efforts: Floats | None = np.zeros(len(model.joint_names))
        limits = [joint.limits for joint in model.driven_joints]
        self._lower = np.array([one.lower for one in limits])
        self._upper = np.array([one.upper for one in limits])

    def advance(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        steps = math.ceil(dt_s / _STEP_S)
        for _ in range(steps):
            self._step(joints, target, dt_s / steps)

    def _step(self, joints: _Joints, target: Setpoint | None, dt_s: float) -> None:
        q, v = joints.positions, joints.velocities
        efforts = np.zeros(len(q))
        if target is not None:
            gain = _NATURAL_FREQUENCY
            wanted = np.where(_in_mode(target, "position"), gain**2 * (target.positions - q), 0.0)
            wanted += 2.0 * gain * (target.velocities - v)
            efforts = self._dynamics.efforts_to_hold(q, v, wanted)
            if target.efforts is not None:
                efforts = np.where(_in_mode(target, "effort"), target.efforts, efforts)
            efforts = self._dynamics.limited(efforts)
        # Semi-implicit Euler, which is stable where the explicit one gains energy.
        v += dt_s * self._dynamics.accelerations(q, v, efforts)
        v[((q <= self._lower) & (v < 0.0)) | ((q >= self._upper) & (v > 0.0))] = 0.0
        q += dt_s * v
        self.efforts = efforts


def _in_mode(setpoint: Setpoint, mode: Mode) -> NDArray[np.bool_]:
    """Which joints are in ``mode``: (n,)."""
    return np.array([one == mode for one in setpoint.modes])


class SimulatedDriver:
    """A ``Driver`` without hardware; starts at ``model.neutral``, or at ``start`` (n,) [rad] or [m].

    The joints of ``plant`` "mirror" are at the last setpoint, those of "lag" follow it with a time constant
    of 50 ms, and those of "dynamics" are moved by Pinocchio's articulated-body algorithm with gravity,
    friction and the effort limits of the URDF, up to the ends of their ranges. All take positions and
    velocities, and "dynamics" efforts. Brakes hold the joints until they are enabled; after ``stop("relax")``
    they fall. Time is that of the stamps of ``read``. Raises InvalidInput as ``ForwardDynamics``, for an
    unknown plant, and for joints with several positions.
    """

    def __init__(self, model: RobotModel, plant: Plant = "lag", *, start: Floats | None = None) -> None:
        if model.position_count != len(model.joint_names):
            raise InvalidInput(f"{model.name!r} has joints with several positions, which have no setpoints")
        self.joint_names = model.joint_names
        self._joints = _Joints(model.neutral if start is None else model.check_positions(start))
        self._plant = _new_plant(model, plant)
        kinematic: frozenset[Mode] = frozenset({"position", "velocity"})
        self.modes = kinematic if self._plant.efforts is None else kinematic | {"effort"}
        self._target: Setpoint | None = None
        self._is_enabled = False
        self._read_at: int | None = None

    def open(self) -> None:
        """Does nothing."""

    def enable(self, on: bool) -> None:
        """Release the brakes and hold the joints where they are; or brake them, without torque."""
        self._is_enabled = on
        self.stop("hold" if on else "relax")
        if not on:
            self._joints.velocities[:] = 0.0

    def read(self, stamp: int) -> JointReading:
        """The joints at ``stamp`` [ns]; a stamp before the last one changes nothing."""
        past = 0 if self._read_at is None else stamp - self._read_at
        self._read_at = stamp
        if past > 0 and self._is_enabled:
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
        """Brakes the joints, and switches their torque off."""
        self.enable(False)


def _new_plant(model: RobotModel, plant: str) -> _Plant:
    if plant == "mirror":
        return _Mirror()
    if plant == "lag":
        return _Lag()
    if plant == "dynamics":
        return _Dynamics(model)
    raise InvalidInput(f"plant is 'mirror', 'lag' or 'dynamics', not {plant!r}")


class ForwardDynamics:
    """Forward dynamics of a robot whose joints have one position each. Not thread-safe.

    Pinocchio's articulated-body algorithm (Featherstone, Rigid Body Dynamics Algorithms, 2008) on the
    inertias of the URDF, with the efforts of actuators, gravity and friction. Joints that mimic others are
    held at their rest positions.

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
