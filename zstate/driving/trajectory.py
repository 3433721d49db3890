"""Smooth motion through timed points: polynomials between them, their extrema, and limits.

Let s run from 0 to 1 in a segment of the duration h, from position p to q, d = q - p, with the velocities v
and w, and the accelerations a and b at its ends. Its cubic has the coefficients, of s^0 to s^3,

    p,  h v,  3 d - h (2 v + w),  h (v + w) - 2 d

and its quintic, of s^0 to s^5,

    p,  h v,  h^2 a / 2,  10 d - h (6 v + 4 w) - h^2 (3 a - b) / 2,
    -15 d + h (8 v + 7 w) + h^2 (3 a - 2 b) / 2,  6 d - 3 h (v + w) - h^2 (a - b) / 2

(Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2.1). Positions alone become
the cubics whose accelerations are continuous, and whose velocities are zero at the end, and zero or given at
the start: those at the points between, m, solve, with the slopes d / h of the segments before (1) and after
(2),

    h2 m[i-1] + 2 (h1 + h2) m[i] + h1 m[i+1] = 3 (h2 d1 / h1 + h1 d2 / h2)

(de Boor, A Practical Guide to Splines, IV). Its matrix is tridiagonal and diagonally dominant.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.format import suggestion_text
from zstate.checks import Floats, real_numbers
from zstate.driving.limits import ROUNDING, Limits, check_joint_names
from zstate.errors import InvalidInput
from zstate.model.robot import near_joint

_LEAST_LEADING = 1e-8
"""The least leading coefficient, as a part of the largest. Adds a root far outside of 0 to 1 to a polynomial
of a lower degree, and moves the others by as little: values at extrema change by its square."""

_NO_SIZE = 1e-200
"""Largest coefficient of a polynomial that counts as zero."""


class Trajectory:
    """The motion of the joints ``joint_names`` through ``points``, (T, n), at the times ``times_s``, (T,).

    Positions [rad] or [m] alone are joined by a cubic spline with continuous accelerations, at rest at the
    last point, and at rest or with ``start_velocities``, (n,), at the first. With ``velocities``, (T, n) per
    s, segments are cubics that have them at the points; with ``accelerations``, (T, n) per s^2, as well, they
    are quintics. Times [s] count from the start of the motion and ascend from zero or later. Raises
    InvalidInput for less than two points, other shapes, numbers that are not finite, times that do not
    ascend, accelerations without velocities, and both kinds of velocities.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        points: ArrayLike,
        times_s: ArrayLike,
        velocities: ArrayLike | None = None,
        accelerations: ArrayLike | None = None,
        *,
        start_velocities: ArrayLike | None = None,
    ) -> None:
        self.joint_names = check_joint_names(joint_names)
        self._times = _check_times(times_s)
        self._points = self._check_rows(points, "points")
        self._velocities = None if velocities is None else self._check_rows(velocities, "velocities")
        self._accelerations = (
            None if accelerations is None else self._check_rows(accelerations, "accelerations")
        )
        if self._velocities is None and self._accelerations is not None:
            raise InvalidInput("accelerations at the points need velocities as well")
        self._start_velocities = self._check_start(start_velocities)
        self._durations = np.diff(self._times)
        with np.errstate(all="ignore"):
            self._coefficients = self._position_coefficients()
        if not all(np.isfinite(coefficients).all() for coefficients in self._coefficients):
            raise InvalidInput(
                f"the points are too far apart for times as close as {self._durations.min():g} s: "
                "velocities or accelerations exceed the largest number"
            )

    @property
    def duration_s(self) -> float:
        """The time of the last point [s], when the motion ends."""
        return float(self._times[-1])

    def sample(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Positions, velocities and accelerations at the times ``t_s`` [s], each (n,), or (N, n) of N times.

        Before the first and after the last point the joints rest there. Raises InvalidInput for times that
        are not finite.
        """
        times = real_numbers(t_s, "times of samples")
        if not np.isfinite(times).all():
            raise InvalidInput(f"times of samples must be finite; got {t_s!r}")
        segments = self._times[1:-1].searchsorted(times, side="right")
        along = (times - self._times[segments]) / self._durations[segments]
        along = np.minimum(np.maximum(along, 0.0), 1.0)[..., None]
        positions, velocities, accelerations = (
            _evaluated(coefficients[:, segments], along) for coefficients in self._coefficients
        )
        moves = ((times >= self._times[0]) & (times <= self._times[-1]))[..., None]
        return positions, velocities * moves, accelerations * moves

    def findings(self, limits: Limits) -> tuple[str, ...]:
        """The reasons why this motion must not be driven, at most four for each joint; empty if it may.

        A text for each joint's worst position, velocity and acceleration beyond ``limits``, at any time and
        not only at the points, with time, value and limit; and for one that is not at rest at the last point.
        For a robot outside its limits, pass ``limits.containing(positions)``. Raises InvalidInput for joints
        that ``limits`` does not have, with near misses, and for missing ones.
        """
        rows = self._rows(limits)
        return (
            *self._position_findings(limits, rows),
            *self._rate_findings(
                "moves", 1, limits.velocity[rows], [f"{limits.units[row]}/s" for row in rows]
            ),
            *self._rate_findings(
                "accelerates", 2, limits.acceleration[rows], [f"{limits.units[row]}/s^2" for row in rows]
            ),
            *self._end_findings([f"{limits.units[row]}/s" for row in rows]),
        )

    def stretched(self, limits: Limits) -> Trajectory:
        """The same path at a lower speed, by the least factor with which velocities and accelerations fit.

        The trajectory itself if they do. All times are multiplied by the factor f: velocities by 1 / f and
        accelerations by 1 / f^2. Positions outside ``limits`` remain findings. Raises InvalidInput as
        ``findings`` does.
        """
        rows = self._rows(limits)
        speed, acceleration = (np.abs(values).max(axis=0) for _, values in self._extrema[1:])
        factor = max(
            float((speed / limits.velocity[rows]).max()),
            math.sqrt(float((acceleration / limits.acceleration[rows]).max())),
        )
        if factor <= 1.0 + ROUNDING:
            return self
        return Trajectory(
            self.joint_names,
            self._points,
            self._times * factor,
            None if self._velocities is None else self._velocities / factor,
            None if self._accelerations is None else self._accelerations / factor**2,
            start_velocities=self._start_velocities / factor if self._velocities is None else None,
        )

    @cached_property
    def _extrema(self) -> tuple[tuple[Floats, Floats], ...]:
        """Times and values, (k, n), among which are the extrema of positions, velocities and accelerations.

        They are at the ends of segments, and at the roots of the derivative of each polynomial.
        """
        found: list[tuple[Floats, Floats]] = []
        for coefficients in self._coefficients:
            ends = np.broadcast_to(np.array([0.0, 1.0])[:, None, None], (2, *coefficients.shape[1:]))
            along = np.concatenate([ends, _roots_within(_derivative(coefficients))])
            times = self._times[:-1, None] + along * self._durations[:, None]
            values = _evaluated(coefficients[:, None], along)
            joints = len(self.joint_names)
            found.append((times.reshape(-1, joints), values.reshape(-1, joints)))
        return tuple(found)

    def _position_findings(self, limits: Limits, rows: list[int]) -> Iterator[str]:
        times, values = self._extrema[0]
        lower, upper = limits.bounds
        excess = np.maximum(lower[rows] - values, values - upper[rows])
        for column, (row, at) in enumerate(zip(rows, excess.argmax(axis=0).tolist(), strict=True)):
            if excess[at, column] > ROUNDING:
                value = float(values[at, column])
                yield (
                    f"{self.joint_names[column]!r} at {value:.9g} {limits.units[row]} is outside "
                    f"{limits.range_text(row)}, {times[at, column]:.6g} s after the start"
                    f"{limits.degrees_text(row, value)}"
                )

    def _rate_findings(self, verb: str, order: int, bounds: Floats, units: list[str]) -> Iterator[str]:
        times, values = self._extrema[order]
        for column, at in enumerate(np.abs(values).argmax(axis=0).tolist()):
            if abs(values[at, column]) > bounds[column] * (1.0 + ROUNDING):
                yield (
                    f"{self.joint_names[column]!r} {verb} at {values[at, column]:.9g} {units[column]}, above "
                    f"{bounds[column]:.9g}, {times[at, column]:.6g} s after the start"
                )

    def _end_findings(self, units: list[str]) -> Iterator[str]:
        if self._velocities is None:
            return
        for name, velocity, unit in zip(self.joint_names, self._velocities[-1].tolist(), units, strict=True):
            if abs(velocity) > ROUNDING:
                yield (
                    f"{name!r} moves at {velocity:.9g} {unit} at the last point, where it must rest, "
                    f"{self.duration_s:.6g} s after the start"
                )

    def _rows(self, limits: Limits) -> list[int]:
        """The index in ``limits`` of each joint."""
        rows = {name: row for row, name in enumerate(limits.joint_names)}
        problems = [
            f"unknown joint {name!r}{suggestion_text(near_joint(name, limits.joint_names))}"
            for name in self.joint_names
            if name not in rows
        ]
        if missing := [name for name in rows if name not in self.joint_names]:
            problems.append(f"missing: {', '.join(map(repr, missing))}")
        if problems:
            raise InvalidInput(f"joints of a trajectory: {'; '.join(problems)}")
        return [rows[name] for name in self.joint_names]

    def _position_coefficients(self) -> tuple[Floats, Floats, Floats]:
        """Coefficients (degree + 1, T - 1, n) of positions, velocities and accelerations in each segment.

        They are those of powers of s, in ascending order.
        """
        durations = self._durations[:, None]
        velocities = self._velocities
        if velocities is None:
            velocities = _spline_velocities(self._durations, self._points, self._start_velocities)
        start, distance = self._points[:-1], np.diff(self._points, axis=0)
        v, w = velocities[:-1] * durations, velocities[1:] * durations
        if self._accelerations is None:
            positions = np.stack([start, v, 3.0 * distance - 2.0 * v - w, v + w - 2.0 * distance])
        else:
            a, b = self._accelerations[:-1] * durations**2, self._accelerations[1:] * durations**2
            positions = np.stack(
                [
                    start,
                    v,
                    0.5 * a,
                    10.0 * distance - 6.0 * v - 4.0 * w - 1.5 * a + 0.5 * b,
                    -15.0 * distance + 8.0 * v + 7.0 * w + 1.5 * a - b,
                    6.0 * distance - 3.0 * (v + w) - 0.5 * (a - b),
                ]
            )
        speeds = _derivative(positions) / durations
        return positions, speeds, _derivative(speeds) / durations

    def _check_start(self, velocities: ArrayLike | None) -> Floats:
        """The velocities at the first point of positions alone, (n,)."""
        if velocities is None:
            return np.zeros(len(self.joint_names))
        if self._velocities is not None:
            raise InvalidInput("start_velocities are the first row of velocities; pass one of the two")
        start = real_numbers(velocities, "start_velocities").copy()
        if start.shape != (len(self.joint_names),) or not np.isfinite(start).all():
            raise InvalidInput(f"start_velocities are a finite number for each joint; got {velocities!r}")
        return start

    def _check_rows(self, values: ArrayLike, what: str) -> Floats:
        """``values`` as finite rows (T, n), one for each time."""
        rows = real_numbers(values, f"{what} of a trajectory").copy()
        shape = len(self._times), len(self.joint_names)
        if rows.shape != shape:
            raise InvalidInput(
                f"{what} have shape {shape}: a row for each of {shape[0]} times, with a number for each of "
                f"the joints {', '.join(self.joint_names)}; got {rows.shape}"
            )
        if not np.isfinite(rows).all():
            at, column = np.argwhere(~np.isfinite(rows))[0].tolist()
            raise InvalidInput(
                f"{what} must be finite; that of {self.joint_names[column]!r} is {rows[at, column]} at point "
                f"{at}, {self._times[at]:.6g} s"
            )
        return rows


def _check_times(times_s: ArrayLike) -> Floats:
    times = real_numbers(times_s, "times of a trajectory").copy()
    if times.ndim != 1 or len(times) < 2:
        raise InvalidInput(f"a trajectory has two points or more, with a time each; got times {times_s!r}")
    if not np.isfinite(times).all() or times[0] < 0.0:
        raise InvalidInput(f"times of a trajectory are finite and from zero on; got {times.tolist()}")
    falls = np.flatnonzero(~(np.diff(times) > 0.0)).tolist()
    if falls:
        at = falls[0] + 1
        raise InvalidInput(
            f"times of a trajectory must ascend; point {at} at {times[at]:.9g} s follows point {at - 1} at "
            f"{times[at - 1]:.9g} s"
        )
    return times


def _spline_velocities(durations: Floats, points: Floats, start: Floats) -> Floats:
    """Velocities at ``points`` of the cubic spline from the velocities ``start`` to rest, (T, n).

    Gaussian elimination of the tridiagonal system in the text at the top: downwards, then upwards.
    """
    slopes = np.diff(points, axis=0) / durations[:, None]
    velocities = np.zeros(points.shape)
    velocities[0] = start
    ratios = np.zeros(len(points))
    for row in range(1, len(points) - 1):
        before, after = durations[row - 1], durations[row]
        right = 3.0 * (after * slopes[row - 1] + before * slopes[row])
        pivot = 2.0 * (before + after) - after * ratios[row - 1]
        ratios[row] = before / pivot
        velocities[row] = (right - after * velocities[row - 1]) / pivot
    for row in range(len(points) - 2, 0, -1):
        velocities[row] -= ratios[row] * velocities[row + 1]
    return velocities


def _derivative(coefficients: Floats) -> Floats:
    """Coefficients of the derivatives by s of polynomials, along the first axis in ascending order."""
    return coefficients[1:] * np.arange(1.0, len(coefficients))[:, None, None]


def _evaluated(coefficients: Floats, along: Floats) -> Floats:
    """The polynomials of ``coefficients``, along the first axis in ascending order, at s = ``along``."""
    values = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        values = values * along + coefficient
    return values


def _roots_within(coefficients: Floats) -> Floats:
    """The roots of polynomials (degree + 1, S, n), as points between 0 and 1, (degree, S, n).

    They are the eigenvalues of companion matrices, as in ``numpy.roots``, of all polynomials at once. Complex
    roots are replaced by their real parts and those outside by 0 or 1: more points than needed do no harm
    to the search for the greatest value.
    """
    degree = len(coefficients) - 1
    if degree == 0:
        return coefficients[:0]
    size = np.abs(coefficients).max(axis=0)
    scaled = np.where(size > _NO_SIZE, coefficients / np.maximum(size, _NO_SIZE), 0.0)
    leading: Floats = np.copysign(np.maximum(np.abs(scaled[-1]), _LEAST_LEADING), scaled[-1])
    companions = np.zeros((*leading.shape, degree, degree))
    companions[..., range(1, degree), range(degree - 1)] = 1.0
    companions[..., :, -1] = np.moveaxis(-scaled[:-1] / leading, 0, -1)
    roots: Floats = np.linalg.eigvals(companions).real.astype(np.float64)
    return np.clip(np.moveaxis(roots, -1, 0), 0.0, 1.0)
