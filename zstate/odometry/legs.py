"""Legs: feet on the ground as landmarks of the invariant filter, from joint positions and the model.

A foot that touches down becomes a contact of the state, at the place that forward kinematics gives it. While
it stands, each reading of the joints measures the IMU relative to it (Hartley et al., 2020; the idea is of
Bloesch et al., "State estimation for legged robots", RSS 2012). Feet are points: their orientation is not
used.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from zstate._util.format import did_you_mean, suggestion_text
from zstate.checks import Floats
from zstate.errors import InvalidInput
from zstate.model.kinematics import Kinematics
from zstate.model.robot import Joint, RobotModel, near_joint
from zstate.odometry.invariant_filter import (
    FilterState,
    corrected,
    innovation,
    with_contact,
    without_contact,
)
from zstate.odometry.measurements import contact

_STANCE_NS, _STANCE_MOTION = 500_000_000, 0.003
"""The means of so long of where feet are differ by less [m] while a robot stands on all of them."""

_SINGLE = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, slots=True, kw_only=True)
class LegNoise:
    """Standard deviations of feet; one setting for a robot.

    ``joint`` [rad] or [m] is that of joint positions (encoders, play, flexible links), ``foot`` [m] that of
    the contact point in the foot's frame, each in every reading; ``slip`` [m/sqrt(s)] is the drift of a
    standing foot. Raises InvalidInput unless all are finite, ``slip`` 0 or more and the others above 0.
    """

    joint: float = 0.005
    foot: float = 0.005
    slip: float = 0.01

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 <= value < math.inf or (value == 0.0 and field.name != "slip"):
                bound = "0 or more" if field.name == "slip" else "above 0"
                raise InvalidInput(f"the noise {field.name!r} of legs is finite and {bound}; got {value!r}")


@dataclass(frozen=True, slots=True)
class ForceThresholds:
    """A foot touches down above a force of ``touchdown`` [N] and lifts off below ``liftoff`` [N].

    A third and a sixth of what a foot carries in a stand are usual. Raises InvalidInput unless liftoff <
    touchdown.
    """

    touchdown: float
    liftoff: float

    def __post_init__(self) -> None:
        if not 0.0 < self.liftoff < self.touchdown < math.inf:
            raise InvalidInput(
                f"forces of contacts are 0 < liftoff < touchdown [N]; got liftoff={self.liftoff!r}, "
                f"touchdown={self.touchdown!r}"
            )

    def is_touching(self, value: float, *, was_touching: bool) -> bool:
        """Whether a foot with the force ``value`` [N] touches the ground."""
        return value > (self.liftoff if was_touching else self.touchdown)


@dataclass(frozen=True, slots=True)
class SpeedThresholds:
    """A foot touches down when slower than ``touchdown`` [m/s] in the world, and lifts off above ``liftoff``
    [m/s].

    Raises InvalidInput unless touchdown < liftoff.
    """

    touchdown: float
    liftoff: float

    def __post_init__(self) -> None:
        if not 0.0 < self.touchdown < self.liftoff < math.inf:
            raise InvalidInput(
                f"speeds of contacts are 0 < touchdown < liftoff [m/s]; got touchdown={self.touchdown!r}, "
                f"liftoff={self.liftoff!r}"
            )

    def is_touching(self, value: float, *, was_touching: bool) -> bool:
        """Whether a foot with the speed ``value`` [m/s] touches the ground."""
        return value < (self.liftoff if was_touching else self.touchdown)


class Foot(NamedTuple):
    """A foot relative to the IMU, in its axes: ``offset`` [m], (3,), and ``covariance``, (3, 3).

    ``jacobian`` (3, n) is the derivative of the offset by the positions of ``Legs.joint_names``.
    """

    name: str
    offset: Floats
    covariance: Floats
    jacobian: Floats


class Stance(NamedTuple):
    """Where feet that are all on the ground are from the IMU, (k, 3): sums of them and of their squares.

    They are those since ``start``. ``before`` is the mean of the interval before, and ``spread`` how far
    single readings were from it. ``is_still``: the means of the last two intervals were the same.
    """

    start: int
    size: int
    total: Floats
    squares: Floats
    before: Floats | None = None
    spread: float = 0.0
    is_still: bool = False


class Legs:
    """The feet of ``model``, links whose origins touch the ground, seen from the link ``imu``.

    ``noise`` is that of the places of the feet. ``detection`` decides which feet touch if contacts are not
    measured (``touching``). Not for several threads at once. Raises InvalidInput for unknown links, with near
    misses, and for feet that no joint moves.
    """

    def __init__(
        self,
        model: RobotModel,
        feet: Sequence[str],
        *,
        imu: str,
        noise: LegNoise | None = None,
        detection: ForceThresholds | SpeedThresholds | None = None,
    ) -> None:
        self.names = _check_feet(model, feet, imu)
        self.imu = imu
        self.noise = noise or LegNoise()
        self.detection = detection
        self.joint_names = _leg_joints(model, self.names, imu)
        """The joints between the IMU and the feet, in the order of the model."""
        self._model = model
        self._kinematics = Kinematics(model)
        self._columns = [model.columns[name] for name in self.joint_names]
        self._velocity_columns = [model.velocity_columns[name] for name in self.joint_names]

    def feet(self, positions: Mapping[str, float]) -> tuple[Foot, ...]:
        """Where the feet are at these joint positions [rad] or [m], which may have other joints as well.

        The noise of each encoder moves a foot by its column of the Jacobian. Raises InvalidInput for missing
        joints and NaN.
        """
        vector = self._model.neutral.copy()
        vector[self._columns] = self._numbers(positions, "position")
        points, jacobians = self._kinematics.origins(self.names, vector, self.imu)
        jacobians = jacobians[:, :, self._velocity_columns]
        joint, foot = self.noise.joint**2, self.noise.foot**2
        return tuple(
            Foot(name, point, jacobian @ jacobian.T * joint + np.eye(3) * foot, jacobian)
            for name, point, jacobian in zip(self.names, points, jacobians, strict=True)
        )

    def check_detection(
        self, velocities: Mapping[str, float] | None, efforts: Mapping[str, float] | None
    ) -> None:
        """Raises InvalidInput, as ``touching`` does, if what ``detection`` needs is missing."""
        if self.detection is None:
            raise InvalidInput(
                "contacts of feet are neither measured nor detected; pass the contacts, or "
                "Legs(..., detection=ForceThresholds(...) or SpeedThresholds(...))"
            )
        if isinstance(self.detection, ForceThresholds):
            self._numbers(efforts or {}, "effort")
        else:
            self._numbers(velocities or {}, "velocity")

    def touching(
        self,
        feet: Sequence[Foot],
        before: Collection[str],
        *,
        state: FilterState,
        gyro: Floats,
        velocities: Mapping[str, float] | None = None,
        efforts: Mapping[str, float] | None = None,
    ) -> frozenset[str]:
        """Those of ``feet`` on the ground by ``detection``; ``before`` are those that touched until now.

        By force: that which balances the ``efforts`` of the joints [Nm] or [N], ``J^T f = -tau``, without the
        weight of the leg. By speed: that of ``R^T v + omega x r + J q'``, with the ``state``'s velocity, the
        rate of the ``gyro`` less its bias, the foot's offset r and the joints' ``velocities`` q' [rad/s] or
        [m/s]. Raises InvalidInput for numbers that are missing.
        """
        if self.detection is None:
            raise InvalidInput(
                "contacts of feet are neither measured nor detected; pass the contacts, or "
                "Legs(..., detection=ForceThresholds(...) or SpeedThresholds(...))"
            )
        limits = self.detection
        if isinstance(limits, ForceThresholds):
            torques = self._numbers(efforts or {}, "effort")
            values = [_force(foot, torques) for foot in feet]
        else:
            rates = self._numbers(velocities or {}, "velocity")
            at_imu, turn = state.rotation.T @ state.velocity, gyro - state.gyro_bias
            moved = (at_imu + np.cross(turn, foot.offset) + foot.jacobian @ rates for foot in feet)
            values = [float(np.linalg.norm(velocity)) for velocity in moved]
        return frozenset(
            foot.name
            for foot, value in zip(feet, values, strict=True)
            if limits.is_touching(value, was_touching=foot.name in before)
        )

    def _numbers(self, values: Mapping[str, float], what: str) -> Floats:
        missing = [name for name in self.joint_names if name not in values]
        if missing:
            near = near_joint(missing[0], tuple(values))
            raise InvalidInput(
                f"no {what} of {', '.join(map(repr, missing))}, which moves a foot{suggestion_text(near)}"
            )
        return np.array([values[name] for name in self.joint_names], dtype=np.float64)


def stance_after(before: Stance | None, stamp: int, feet: Sequence[Foot], *, is_whole: bool) -> Stance | None:
    """The stance with one more reading; None if not all feet are on the ground."""
    if not is_whole:
        return None
    offsets = np.array([foot.offset for foot in feet])
    first = Stance(stamp, 1, offsets, offsets * offsets)
    if before is None:
        return first
    if before.before is not None and float(np.abs(offsets - before.before).max()) > before.spread:
        return first
    if stamp - before.start < _STANCE_NS:
        total, squares = before.total + offsets, before.squares + offsets * offsets
        return before._replace(size=before.size + 1, total=total, squares=squares)
    mean = before.total / before.size
    variance = float((before.squares / before.size - mean * mean).max())
    is_still = before.before is not None and float(np.abs(mean - before.before).max()) < _STANCE_MOTION
    spread = _STANCE_MOTION + 4.0 * math.sqrt(max(0.0, variance))
    return first._replace(before=mean, spread=spread, is_still=is_still)


def updated_by_feet(
    state: FilterState, feet: Sequence[Foot], touching: Collection[str], gate: float
) -> tuple[FilterState, dict[str, float]]:
    """The state after a reading of the joints, and the NIS of each foot that was on the ground already.

    Contacts of feet that have left the ground end, those of feet in ``touching`` are measured, and others
    begin. A foot whose NIS is above ``gate`` has slipped: its contact begins again where the foot is now.
    """
    for name in state.feet:
        if name not in touching:
            state = without_contact(state, name)
    on_ground = [foot for foot in feet if foot.name in touching]
    squares: dict[str, float] = {}
    for foot in on_ground:
        if foot.name not in state.feet:
            continue
        measurement = contact(state, foot.name, foot.offset, foot.covariance)
        found = innovation(state, measurement)
        squares[foot.name] = found.nis
        if found.nis <= gate:
            state = corrected(state, measurement, found)
        else:
            state = without_contact(state, foot.name)
    for foot in on_ground:
        if foot.name not in state.feet:
            state = with_contact(state, foot.name, foot.offset, foot.covariance)
    return state, squares


def _force(foot: Foot, torques: Floats) -> float:
    """The force on a foot [N] that balances the efforts of the joints that move it."""
    moving = np.abs(foot.jacobian).max(axis=0) > 0.0
    # A straight leg carries any force along it without efforts: directions below 1e-3 are left out.
    force = np.linalg.lstsq(foot.jacobian[:, moving].T, -torques[moving], rcond=1e-3)[0]
    return float(np.linalg.norm(force))


def _check_feet(model: RobotModel, feet: Sequence[str], imu: str) -> tuple[str, ...]:
    if isinstance(feet, str) or not feet or len(set(feet)) != len(feet):
        raise InvalidInput(f"feet are names of different links, one or more; got {feet!r}")
    unknown = [
        f"{name!r}{did_you_mean(name, model.links)}" for name in (*feet, imu) if name not in model.links
    ]
    if unknown:
        raise InvalidInput(f"{model.name!r} has no link {', '.join(unknown)}")
    return tuple(feet)


def _leg_joints(model: RobotModel, feet: Sequence[str], imu: str) -> tuple[str, ...]:
    """The driven joints between the link ``imu`` and any of ``feet``."""
    above_imu = _joints_above(model, imu)
    found = set[str]()
    for foot in feet:
        between = {
            model.mimic_of(joint).joint: joint
            for joint in _joints_above(model, foot) ^ above_imu
            if joint.type != "fixed"
        }
        loose = [joint.name for joint in between.values() if joint.type not in _SINGLE]
        if loose or not between:
            reason = f"the joint {loose[0]!r} has no encoder" if loose else "no joint moves it"
            raise InvalidInput(f"{foot!r} is no foot of a leg, seen from {imu!r}: {reason}")
        found |= between.keys()
    return tuple(name for name in model.joint_names if name in found)


def _joints_above(model: RobotModel, link: str) -> frozenset[Joint]:
    """The joints from the root to ``link``."""
    above = {joint.child: joint for joint in model.joints}
    joints = list[Joint]()
    while link in above:
        joints.append(above[link])
        link = above[link].parent
    return frozenset(joints)
