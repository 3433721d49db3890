"""Test motion of a mobile base: two driven wheels, a square with rounded corners, constant speed.

Each quarter of a lap is a straight line and an arc. With the distance d since the quarter began, the length s
of the line and the radius r of the arc, the pose in the frame in which the quarter begins is

    (d, 0, 0) if d <= s, else (s + r sin a, r (1 - cos a), a) with a = (d - s) / r

and the next quarter begins at (s + r, r, pi / 2).
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from zstate.errors import InvalidInput
from zstate.sources.joint_source import JointReading
from zstate.transform import Transform

# Cosine and sine of the heading at the start of each quarter.
_HEADINGS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))


class SquareDriveState(NamedTuple):
    """Pose of a base in its odometry frame, and its twist in its own axes, x forward, z up.

    ``x`` and ``y`` [m]; ``yaw`` [rad], from 0 to 2 pi; ``speed`` along x [m/s], ``yaw_rate`` [rad/s]. The
    other components are zero: wheels that do not slip have no speed along their axle.
    """

    x: float
    y: float
    yaw: float
    speed: float
    yaw_rate: float


class WheelPair(NamedTuple):
    """Two driven wheels on one axle, ``track_m`` apart, whose middle is the origin of the base.

    A positive rotation of a wheel of ``radius_m`` drives forward.
    """

    radius_m: float
    track_m: float

    def roll(self, distance: float, turn: float) -> tuple[float, float]:
        """The rotations of the left and the right wheel [rad] that move the base without slip.

        The base moves ``distance`` [m] along its path and turns by ``turn`` [rad]: wheels at +-b/2 travel
        distance -+ b/2 turn (Siegwart et al., Introduction to Autonomous Mobile Robots, 2nd ed., 3.2.2).
        With speed and yaw rate instead, the rates of the wheels [rad/s].
        """
        across = 0.5 * self.track_m * turn
        return (distance - across) / self.radius_m, (distance + across) / self.radius_m


class SquareDrive:
    """A base drives a square with rounded corners, counterclockwise, one lap in ``period_s`` [s].

    ``wheels`` are the two that drive the base. A function of the stamp alone: programs that publish parts of
    the motion agree at every instant. The lap starts and ends at the identity in the odometry frame.
    ``side_m`` is the length of a side between the prolonged sides, ``corner_m`` the radius of the arcs.
    Raises InvalidInput if there is no such path.
    """

    def __init__(
        self, wheels: WheelPair, *, side_m: float = 1.5, corner_m: float = 0.4, period_s: float = 16.0
    ) -> None:
        if not (0.0 < 2.0 * corner_m <= side_m < math.inf and 0.0 < period_s < math.inf):
            raise InvalidInput(
                "a square has corners of a radius above zero, up to half its side, and a period above zero; "
                f"got corner_m={corner_m!r}, side_m={side_m!r}, period_s={period_s!r}"
            )
        self._wheels = wheels
        self._radius = corner_m
        self._straight = side_m - 2.0 * corner_m
        self._lap = 4.0 * self._straight + math.tau * corner_m
        self._period_ns = round(period_s * 1e9)
        self._speed = self._lap / (1e-9 * self._period_ns)
        turns = (rotation / math.tau for rotation in wheels.roll(self._lap, math.tau))
        # Exact, because the laps since 1970 are more than a float keeps apart from small rotations.
        self._turns_per_lap = [Fraction(turn) for turn in turns]

    def state(self, stamp: int) -> SquareDriveState:
        """Pose and twist at ``stamp`` [ns]."""
        quarter, along = divmod(4.0 * self._phase(stamp), 1.0)
        distance = 0.25 * along * self._lap
        angle = max(0.0, distance - self._straight) / self._radius
        ahead = min(distance, self._straight) + self._radius * math.sin(angle)
        left = self._radius * (1.0 - math.cos(angle))
        # Quarters are turned about the middle of the square.
        middle = 0.5 * self._straight, 0.5 * self._straight + self._radius
        cosine, sine = _HEADINGS[int(quarter)]
        ahead, left = ahead - middle[0], left - middle[1]
        return SquareDriveState(
            middle[0] + cosine * ahead - sine * left,
            middle[1] + sine * ahead + cosine * left,
            0.5 * math.pi * quarter + angle,
            self._speed,
            self._speed / self._radius if angle > 0.0 else 0.0,
        )

    def wheel_angles(self, stamp: int) -> tuple[float, float]:
        """The rotations of the left and the right wheel at ``stamp`` [ns], from -pi to pi [rad]."""
        laps = stamp // self._period_ns
        rotations = self._wheels.roll(self._phase(stamp) * self._lap, self.state(stamp).yaw)
        left, right = (
            math.remainder(math.tau * float(laps * turns % 1) + rotation, math.tau)
            for turns, rotation in zip(self._turns_per_lap, rotations, strict=True)
        )
        return left, right

    def wheel_rates(self, stamp: int) -> tuple[float, float]:
        """The rates of the left and the right wheel at ``stamp`` [ns], [rad/s]."""
        state = self.state(stamp)
        return self._wheels.roll(state.speed, state.yaw_rate)

    def _phase(self, stamp: int) -> float:
        """The part of the lap that is driven at ``stamp``, from 0 to 1."""
        return stamp % self._period_ns / self._period_ns


class WheelSource:
    """A joint source of the wheels of ``drive``: the left one first, with velocities."""

    def __init__(self, drive: SquareDrive) -> None:
        self._drive = drive

    def read(self, stamp: int) -> JointReading:
        """Positions and velocities at ``stamp`` [ns]."""
        return JointReading(
            np.array(self._drive.wheel_angles(stamp)), np.array(self._drive.wheel_rates(stamp))
        )


class OdometrySource:
    """A transform source of the pose of ``drive``: ``base`` in ``odom``."""

    def __init__(self, drive: SquareDrive, odom: str, base: str) -> None:
        self._drive = drive
        self._odom, self._base = odom, base

    def read(self, stamp: int) -> list[Transform]:
        """The edge at ``stamp`` [ns]."""
        state = self._drive.state(stamp)
        rotation = 0.0, 0.0, math.sin(0.5 * state.yaw), math.cos(0.5 * state.yaw)
        return [Transform(self._odom, self._base, (state.x, state.y, 0.0), rotation, stamp)]
