"""Cells: how one joint or pose of a track is read between two of its rows.

``a`` and ``b`` are the rows before and after the instant, indexed by column; ``ratio`` says how far
between them it lies. All numbers are components (see ``zstate.se3``): floats, or arrays over many
instants. A *rate* is what a cell's numbers change by in a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from zstate.se3 import (
    Component,
    Functions,
    Pose,
    Vector,
    conjugate,
    interpolate,
    multiply,
    rotation_vector,
    turn,
)

Row: TypeAlias = Sequence[Component]
Rate: TypeAlias = tuple[Vector, Vector]


@dataclass(frozen=True, slots=True)
class Between:
    """Two neighbouring rows and an instant between them; ``seconds`` apart (0: one row, exactly)."""

    a: Any
    b: Any
    ratio: Component
    seconds: Component
    f: Functions


def _published(va: Component, vb: Component, now: Between) -> Component:
    """A velocity between those of two rows; at a row itself its own, though the other have none."""
    between = va + now.ratio * (vb - va)
    return now.f.select(now.ratio == 0.0, va, now.f.select(now.ratio == 1.0, vb, between))


@dataclass(frozen=True, slots=True)
class Line:
    """A number that goes straight from row to row: revolute and prismatic joints, x and y.

    ``velocity`` is the column of its published velocity, -1 when there is none. With ``cubic``, the
    way between two samples that have velocities is the cubic Hermite curve through both.
    """

    column: int
    velocity: int
    cubic: bool = False

    def way(self, now: Between) -> Component:
        """How far it is from the one row to the other."""
        return now.b[self.column] - now.a[self.column]

    def value(self, now: Between) -> Component:
        """The number at the instant."""
        start, way = now.a[self.column], self.way(now)
        straight = start + now.ratio * way
        if not self.cubic or self.velocity < 0:
            return straight
        r, dt = now.ratio, now.seconds
        va, vb = now.a[self.velocity] * dt, now.b[self.velocity] * dt
        bent = start + r * (va + r * (3.0 * way - 2.0 * va - vb + r * (va + vb - 2.0 * way)))
        # Velocities that were not published are NaN; only NaN differs from itself.
        return now.f.select(va + vb == va + vb, bent, straight)

    def rate(self, now: Between) -> Component:
        """Per second: as published, between the samples on the line of their velocities; else the slope."""
        way = self.way(now)
        apart = now.seconds == 0.0
        slope = now.f.select(apart, math.nan, way / now.f.select(apart, 1.0, now.seconds))
        if self.velocity < 0:
            return slope
        r, va, vb = now.ratio, now.a[self.velocity], now.b[self.velocity]
        published = _published(va, vb, now)
        if self.cubic:
            bent = va + r * (6.0 * slope - 4.0 * va - 2.0 * vb + r * (3.0 * (va + vb) - 6.0 * slope))
            published = now.f.select(bent == bent, bent, published)  # noqa: PLR0124 - a test for NaN
        return now.f.select(published == published, published, slope)  # noqa: PLR0124

    def ahead(self, row: Row, rate: float, seconds: float, f: Functions) -> float:
        """The number ``seconds`` after ``row``, going on at ``rate``."""
        return row[self.column] + rate * seconds


@dataclass(frozen=True, slots=True)
class Turn(Line):
    """An angle of any number of turns.

    It goes the way that was travelled; but two angles within [-pi, pi] more than half a turn apart
    are an encoder that wrapped, and go the short way.
    """

    def way(self, now: Between) -> Component:
        """How far it is, in the direction travelled."""
        a, b = now.a[self.column], now.b[self.column]
        way = b - a
        wrapped = (abs(way) > math.pi) & (abs(a) <= math.pi) & (abs(b) <= math.pi)
        short = now.f.select(way > 0.0, way - math.tau, way + math.tau)
        return now.f.select(wrapped, short, way)


@dataclass(frozen=True, slots=True)
class Pose7:
    """Seven columns that are a pose: lerp and slerp, the short way.

    ``velocity`` is the first of six columns with its linear and angular velocity, both in the axes
    of the frame that the pose is given in; -1 when there are none.
    """

    column: int
    velocity: int = -1

    def _pose(self, row: Any) -> Pose:
        c = self.column
        return (row[c], row[c + 1], row[c + 2], row[c + 3], row[c + 4], row[c + 5], row[c + 6])

    def value(self, now: Between) -> Pose:
        """The pose at the instant."""
        return interpolate(self._pose(now.a), self._pose(now.b), now.ratio, now.f)

    def rate(self, now: Between) -> Rate:
        """Linear and angular velocity: as published, else the constant ones that join both rows."""
        slope = self._slope(now)
        if self.velocity < 0:
            return slope
        columns = range(self.velocity, self.velocity + 6)
        published = [_published(now.a[k], now.b[k], now) for k in columns]
        known = sum(published) == sum(published)
        chosen = [
            now.f.select(known, mine, theirs)
            for mine, theirs in zip(published, (*slope[0], *slope[1]), strict=True)
        ]
        return ((chosen[0], chosen[1], chosen[2]), (chosen[3], chosen[4], chosen[5]))

    def _slope(self, now: Between) -> Rate:
        a, b = self._pose(now.a), self._pose(now.b)
        apart = now.seconds == 0.0
        per_second = now.f.select(apart, math.nan, 1.0 / now.f.select(apart, 1.0, now.seconds))
        x, y, z = rotation_vector(multiply(b[3:], conjugate(a[3:])), now.f)
        linear = ((b[0] - a[0]) * per_second, (b[1] - a[1]) * per_second, (b[2] - a[2]) * per_second)
        return linear, (x * per_second, y * per_second, z * per_second)

    def ahead(self, row: Row, rate: Rate, seconds: float, f: Functions) -> Pose:
        """The pose ``seconds`` after ``row``, moving on at a constant ``rate``."""
        (vx, vy, vz), (wx, wy, wz) = rate
        x, y, z, *q = self._pose(row)
        turned = multiply(turn((wx * seconds, wy * seconds, wz * seconds), f), (q[0], q[1], q[2], q[3]))
        return (x + vx * seconds, y + vy * seconds, z + vz * seconds, *turned)


Cell: TypeAlias = Line | Turn | Pose7
