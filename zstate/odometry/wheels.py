"""Wheeled bases: the velocity of the base from the rotations of its wheels, and back.

Forms of one protocol, ``Wheels``: ``DiffDrive`` (also skid steering), ``Ackermann`` and ``Mecanum``. Axes are
those of the base, x forward, y left, z up; a positive rotation of a wheel drives forward. Distances in m,
angles in rad.

Two readings of the joints are a displacement, whose mean velocity belongs to the middle of the interval. What
wheels cannot do is a measurement as well: a base on the floor has no vertical velocity, and without lateral
rollers no lateral one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.format import did_you_mean
from zstate.checks import Floats, real_numbers
from zstate.errors import InvalidInput
from zstate.odometry.source_noise import SourceNoise

_TURN_LIMIT = math.pi * (1.0 + 1e-9)
_MOST_TURNED = 1e9
_STANDING = 1e-9
"""[m/s] and [rad/s]: rounding."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelNoise(SourceNoise):
    """Standard deviations of the velocity that wheels measure; one setting for a robot.

    ``slip`` is a part of the speed, ``speed`` [m/s] what is left at rest (resolution of the encoders, play),
    ``lateral`` and ``vertical`` [m/s] how far the velocity across the wheels and off the floor may be from
    zero. ``scale`` is that of the constant relative error of the radius, which shifts the position along the
    way driven. ``delay_s`` and ``gate`` as of ``VelocityNoise``. Raises InvalidInput unless all are finite
    and, but for ``slip`` and ``scale``, above zero.
    """

    slip: float = 0.05
    speed: float = 0.005
    lateral: float = 0.02
    vertical: float = 0.02
    scale: float = 0.02

    def __post_init__(self) -> None:
        SourceNoise.__post_init__(self)
        for name in ("slip", "speed", "lateral", "vertical", "scale"):
            value = getattr(self, name)
            may_be_zero = name in {"slip", "scale"}
            if not 0.0 <= value < math.inf or (value == 0.0 and not may_be_zero):
                bound = "0 or more" if may_be_zero else "above 0"
                raise InvalidInput(f"the noise {name!r} of wheels is finite and {bound}; got {value!r}")

    def covariance(self, along: float, across: float = 0.0, *, has_lateral: bool = True) -> Floats:
        """The covariance of a velocity of ``along`` and ``across`` the wheels [m/s]: (3, 3).

        ``has_lateral`` is False for wheels that drive sideways as well, where slip is that of both.
        """
        rolling = self.speed**2 + self.slip**2 * (along * along + across * across)
        return np.diag((rolling, self.lateral**2 if has_lateral else rolling, self.vertical**2))


class WheelVelocity(NamedTuple):
    """The mean velocity of a base between two readings, in its axes: linear [m/s], angular [rad/s], (3,).

    ``covariance`` (3, 3) is that of the linear part.
    """

    linear: Floats
    angular: Floats
    covariance: Floats


class Wheels(Protocol):
    """The geometry of a wheeled base."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints whose positions are read."""
        ...

    @property
    def frame(self) -> str | None:
        """The frame whose velocity is measured; the base itself if None."""
        ...

    @property
    def noise(self) -> WheelNoise:
        """The noise of the velocity."""
        ...

    def velocity(self, before: Mapping[str, float], after: Mapping[str, float], dt_s: float) -> WheelVelocity:
        """The mean velocity between two readings of the joint positions, ``dt_s`` apart."""
        ...

    def joint_velocities(self, linear: ArrayLike, angular: ArrayLike) -> dict[str, float]:
        """The rates of the driven wheels [rad/s] at a velocity of the base: linear (3,), angular (3,).

        Raises InvalidInput for velocities that these wheels cannot drive, such as upwards.
        """
        ...


@dataclass(frozen=True, slots=True)
class DiffDrive:
    """Wheels on one axle, ``track`` apart, whose middle is the origin of ``frame``.

    ``left`` and ``right`` are names of joints, several on each side for skid steering; ``track`` [m] is then
    wider than the robot, about 1.5 times, and calibrated by a turn. ``radius`` [m] is that of each wheel,
    ``noise`` that of the velocity. ``frame`` None is the base. Wheels of radius r at +-b/2 that rotate by wl,
    wr move the base by r (wr + wl) / 2 and turn it by r (wr - wl) / b (Siegwart, Nourbakhsh, Scaramuzza,
    Introduction to Autonomous Mobile Robots, 2nd ed., 3.2.2).
    """

    left: str | Sequence[str]
    right: str | Sequence[str]
    radius: float
    track: float
    noise: WheelNoise = WheelNoise()
    frame: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "left", _names(self.left))
        object.__setattr__(self, "right", _names(self.right))
        _check_geometry(self.joint_names, radius=self.radius, track=self.track)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints on the left, then those on the right."""
        return (*self.left, *self.right)

    def velocity(self, before: Mapping[str, float], after: Mapping[str, float], dt_s: float) -> WheelVelocity:
        """As ``Wheels.velocity``; several wheels on a side count by their mean."""
        left, right = (
            self.radius * sum(_turn(before[name], after[name]) for name in names) / (len(names) * dt_s)
            for names in (self.left, self.right)
        )
        return _rolling(0.5 * (left + right), (right - left) / self.track, self.noise)

    def joint_velocities(self, linear: ArrayLike, angular: ArrayLike) -> dict[str, float]:
        """As ``Wheels.joint_velocities``: along x and about z."""
        speed, _, yaw_rate = _planar(linear, angular, can_drive_sideways=False)
        return _axle_rates(self.left, self.right, self.radius, self.track, speed, yaw_rate)


@dataclass(frozen=True, slots=True)
class Ackermann:
    """Two driven rear wheels, ``track`` [m] apart, and steered front wheels ``wheelbase`` [m] ahead of them.

    The origin of ``frame`` is the middle of the rear axle. ``left`` and ``right`` are the joints of the rear
    wheels, ``steering`` those of the left and the right front wheel, or one in the middle. ``radius`` and
    ``noise`` as of ``DiffDrive``. A wheel at (l, y) that is steered by d has the curvature tan d / (l + y tan
    d): its axis meets that of the rear axle (Siegwart et al., 3.3.3).
    """

    left: str
    right: str
    steering: str | Sequence[str]
    radius: float
    track: float
    wheelbase: float
    noise: WheelNoise = WheelNoise()
    frame: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "steering", _names(self.steering))
        if len(self.steering) > 2:
            raise InvalidInput(f"steering has one joint, or the left and the right one; got {self.steering}")
        _check_geometry(self.joint_names, radius=self.radius, track=self.track, wheelbase=self.wheelbase)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The rear wheels, left and right, then the steering."""
        return (self.left, self.right, *self.steering)

    def velocity(self, before: Mapping[str, float], after: Mapping[str, float], dt_s: float) -> WheelVelocity:
        """As ``Wheels.velocity``; the yaw rate is that of the mean steering angle."""
        turns = [_turn(before[name], after[name]) for name in (self.left, self.right)]
        speed = self.radius * 0.5 * sum(turns) / dt_s
        curvatures = [
            tangent / (self.wheelbase + y * tangent)
            for name, y in zip(self.steering, self._steering_y(), strict=True)
            for tangent in (math.tan(0.5 * (before[name] + after[name])),)
        ]
        return _rolling(speed, speed * sum(curvatures) / len(curvatures), self.noise)

    def joint_velocities(self, linear: ArrayLike, angular: ArrayLike) -> dict[str, float]:
        """As ``Wheels.joint_velocities``, of the rear wheels; ``steering_angles`` has the others."""
        speed, _, yaw_rate = _planar(linear, angular, can_drive_sideways=False)
        if abs(speed) < _STANDING < abs(yaw_rate):
            raise InvalidInput(
                f"a base with steered wheels turns only as it drives; got {yaw_rate:g} rad/s at rest"
            )
        return _axle_rates((self.left,), (self.right,), self.radius, self.track, speed, yaw_rate)

    def steering_angles(self, linear: ArrayLike, angular: ArrayLike) -> dict[str, float]:
        """The positions of the steering joints [rad] at such a velocity, zero at rest. Raises alike."""
        self.joint_velocities(linear, angular)
        speed, _, yaw_rate = _planar(linear, angular, can_drive_sideways=False)
        curvature = yaw_rate / speed if abs(speed) > _STANDING else 0.0
        return {
            name: math.atan(self.wheelbase * curvature / (1.0 - y * curvature))
            for name, y in zip(self.steering, self._steering_y(), strict=True)
        }

    def _steering_y(self) -> tuple[float, ...]:
        return (0.0,) if len(self.steering) == 1 else (0.5 * self.track, -0.5 * self.track)


@dataclass(frozen=True, slots=True)
class Mecanum:
    """Four wheels with rollers at 45 degrees, which form an X from above; their middle is the origin of
    ``frame``.

    ``front_left``, ``front_right``, ``rear_left`` and ``rear_right`` are their joints. ``track`` and
    ``wheelbase`` [m] are the distances of the wheels across and along, ``radius`` and ``noise`` as of
    ``DiffDrive``. With k = (track + wheelbase) / 2 the wheels have the rates (vx -+ vy -+ k w) / r (Taheri,
    Qiao, Ghaeminezhad, "Kinematic model of a four Mecanum wheeled mobile robot", IJCA 113 (2015)).
    """

    front_left: str
    front_right: str
    rear_left: str
    rear_right: str
    radius: float
    track: float
    wheelbase: float
    noise: WheelNoise = WheelNoise()
    frame: str | None = None

    def __post_init__(self) -> None:
        _check_geometry(self.joint_names, radius=self.radius, track=self.track, wheelbase=self.wheelbase)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Front left, front right, rear left, rear right."""
        return (self.front_left, self.front_right, self.rear_left, self.rear_right)

    def velocity(self, before: Mapping[str, float], after: Mapping[str, float], dt_s: float) -> WheelVelocity:
        """As ``Wheels.velocity``, by least squares of the four wheels."""
        scale = 0.25 * self.radius / dt_s
        fl, fr, rl, rr = (scale * _turn(before[name], after[name]) for name in self.joint_names)
        along, across, turning = fl + fr + rl + rr, -fl + fr + rl - rr, -fl + fr - rl + rr
        return WheelVelocity(
            np.array([along, across, 0.0]),
            np.array([0.0, 0.0, turning / self._lever]),
            self.noise.covariance(along, across, has_lateral=False),
        )

    def joint_velocities(self, linear: ArrayLike, angular: ArrayLike) -> dict[str, float]:
        """As ``Wheels.joint_velocities``: along x and y, and about z."""
        along, across, yaw_rate = _planar(linear, angular, can_drive_sideways=True)
        turning = self._lever * yaw_rate
        speeds = (
            along - across - turning,
            along + across + turning,
            along + across - turning,
            along - across + turning,
        )
        return {name: speed / self.radius for name, speed in zip(self.joint_names, speeds, strict=True)}

    @property
    def _lever(self) -> float:
        return 0.5 * (self.track + self.wheelbase)


def check_wheel_positions(wheels: Wheels, positions: Mapping[str, float]) -> dict[str, float]:
    """The positions of the joints of ``wheels``.

    Raises InvalidInput for missing ones, for NaN and above 1e9 rad, where doubles resolve 1e-7 rad.
    """
    missing = [name for name in wheels.joint_names if name not in positions]
    if missing:
        near = did_you_mean(missing[0], positions)
        raise InvalidInput(f"joint positions lack {', '.join(map(repr, missing))} of the wheels{near}")
    found = {name: float(positions[name]) for name in wheels.joint_names}
    if bad := [f"{name!r} ({value})" for name, value in found.items() if not abs(value) <= _MOST_TURNED]:
        raise InvalidInput(
            f"positions of wheels must be finite, at most {_MOST_TURNED:g} rad; not so: {', '.join(bad)}"
        )
    return found


def displacement(measured: WheelVelocity, seconds: float) -> tuple[Floats, float]:
    """The way in the axes at its beginning [m], (3,), and the turn [rad] of a mean velocity of ``seconds``.

    It is an arc: the integral of a velocity that turns evenly.
    """
    turn = float(measured.angular[2]) * seconds
    way = measured.linear * seconds
    sine = math.sin(turn) / turn if abs(turn) > 1e-6 else 1.0
    versine = (1.0 - math.cos(turn)) / turn if abs(turn) > 1e-6 else 0.5 * turn
    x, y, z = way.tolist()
    return np.array((sine * x - versine * y, versine * x + sine * y, z)), turn


def _rolling(speed: float, yaw_rate: float, noise: WheelNoise) -> WheelVelocity:
    """The velocity of a base that cannot drive sideways."""
    return WheelVelocity(np.array([speed, 0.0, 0.0]), np.array([0.0, 0.0, yaw_rate]), noise.covariance(speed))


def _axle_rates(  # noqa: PLR0917 - the numbers of one axle
    left: Sequence[str], right: Sequence[str], radius: float, track: float, speed: float, yaw_rate: float
) -> dict[str, float]:
    across = 0.5 * track * yaw_rate
    rates = dict.fromkeys(left, (speed - across) / radius)
    return rates | dict.fromkeys(right, (speed + across) / radius)


def _turn(before: float, after: float) -> float:
    """The rotation between two positions of a wheel [rad].

    Positions that are both within a half turn of zero may have wrapped, as drivers of continuous joints do:
    the rotation is then the shorter one. Beyond, they are counted on, and any rotation is possible.
    """
    turn = after - before
    if abs(before) <= _TURN_LIMIT and abs(after) <= _TURN_LIMIT:
        return math.remainder(turn, math.tau)
    return turn


def _names(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _check_geometry(joints: tuple[str, ...], **lengths: float) -> None:
    if len(set(joints)) < len(joints) or len(joints) < 2 or not all(joints):
        raise InvalidInput(f"wheels have a joint each; got {', '.join(map(repr, joints))}")
    for name, length in lengths.items():
        if not 0.0 < length < math.inf:
            raise InvalidInput(f"the {name} of wheels is a length [m] above zero; got {length!r}")


def _planar(linear: ArrayLike, angular: ArrayLike, *, can_drive_sideways: bool) -> tuple[float, float, float]:
    """vx, vy and the yaw rate of a velocity that wheels on a floor can drive."""
    velocity, rate = real_numbers(linear, "a linear velocity"), real_numbers(angular, "an angular velocity")
    if velocity.shape != (3,) or rate.shape != (3,) or not np.isfinite([velocity, rate]).all():
        raise InvalidInput(
            f"velocities are three finite numbers each; got linear={linear}, angular={angular}"
        )
    x, y, z = velocity.tolist()
    about_x, about_y, about_z = rate.tolist()
    others = [z, about_x, about_y] if can_drive_sideways else [y, z, about_x, about_y]
    if any(abs(other) > _STANDING for other in others):
        ways = "x, y and about z" if can_drive_sideways else "x and about z"
        raise InvalidInput(
            f"these wheels drive along {ways} only; got linear={[x, y, z]}, angular={rate.tolist()}"
        )
    return x, y, about_z
