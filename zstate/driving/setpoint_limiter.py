"""Setpoints on the way to a target that keep velocities, accelerations and positions within limits.

Each joint has a setpoint p and a velocity v, that of its last step. A step of dt moves it by v' dt. While v'
falls by a dt in every later step, of any length, the setpoint travels at most v'^2 / (2 a) until it rests,
since (v - a dt) dt <= (v^2 - (v - a dt)^2) / (2 a). So it can stop within the distance d to a target, or to
a position limit, if

    v' dt + v'^2 / (2 a) <= d,  that is  v' <= 2 d / (dt + sqrt(dt^2 + 2 d / a))

which later steps can fulfil again without a change of velocity above a dt, whatever their lengths are.
"""

from __future__ import annotations

import math
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.driving.limits import ROUNDING, Limits
from zstate.errors import InvalidInput

Floats = NDArray[np.float64]

_UNBOUNDED = 1e100
"""In place of infinity, whose product with zero is NaN."""


class Limited(NamedTuple):
    """The next setpoint: ``positions`` (n,) [rad] or [m] and ``velocities`` (n,) of the step, per s.

    ``limited`` are the joints that are short of the target because a limit slowed them.
    """

    positions: Floats
    velocities: Floats
    limited: tuple[str, ...]


class _Joint:
    """The limits of one joint, none of which is infinite."""

    def __init__(self, lower: float, upper: float, velocity: float, acceleration: float) -> None:
        self._lower, self._upper = lower, upper
        self._velocity, self._acceleration = velocity, acceleration

    def closing(self, gap: float, dt_s: float) -> float:
        """The greatest velocity of a step after which the joint can stop at the end of ``gap``."""
        return math.copysign(self._braking_velocity(abs(gap), dt_s), gap)

    def following(self, distance: float, velocity: float, dt_s: float) -> float:
        """The velocity of a step towards a target that moves: its own, and that which closes the gap.

        A gap that one step can close and the next one can brake for is closed at once.
        """
        gap = distance - velocity * dt_s
        is_near = abs(gap) <= self._acceleration * dt_s**2
        return velocity + (gap / dt_s if is_near else self.closing(gap, dt_s))

    def step(self, position: float, before: float, wanted: float, dt_s: float) -> tuple[float, float]:
        """Position and velocity after a step, whose velocity is the allowed one nearest to ``wanted``."""
        change = self._acceleration * dt_s
        # Comparisons instead of min and max, whose calls would take most of the time of a tick.
        least, most = before - change, before + change
        least = least if least > -self._velocity else -self._velocity
        most = most if most < self._velocity else self._velocity
        velocity = most if wanted > most else least if wanted < least else wanted
        if velocity > 0.0:
            room = self._upper - position
            fastest = self._braking_velocity(room, dt_s) if room > 0.0 else 0.0
            velocity = velocity if velocity < fastest else fastest
            following = position + velocity * dt_s
            return (following if following < self._upper or room <= 0.0 else self._upper), velocity
        if velocity < 0.0:
            room = position - self._lower
            fastest = self._braking_velocity(room, dt_s) if room > 0.0 else 0.0
            velocity = velocity if velocity > -fastest else -fastest
            following = position + velocity * dt_s
            return (following if following > self._lower or room <= 0.0 else self._lower), velocity
        return position, 0.0

    def stoppable(self, position: float, velocity: float) -> float:
        """The velocity nearest to ``velocity`` from which the joint can stop within its limits."""
        room = self._upper - position if velocity > 0.0 else position - self._lower
        most = min(self._velocity, math.sqrt(2.0 * self._acceleration * max(room, 0.0)))
        return min(max(velocity, -most), most)

    def _braking_velocity(self, distance: float, dt_s: float) -> float:
        """The greatest speed of a step after which the joint can stop within ``distance``."""
        doubled = 2.0 * distance
        return doubled / (dt_s + math.sqrt(dt_s**2 + doubled / self._acceleration))


class SetpointLimiter:
    """Moves the joints of ``limits`` towards targets, step by step; for one thread.

    A step is never longer than ``velocity * dt_s``, and never changes a velocity by more than
    ``acceleration * dt_s``. Joints brake in time for the target and for their position limits; a joint that
    is outside its limits never moves further out. Vectors are (n,), in the order of ``limits.joint_names``.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        bounds = (limits.lower, limits.upper, limits.velocity, limits.acceleration)
        self._joints = [_Joint(*row) for row in zip(*(_bounded(bound) for bound in bounds), strict=True)]
        # Numbers, not arrays: numpy takes longer for a call than for the arithmetic of 30 joints.
        self._positions: list[float] | None = None
        self._velocities = [0.0] * len(self._joints)

    def start(self, positions: ArrayLike, velocities: ArrayLike | None = None) -> None:
        """Sets the setpoint to what is there now, after any change of state; at rest without ``velocities``.

        A joint outside its limits is accepted. Velocities are reduced to the velocity limits, and to those
        from which the joints can stop within their position limits. Raises InvalidInput for other shapes and
        for numbers that are not finite; nothing changes then.
        """
        start = self._limits.vector(positions, "positions").tolist()
        given = [0.0] * len(start)
        if velocities is not None:
            given = self._limits.vector(velocities, "velocities").tolist()
        moving = zip(self._joints, start, given, strict=True)
        self._velocities = [joint.stoppable(position, velocity) for joint, position, velocity in moving]
        self._positions = start

    def check(self, positions: ArrayLike) -> Floats:
        """``positions`` as a vector, if they may be a target.

        The limits of a joint that is outside them extend to its setpoint. Raises InvalidInput for other
        shapes, for numbers that are not finite, and for positions outside the limits, with the joints, their
        values and limits.
        """
        vector = self._limits.vector(positions, "positions")
        if self._positions is None:
            return self._limits.check_positions(vector)
        if not self._limits.position_findings(vector):
            return vector
        allowed = self._limits.containing(self._positions)
        if findings := allowed.position_findings(vector):
            raise InvalidInput("; ".join((*findings, *self._outside_texts(self._positions))))
        return vector

    def step(self, target: ArrayLike, dt_s: float, velocities: ArrayLike | None = None) -> Limited:
        """The setpoint after ``dt_s`` [s] towards the positions ``target``, which ``check`` has accepted.

        The target is at rest: a joint overshoots it only if it is too fast to stop there when the target
        changes. With ``velocities`` it moves, and passes its positions at the end of the step; one that keeps
        the limits of velocity and acceleration is followed without a lag, once it is reached. Raises
        InvalidInput for other shapes, for numbers that are not finite, and before ``start``.
        """
        start = self._started(dt_s)
        goal = self._limits.vector(target, "target positions").tolist()
        gaps = [there - here for there, here in zip(goal, start, strict=True)]
        if velocities is None:
            wanted = [joint.closing(gap, dt_s) for joint, gap in zip(self._joints, gaps, strict=True)]
        else:
            moving = zip(
                self._joints, gaps, self._limits.vector(velocities, "velocities").tolist(), strict=True
            )
            wanted = [joint.following(gap, velocity, dt_s) for joint, gap, velocity in moving]
        positions = self._move(start, wanted, dt_s)
        left = [abs(there - here) > ROUNDING for there, here in zip(goal, positions, strict=True)]
        return self._limited(positions, left)

    def brake(self, dt_s: float) -> Limited:
        """The setpoint after ``dt_s`` [s] while all joints come to rest as soon as they can.

        ``limited`` are the joints that still move. Raises InvalidInput for a duration that is not above zero,
        and before ``start``.
        """
        start = self._started(dt_s)
        positions = self._move(start, [0.0] * len(start), dt_s)
        return self._limited(positions, [velocity != 0.0 for velocity in self._velocities])

    def _move(self, start: list[float], wanted: list[float], dt_s: float) -> list[float]:
        """Makes a step with the velocities nearest to ``wanted`` that the limits allow; the new positions."""
        moving = zip(self._joints, start, self._velocities, wanted, strict=True)
        steps = [joint.step(here, before, wish, dt_s) for joint, here, before, wish in moving]
        self._positions = [position for position, _ in steps]
        self._velocities = [velocity for _, velocity in steps]
        return self._positions

    def _started(self, dt_s: float) -> list[float]:
        """The present setpoint, if ``dt_s`` is a duration."""
        if self._positions is None:
            raise InvalidInput("the limiter has no setpoint yet; call start(positions) first")
        if not 0.0 < dt_s < math.inf:
            raise InvalidInput(f"a step takes a duration above zero; got dt_s={dt_s!r}")
        return self._positions

    def _limited(self, positions: list[float], slowed: list[bool]) -> Limited:
        limited = tuple(compress(self._limits.joint_names, slowed))
        return Limited(np.array(positions), np.array(self._velocities), limited)

    def _outside_texts(self, positions: list[float]) -> tuple[str, ...]:
        return tuple(
            f"{text} already, and the joint may only move inwards"
            for text in self._limits.position_findings(np.array(positions))
        )


def _bounded(limits: Floats) -> list[float]:
    return np.clip(limits, -_UNBOUNDED, _UNBOUNDED).tolist()
