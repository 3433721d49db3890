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


class SetpointLimiter:
    """Moves the joints of ``limits`` towards targets, step by step; for one thread.

    A step is never longer than ``velocity * dt_s``, and never changes a velocity by more than
    ``acceleration * dt_s``. Joints brake in time for the target and for their position limits; a joint that
    is outside its limits never moves further out. Vectors are (n,), in the order of ``limits.joint_names``.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._lower, self._upper = _bounded(limits.lower), _bounded(limits.upper)
        self._velocity, self._acceleration = _bounded(limits.velocity), _bounded(limits.acceleration)
        self._positions: Floats | None = None
        self._velocities = np.zeros(len(limits.joint_names))

    def start(self, positions: ArrayLike, velocities: ArrayLike | None = None) -> None:
        """Sets the setpoint to what is there now, after any change of state; at rest without ``velocities``.

        A joint outside its limits is accepted. Velocities are reduced to the velocity limits, and to those
        from which the joints can stop within their position limits. Raises InvalidInput for other shapes and
        for numbers that are not finite; nothing changes then.
        """
        start = self._limits.vector(positions, "positions").copy()
        given = np.zeros(len(start)) if velocities is None else self._limits.vector(velocities, "velocities")
        below, above = self._room(start)
        self._velocities = _clip(given, -self._stoppable(below), self._stoppable(above))
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
        goal = self._limits.vector(target, "target positions")
        if velocities is None:
            ahead = goal - start
            wanted = np.copysign(self._braking_velocity(np.abs(ahead), dt_s), ahead)
        else:
            wanted = self._following(goal - start, self._limits.vector(velocities, "velocities"), dt_s)
        positions = self._move(start, wanted, dt_s)
        return self._limited(positions, np.abs(goal - positions) > ROUNDING)

    def brake(self, dt_s: float) -> Limited:
        """The setpoint after ``dt_s`` [s] while all joints come to rest as soon as they can.

        ``limited`` are the joints that still move. Raises InvalidInput for a duration that is not above zero,
        and before ``start``.
        """
        start = self._started(dt_s)
        positions = self._move(start, np.zeros(len(start)), dt_s)
        return self._limited(positions, self._velocities != 0.0)

    def _following(self, distance: Floats, velocities: Floats, dt_s: float) -> Floats:
        """Velocities of a step towards a target that moves: its own, and those that close the gap.

        A gap that one step can close and the next one can brake for is closed at once.
        """
        gap = distance - velocities * dt_s
        closing = np.copysign(self._braking_velocity(np.abs(gap), dt_s), gap)
        is_near = np.abs(gap) <= self._acceleration * dt_s**2
        return velocities + np.where(is_near, gap / dt_s, closing)

    def _move(self, start: Floats, wanted: Floats, dt_s: float) -> Floats:
        """Makes a step with the velocities nearest to ``wanted`` that the limits allow; the new positions."""
        below, above = self._room(start)
        change = self._acceleration * dt_s
        velocities = _clip(wanted, -self._velocity, self._velocity)
        velocities = _clip(velocities, self._velocities - change, self._velocities + change)
        slowest, fastest = -self._braking_velocity(below, dt_s), self._braking_velocity(above, dt_s)
        self._velocities = _clip(velocities, slowest, fastest)
        self._positions = _clip(start + self._velocities * dt_s, start - below, start + above)
        return self._positions

    def _room(self, positions: Floats) -> tuple[Floats, Floats]:
        """The distances to the lower and the upper limits; zero in the direction in which one is exceeded."""
        return np.maximum(positions - self._lower, 0.0), np.maximum(self._upper - positions, 0.0)

    def _braking_velocity(self, distance: Floats, dt_s: float) -> Floats:
        """The greatest velocity of a step after which a joint can stop within ``distance``."""
        return 2.0 * distance / (dt_s + np.sqrt(dt_s**2 + 2.0 * distance / self._acceleration))

    def _stoppable(self, distance: Floats) -> Floats:
        """The greatest allowed velocity before a step from which a joint can stop within ``distance``."""
        return np.minimum(self._velocity, np.sqrt(2.0 * self._acceleration * distance))

    def _started(self, dt_s: float) -> Floats:
        """The present setpoint, if ``dt_s`` is a duration."""
        if self._positions is None:
            raise InvalidInput("the limiter has no setpoint yet; call start(positions) first")
        if not 0.0 < dt_s < math.inf:
            raise InvalidInput(f"a step takes a duration above zero; got dt_s={dt_s!r}")
        return self._positions

    def _limited(self, positions: Floats, slowed: NDArray[np.bool_]) -> Limited:
        names = self._limits.joint_names
        limited = tuple(names[row] for row in np.flatnonzero(slowed).tolist())
        return Limited(positions.copy(), self._velocities.copy(), limited)

    def _outside_texts(self, positions: Floats) -> tuple[str, ...]:
        return tuple(
            f"{text} already, and the joint may only move inwards"
            for text in self._limits.position_findings(positions)
        )


def _clip(values: Floats, lowest: ArrayLike, highest: ArrayLike) -> Floats:
    # A third of the time of np.clip for a few joints.
    return np.minimum(np.maximum(values, lowest), highest)


def _bounded(limits: Floats) -> Floats:
    return _clip(limits, -_UNBOUNDED, _UNBOUNDED)
