"""Setpoints on the way to a target that keep velocities, accelerations, positions and efforts within limits.

Each joint has a setpoint p and a velocity v, that of its last step. A step of dt moves it by v' dt. While v'
falls by a dt in every later step, of any length, the setpoint travels at most v'^2 / (2 a) until it rests,
since (v - a dt) dt <= (v^2 - (v - a dt)^2) / (2 a). So it can stop within the distance d to a target, or to
a position limit, if

    v' dt + v'^2 / (2 a) <= d,  that is  v' <= 2 d / (dt + sqrt(dt^2 + 2 d / a))

which later steps can fulfil again without a change of velocity above a dt, whatever their lengths are.

In mode "velocity" p is measured, and the joint follows v with a lag, of a time constant t up to 50 ms. There

    v' (dt + s) + g(v') <= d,  g(v) = v T up to v = a T, and v^2 / (2 a) + a T^2 / 2 above it,  T = 0.2 s

so that v falls in proportion to the distance from a position limit, unless a is too low for that. p + t p' of
such a joint moves with v, and p' is at most v (1 + t / T) while it brakes: with s = t (1 + t / T) the joint
arrives at its limit at rest. If its host pauses for T it does not pass the limit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import compress
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from zstate.checks import Floats
from zstate.driving.driver import Mode
from zstate.driving.limits import ROUNDING, Limits
from zstate.errors import InvalidInput

_UNBOUNDED = 1e100
"""In place of infinity, whose product with zero is NaN."""


_ARRIVAL_S = 0.2
_LAG_S = 0.05 * (1.0 + 0.05 / _ARRIVAL_S)
"""T and s of the rule for velocities near a position limit."""

_FILTER_S = 0.02
"""Time constant of velocities that are derived from measured positions."""

_LONGEST_GAP_S = 0.1
"""After a longer time between two readings, no velocity is derived from them."""


class JointRate(NamedTuple):
    """The command of a joint in mode "velocity", per s, or "effort" [Nm] or [N]."""

    mode: Mode
    value: float


Rates: TypeAlias = Mapping[int, JointRate | None]
"""Commands by the column of the joint; None where one has expired, and the joint is to rest."""

_TO_TARGET = JointRate("position", 0.0)
_NO_RATES: Rates = {}


class Limited(NamedTuple):
    """The next setpoint: ``positions`` (n,) [rad] or [m] and ``velocities`` (n,) of the step, per s.

    ``limited`` are the joints that are short of their commands because a limit slowed them. ``efforts`` (n,)
    [Nm] or [N] are None while no joint is in mode "effort"; ``modes`` has that of each joint. ``braked`` has
    a text for each joint that was taken out of mode "effort" by this step.
    """

    positions: Floats
    velocities: Floats
    limited: tuple[str, ...]
    efforts: Floats | None
    modes: tuple[Mode, ...]
    braked: tuple[str, ...] = ()


class _Joint:
    """The limits of one joint, none of which is infinite."""

    def __init__(
        self, lower: float, upper: float, velocity: float, acceleration: float, effort: float
    ) -> None:
        self._lower, self._upper = lower, upper
        self._velocity, self._acceleration = velocity, acceleration
        self._effort = effort
        self.has_range = lower > -_UNBOUNDED or upper < _UNBOUNDED

    def closing(self, gap: float, dt_s: float) -> float:
        """The greatest velocity of a step after which the joint can stop at the end of ``gap``."""
        return math.copysign(self._braking_velocity(abs(gap), dt_s), gap) if gap else 0.0

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

    def turn(self, position: float, before: float, wanted: float, dt_s: float) -> tuple[float, float]:
        """The same in mode "velocity", from the measured ``position``.

        The velocity never changes by more than the acceleration allows, also where the joint was pushed.
        """
        change = self._acceleration * dt_s
        least, most = max(before - change, -self._velocity), min(before + change, self._velocity)
        velocity = min(max(wanted, least), most)
        if velocity > 0.0:
            velocity = max(min(velocity, self._arriving(self._upper - position, dt_s)), least)
        elif velocity < 0.0:
            velocity = min(max(velocity, -self._arriving(position - self._lower, dt_s)), most)
        return position + velocity * dt_s, velocity

    def push(self, position: float, velocity: float, wanted: float) -> float:
        """The allowed effort nearest to ``wanted``: inwards if outside, against the motion if too fast."""
        least, most = -self._effort, self._effort
        if velocity > self._velocity or position > self._upper:
            most = 0.0
        if velocity < -self._velocity or position < self._lower:
            least = 0.0
        return min(max(wanted, least), most)

    def moved(self, position: float, velocity: float, dt_s: float) -> float:
        """Where the joint is expected ``dt_s`` later, at the velocity limit at most."""
        return position + min(max(velocity, -self._velocity), self._velocity) * dt_s

    def is_exceeded(self, position: float, velocity: float) -> bool:
        """Whether the joint is outside its range, or too fast."""
        is_inside = self._lower - ROUNDING <= position <= self._upper + ROUNDING
        return not is_inside or abs(velocity) > self._velocity * (1.0 + ROUNDING)

    def stoppable(self, position: float, velocity: float) -> float:
        """The velocity nearest to ``velocity`` from which the joint can stop within its limits."""
        room = self._upper - position if velocity > 0.0 else position - self._lower
        most = min(self._velocity, math.sqrt(2.0 * self._acceleration * max(room, 0.0)))
        return min(max(velocity, -most), most)

    def _braking_velocity(self, distance: float, dt_s: float) -> float:
        """The greatest speed of a step after which the joint can stop within ``distance``."""
        doubled = 2.0 * distance
        return doubled / (dt_s + math.sqrt(dt_s**2 + doubled / self._acceleration))

    def _arriving(self, room: float, dt_s: float) -> float:
        """The greatest speed of a step in mode "velocity" at the distance ``room`` from a position limit."""
        if room <= 0.0:
            return 0.0
        steepest = self._acceleration * _ARRIVAL_S
        speed = room / (dt_s + _LAG_S + _ARRIVAL_S)
        if speed <= steepest:
            return speed
        return self._braking_velocity(room - 0.5 * steepest * _ARRIVAL_S, dt_s + _LAG_S)


class SetpointLimiter:
    """Moves the joints of ``limits`` towards targets, step by step; for one thread.

    A step is never longer than ``velocity * dt_s``, and never changes a velocity by more than
    ``acceleration * dt_s``. Joints brake in time for the target and for their position limits; a joint that
    is outside its limits never moves further out. Vectors are (n,), in the order of ``limits.joint_names``.

    ``modes`` are those of the driver, and ``step`` takes ``Rates`` of joints in mode "velocity" or "effort",
    which ``observe`` follows. Another mode starts where the joint is then, with its velocity. A joint whose
    command has expired comes to rest: from mode "velocity" in that mode, and holds its position 0.2 s later
    if it has a range and the driver has mode "position"; from mode "effort" in mode "position", or else
    "velocity", or else without effort. The same happens to a joint in mode "effort" that leaves its range or
    exceeds its velocity limit, until its command has expired or has another mode; a driver that has mode
    "effort" only gets efforts inwards, or against the motion.
    """

    def __init__(self, limits: Limits, modes: Collection[Mode] = ("position",)) -> None:
        self._limits = limits
        bounds = (limits.lower, limits.upper, limits.velocity, limits.acceleration, limits.effort)
        self._joints = [_Joint(*row) for row in zip(*(_bounded(bound) for bound in bounds), strict=True)]
        # Numbers, not arrays: numpy takes longer for a call than for the arithmetic of 30 joints.
        self._positions: list[float] | None = None
        self._velocities = [0.0] * len(self._joints)
        self._efforts = [0.0] * len(self._joints)
        self._rested_s = [0.0] * len(self._joints)
        """For how long joints in mode "velocity" have had zero velocity."""
        ranked: tuple[Mode, ...] = ("position", "velocity", "effort")
        self._resting_mode: Mode = next(mode for mode in ranked if mode in modes)
        self._all_resting = (self._resting_mode,) * len(self._joints)
        self._modes = list(self._all_resting)
        self.has_positions_only = self._resting_mode == "position"
        """Whether all joints are in mode "position" now."""
        self._braked: dict[int, str] = {}
        """Why joints are held that are commanded in mode "effort"."""
        self._observed: tuple[list[float], int] | None = None
        self._is_doubtful = False
        """Whether the joints may be elsewhere than was observed."""

    def start(self, positions: ArrayLike, velocities: ArrayLike | None = None) -> Limited:
        """Sets the setpoint to what is there now, after any change of state; at rest without ``velocities``.

        A joint outside its limits is accepted. Velocities are reduced to the velocity limits, and to those
        from which the joints can stop within their position limits. All joints are in mode "position" if the
        driver has it, or else in "velocity", or else in "effort" without any. Returns the setpoint. Raises
        InvalidInput for other shapes and for numbers that are not finite; nothing changes then.
        """
        start = self._limits.vector(positions, "positions").tolist()
        given = [0.0] * len(start)
        if velocities is not None:
            given = self._limits.vector(velocities, "velocities").tolist()
        moving = zip(self._joints, start, given, strict=True)
        self._velocities = [joint.stoppable(position, velocity) for joint, position, velocity in moving]
        self._positions = start
        self._efforts = [0.0] * len(start)
        self._set_modes(self._all_resting)
        self._is_doubtful = False
        self._braked.clear()
        return self._limited(start, [False] * len(start))

    def resume(self, last: Limited, dt_s: float) -> None:
        """Goes back to ``last``, of this limiter, as no later setpoint was written for ``dt_s`` [s].

        Joints in other modes than "position" have moved on with their velocities, unless they are observed.
        """
        moving = zip(last.positions.tolist(), last.velocities.tolist(), last.modes, strict=True)
        self._positions = [here if mode == "position" else here + rate * dt_s for here, rate, mode in moving]
        self._velocities = last.velocities.tolist()
        self._efforts = [0.0] * len(self._joints) if last.efforts is None else last.efforts.tolist()
        self._set_modes(last.modes)

    def observe(self, positions: Floats, velocities: Floats | None, now: int) -> None:
        """The joints were measured at ``positions`` (n,), at ``now`` [ns, monotonic].

        Joints in other modes than "position" are there now, and move on until the next call. Velocities of
        joints in mode "effort" are derived from the positions if not given.
        """
        before, self._observed = self._observed, (positions.tolist(), now)
        self._is_doubtful = False
        if self.has_positions_only or self._positions is None:
            return
        found = self._observed[0]
        dt_s = 0.0 if before is None else (now - before[1]) * 1e-9
        for column, mode in enumerate(self._modes):
            if mode == "position":
                continue
            self._positions[column] = found[column]
            if mode != "effort":
                continue
            if velocities is not None:
                self._velocities[column] = float(velocities[column])
            elif before is not None and 0.0 < dt_s < _LONGEST_GAP_S:
                rate = (found[column] - before[0][column]) / dt_s
                self._velocities[column] += (rate - self._velocities[column]) * dt_s / (dt_s + _FILTER_S)

    def doubt(self) -> None:
        """No joint enters mode "position" until the next ``observe``: it may be elsewhere, and would jump."""
        self._is_doubtful = True

    def check_rates(self, rates: Rates) -> None:
        """Raises InvalidInput for efforts of joints that have no effort limit."""
        unlimited = [
            f"{self._limits.joint_names[column]!r} ({self._limits.effort[column]:g})"
            for column, rate in rates.items()
            if rate is not None and rate.mode == "effort" and not 0.0 < self._limits.effort[column] < math.inf
        ]
        if unlimited:
            raise InvalidInput(
                f"efforts are commanded within limits, and these joints have none: {', '.join(unlimited)}; "
                "start the driver with limits=Limits.of(model, effort=...)"
            )

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

    def step(
        self, target: ArrayLike, dt_s: float, velocities: ArrayLike | None = None, rates: Rates = _NO_RATES
    ) -> Limited:
        """The setpoint after ``dt_s`` [s] towards the positions ``target``, which ``check`` has accepted.

        The target is at rest: a joint overshoots it only if it is too fast to stop there when the target
        changes. With ``velocities`` it moves, and passes its positions at the end of the step; one that keeps
        the limits of velocity and acceleration is followed without a lag, once it is reached. Joints of
        ``rates`` follow these instead. Raises InvalidInput for other shapes, for numbers that are not finite,
        and before ``start``.
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
        if rates or not self.has_positions_only:
            return self._step_in_modes(goal, wanted, rates, dt_s)
        positions = self._move(start, wanted, dt_s)
        left = [abs(there - here) > ROUNDING for there, here in zip(goal, positions, strict=True)]
        return self._limited(positions, left)

    def brake(self, dt_s: float) -> Limited:
        """The setpoint after ``dt_s`` [s] while all joints come to rest as soon as they can.

        ``limited`` are the joints that still move. Raises InvalidInput for a duration that is not above zero,
        and before ``start``.
        """
        start = self._started(dt_s)
        if not self.has_positions_only:
            return self._step_in_modes(start, start, dict.fromkeys(range(len(start))), dt_s)
        positions = self._move(start, [0.0] * len(start), dt_s)
        return self._limited(positions, [velocity != 0.0 for velocity in self._velocities])

    def _step_in_modes(self, goal: list[float], wanted: list[float], rates: Rates, dt_s: float) -> Limited:
        """The same step, of joints whose modes differ."""
        positions, velocities = list(self._started(dt_s)), self._velocities
        at_target = _TO_TARGET if self._resting_mode == "position" else None
        slowed: list[bool] = []
        known = set(self._braked)
        for column, joint in enumerate(self._joints):
            here = positions[column]
            rate = self._enter_mode(column, here, rates.get(column, at_target))
            mode, before, wish = self._modes[column], velocities[column], 0.0 if rate is None else rate.value
            if mode == "effort":
                self._efforts[column] = joint.push(here, before, wish)
                positions[column] = joint.moved(here, before, dt_s)
                left = wish - self._efforts[column]
            elif mode == "velocity":
                positions[column], velocities[column] = joint.turn(here, before, wish, dt_s)
                self._rested_s[column] = self._rested_s[column] + dt_s if velocities[column] == 0.0 else 0.0
                left = wish - velocities[column]
            else:
                wish = 0.0 if rate is None else wanted[column]
                positions[column], velocities[column] = joint.step(here, before, wish, dt_s)
                left = velocities[column] if rate is None else goal[column] - positions[column]
            slowed.append(abs(left) > ROUNDING or column in self._braked)
        self._positions = positions
        self._set_modes(self._modes)
        braked = tuple(text for column, text in self._braked.items() if column not in known)
        return self._limited(positions, slowed)._replace(braked=braked)

    def _enter_mode(self, column: int, here: float, rate: JointRate | None) -> JointRate | None:
        """Sets the mode of a joint for its next setpoint; returns its command, None if it is to rest."""
        joint, before = self._joints[column], self._modes[column]
        if rate is None or rate.mode != "effort":
            self._braked.pop(column, None)
        elif self._resting_mode != "effort" and joint.is_exceeded(here, self._velocities[column]):
            self._braked.setdefault(column, self._excess_text(column, here))
        if column in self._braked:
            rate = None
        mode = self._mode_at_rest(column) if rate is None else rate.mode
        if self._is_doubtful and mode == "position" != before:
            mode, rate = before, None
        self._modes[column] = mode
        if before != mode:
            self._rested_s[column] = 0.0
        if before == "effort" != mode:
            self._velocities[column] = joint.stoppable(here, self._velocities[column])
            self._efforts[column] = 0.0
        return rate

    def _mode_at_rest(self, column: int) -> Mode:
        """The mode in which a joint comes to rest, or stays at rest.

        A joint that follows its velocities with a lag moves on for a while, before its position is held.
        """
        mode = self._modes[column]
        is_held = self._rested_s[column] > _ARRIVAL_S and self._joints[column].has_range
        return self._resting_mode if mode == "effort" or (mode == "velocity" and is_held) else mode

    def _excess_text(self, column: int, here: float) -> str:
        limits, velocity = self._limits, self._velocities[column]
        unit, most = limits.units[column], limits.velocity[column]
        problems = [f"moves at {velocity:.3g} {unit}/s, above {most:g}"] if abs(velocity) > most else []
        if not limits.lower[column] <= here <= limits.upper[column]:
            problems.append(f"is at {here:.4g} {unit}, outside {limits.range_text(column)}")
        name = limits.joint_names[column]
        return f"{name!r} in mode effort {' and '.join(problems)}: it is held until its efforts end"

    def _set_modes(self, modes: Sequence[Mode]) -> None:
        self._modes = list(modes)
        self.has_positions_only = all(mode == "position" for mode in modes)

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
        vectors = np.array(positions), np.array(self._velocities)
        if self.has_positions_only:
            return Limited(*vectors, limited, None, self._all_resting)
        efforts = np.array(self._efforts) if "effort" in self._modes else None
        return Limited(*vectors, limited, efforts, tuple(self._modes))

    def _outside_texts(self, positions: list[float]) -> tuple[str, ...]:
        return tuple(
            f"{text} already, and the joint may only move inwards"
            for text in self._limits.position_findings(np.array(positions))
        )


def _bounded(limits: Floats) -> list[float]:
    return np.clip(limits, -_UNBOUNDED, _UNBOUNDED).tolist()
