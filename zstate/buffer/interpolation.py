"""Interpolation between two samples of a track, and the motion that each edge of a path contributes.

An *interpolator* reads one joint or pose of a track between two of its rows. All numbers are components (see
``zstate.se3``): floats, or arrays over many instants. A *rate* is the derivative by time, per second.

A *step* is an edge of a path: it makes pose and velocity from interpolated values. ``values[u][i]`` is the
value of interpolator i of the u-th track of the path; ``rates`` likewise. A *motion* is
``parent_from_child`` with the linear and angular velocity of the child, in the parent's axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.history_view import HistoryView
from zstate.model.joint_forms import JointTransform
from zstate.se3 import Backend, Component, Pose, Vector

Row: TypeAlias = Sequence[Component]
Rate: TypeAlias = tuple[Vector, Vector]
Values: TypeAlias = Sequence[Sequence[Any]]

_AT_REST: Rate = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class Bracket:
    """The rows ``a`` and ``b`` around an instant, indexed by column.

    ``ratio`` is the place of the instant between them, 0 to 1. They are ``seconds`` apart, 0 for one row.
    """

    a: Any
    b: Any
    ratio: Component
    seconds: Component
    f: Backend


def rows_around(
    view: HistoryView, at: int, *, for_rate: bool = False
) -> tuple[int, int, float, float] | None:
    """The indices of the rows around ``at``, the ratio between them and the seconds; None outside of them.

    An exact hit is one row, unless ``for_rate`` requests two rows to measure a rate on.
    """
    stamps, _, first, end = view
    index = first + int(stamps[first:end].searchsorted(at))
    if index == end:
        return None
    stamp = int(stamps[index])
    if stamp == at and not (for_rate and view.size > 1):
        return index, index, 0.0, 0.0
    if index == first:
        if stamp != at:
            return None
        index += 1
        stamp = int(stamps[index])
    before = int(stamps[index - 1])
    return index - 1, index, (at - before) / (stamp - before), (stamp - before) * 1e-9


def bracket_at(view: HistoryView, at: int, *, for_rate: bool = False) -> Bracket | None:
    """The bracket of one instant, of floats; arguments as ``rows_around``."""
    around = rows_around(view, at, for_rate=for_rate)
    if around is None:
        return None
    before, after, ratio, seconds = around
    a: list[float] = view.rows[before].tolist()
    b = a if after == before else view.rows[after].tolist()
    return Bracket(a, b, ratio, seconds, se3.SCALARS)


def brackets_at(view: HistoryView, stamps: NDArray[np.int64]) -> Bracket:
    """The bracket of many instants, all of which the view covers, of arrays over them."""
    kept = view.kept_stamps()
    after = kept.searchsorted(stamps)
    exact = kept[after] == stamps
    before = np.where(exact, after, after - 1)
    span_ns = kept[after] - kept[before]
    ratio = np.where(exact, 0.0, (stamps - kept[before]) / np.where(exact, 1, span_ns))
    rows = view.kept_rows()
    return Bracket(rows[before].T, rows[after].T, ratio, span_ns * 1e-9, se3.ARRAYS)


def newest_bracket(view: HistoryView, *, has_rates: bool) -> Bracket:
    """The bracket for the rates of a prediction: the newest row if it ``has_rates``, else the last two."""
    last: list[float] = view.rows[view.end - 1].tolist()
    if has_rates or view.size < 2:
        return Bracket(last, last, 0.0, 0.0, se3.SCALARS)
    span_ns = int(view.stamps[view.end - 1] - view.stamps[view.end - 2])
    return Bracket(view.rows[view.end - 2].tolist(), last, 1.0, span_ns * 1e-9, se3.SCALARS)


def _published(va: Component, vb: Component, now: Bracket) -> Component:
    """The velocity between those of two rows; at a row its own, even if the other has none."""
    between = va + now.ratio * (vb - va)
    return now.f.select(now.ratio == 0.0, va, now.f.select(now.ratio == 1.0, vb, between))


@dataclass(frozen=True, slots=True)
class LinearInterpolator:
    """A number that changes linearly from row to row: revolute and prismatic joints, x and y.

    ``velocity`` is the column of its published velocity, -1 without one.
    """

    column: int
    velocity: int

    def difference(self, now: Bracket) -> Component:
        """The change from one row to the other."""
        return now.b[self.column] - now.a[self.column]

    def value(self, now: Bracket) -> Component:
        """The number at the instant."""
        return now.a[self.column] + now.ratio * self.difference(now)

    def rate(self, now: Bracket) -> Component:
        """Per second: as published, between samples linear in their velocities; else the slope."""
        is_one_row = now.seconds == 0.0
        slope = now.f.select(
            is_one_row, math.nan, self.difference(now) / now.f.select(is_one_row, 1.0, now.seconds)
        )
        if self.velocity < 0:
            return slope
        published = _published(now.a[self.velocity], now.b[self.velocity], now)
        # Velocities that were not published are NaN; only NaN differs from itself.
        return now.f.select(published == published, published, slope)  # noqa: PLR0124

    def extrapolate(self, row: Row, rate: float, seconds: float, f: Backend) -> float:
        """The number ``seconds`` after ``row``, at a constant ``rate``."""
        return row[self.column] + rate * seconds


@dataclass(frozen=True, slots=True)
class ContinuousAngleInterpolator(LinearInterpolator):
    """An angle of any number of turns: of a continuous joint, or the yaw of a planar one.

    It follows the rotation between the samples; but two angles within [-pi, pi] more than half a turn apart
    are of an encoder that wrapped, and take the short way. ``angle_difference`` in ``_kernel/step.h`` is the
    same rule in C.
    """

    def difference(self, now: Bracket) -> Component:
        """The change, in the direction of the rotation."""
        a, b = now.a[self.column], now.b[self.column]
        difference = b - a
        wrapped = (abs(difference) > math.pi) & (abs(a) <= math.pi) & (abs(b) <= math.pi)
        short = now.f.select(difference > 0.0, difference - math.tau, difference + math.tau)
        return now.f.select(wrapped, short, difference)


@dataclass(frozen=True, slots=True)
class PoseInterpolator:
    """Seven columns that are a pose: linear translation and slerp, the short way.

    ``velocity`` is the first of six columns with its linear and angular velocity, both in the axes
    of the frame that the pose is given in; -1 without them.
    """

    column: int
    velocity: int = -1

    def _pose(self, row: Any) -> Pose:
        return tuple(row[self.column : self.column + 7])  # type: ignore[return-value]

    def value(self, now: Bracket) -> Pose:
        """The pose at the instant."""
        return se3.interpolate(self._pose(now.a), self._pose(now.b), now.ratio, now.f)

    def rate(self, now: Bracket) -> Rate:
        """Linear and angular velocity: as published, else the constant ones between both rows."""
        a, b = self._pose(now.a), self._pose(now.b)
        is_one_row = now.seconds == 0.0
        per_second = now.f.select(is_one_row, math.nan, 1.0 / now.f.select(is_one_row, 1.0, now.seconds))
        x, y, z = se3.rotation_vector(se3.multiply(b[3:], se3.conjugate(a[3:])), now.f)
        linear = ((b[0] - a[0]) * per_second, (b[1] - a[1]) * per_second, (b[2] - a[2]) * per_second)
        angular = (x * per_second, y * per_second, z * per_second)
        if self.velocity < 0:
            return linear, angular
        columns = range(self.velocity, self.velocity + 6)
        published = [_published(now.a[k], now.b[k], now) for k in columns]
        is_known = sum(published) == sum(published)
        slope = (*linear, *angular)
        chosen = [now.f.select(is_known, mine, other) for mine, other in zip(published, slope, strict=True)]
        return ((chosen[0], chosen[1], chosen[2]), (chosen[3], chosen[4], chosen[5]))

    def extrapolate(self, row: Row, rate: Rate, seconds: float, f: Backend) -> Pose:
        """The pose ``seconds`` after ``row``, at a constant ``rate``."""
        (vx, vy, vz), (wx, wy, wz) = rate
        x, y, z, *q = self._pose(row)
        rotation = se3.quaternion_exp((wx * seconds, wy * seconds, wz * seconds), f)
        turned = se3.multiply(rotation, (q[0], q[1], q[2], q[3]))
        return (x + vx * seconds, y + vy * seconds, z + vz * seconds, *turned)


Interpolator: TypeAlias = LinearInterpolator | ContinuousAngleInterpolator | PoseInterpolator


@dataclass(frozen=True, slots=True)
class StaticStep:
    """Consecutive static edges, multiplied."""

    constant: Pose

    def pose(self, values: Values, f: Backend) -> Pose:
        return self.constant

    def rate(self, values: Values, rates: Values) -> Rate:
        return _AT_REST


@dataclass(frozen=True, slots=True)
class JointStep:
    """A revolute, continuous, prismatic or planar joint; ``zstate.model.joint_forms`` has the formulas.

    A planar joint has three interpolators, one after the other: x, y and yaw.
    """

    form: JointTransform
    use: int
    column: int

    def pose(self, values: Values, f: Backend) -> Pose:
        form, numbers = self.form, values[self.use]
        if form.kind == "planar":
            x, y, yaw = numbers[self.column : self.column + 3]
            return se3.compose(form.origin, (x, y, 0.0, 0.0, 0.0, f.sin(0.5 * yaw), f.cos(0.5 * yaw)))
        position = form.scale * numbers[self.column] + form.shift
        x, y, z = form.t0
        if form.kind == "prismatic":
            dx, dy, dz = form.t1
            return (x + dx * position, y + dy * position, z + dz * position, *form.q_cos)
        half = 0.5 * position
        c, s = f.cos(half), f.sin(half)
        a, b = form.q_cos, form.q_sin
        return (x, y, z, a[0] * c + b[0] * s, a[1] * c + b[1] * s, a[2] * c + b[2] * s, a[3] * c + b[3] * s)

    def rate(self, values: Values, rates: Values) -> Rate:
        form, numbers = self.form, rates[self.use]
        if form.kind == "planar":
            vx, vy, spin = numbers[self.column : self.column + 3]
            q = form.origin[3:]
            return se3.rotate(q, (vx, vy, 0.0)), se3.rotate(q, (0.0, 0.0, spin))
        speed = form.scale * numbers[self.column]
        x, y, z = form.t1 if form.kind == "prismatic" else se3.rotate(form.q_cos, form.axis)
        velocity = (x * speed, y * speed, z * speed)
        return (velocity, _AT_REST[1]) if form.kind == "prismatic" else (_AT_REST[0], velocity)


@dataclass(frozen=True, slots=True)
class PoseStep:
    """An edge whose samples are poses: of a pose track, or of a floating joint behind its origin."""

    origin: Pose
    use: int
    column: int

    def pose(self, values: Values, f: Backend) -> Pose:
        sampled: Pose = values[self.use][self.column]
        return sampled if self.origin == se3.IDENTITY else se3.compose(self.origin, sampled)

    def rate(self, values: Values, rates: Values) -> Rate:
        linear, angular = rates[self.use][self.column]
        q = self.origin[3:]
        return se3.rotate(q, linear), se3.rotate(q, angular)


Step: TypeAlias = StaticStep | JointStep | PoseStep


@dataclass(frozen=True, slots=True)
class MovingPose:
    """A pose and the velocities of its child, in the parent's axes."""

    pose: Pose
    linear: Vector
    angular: Vector

    def then(self, other: MovingPose) -> MovingPose:
        """The motion of the child of ``other``, whose parent is the child of this one."""
        q = self.pose[3:]
        arm = se3.rotate(q, other.pose[:3])
        linear = _sum(self.linear, se3.cross(self.angular, arm), se3.rotate(q, other.linear))
        angular = _sum(self.angular, se3.rotate(q, other.angular))
        return MovingPose(se3.compose(self.pose, other.pose), linear, angular)

    def inverse(self) -> MovingPose:
        """The motion of the parent, seen from the child."""
        q = se3.conjugate(self.pose[3:])
        x, y, z = se3.cross(self.angular, self.pose[:3])
        vx, vy, vz = self.linear
        wx, wy, wz = self.angular
        linear = se3.rotate(q, (x - vx, y - vy, z - vz))
        return MovingPose(se3.invert(self.pose), linear, se3.rotate(q, (-wx, -wy, -wz)))


def _sum(*vectors: Vector) -> Vector:
    x, y, z = (sum(parts) for parts in zip(*vectors, strict=True))
    return (x, y, z)


def chain_pose(steps: Sequence[Step], values: Values, f: Backend) -> Pose:
    """The product of the steps' poses: top_from_bottom."""
    pose = se3.IDENTITY
    for number, step in enumerate(steps):
        next_pose = step.pose(values, f)
        pose = se3.compose(pose, next_pose) if number else next_pose
    return pose


def chain_motion(steps: Sequence[Step], values: Values, rates: Values, f: Backend) -> MovingPose:
    """The same with velocities."""
    motion = MovingPose(se3.IDENTITY, *_AT_REST)
    for step in steps:
        motion = motion.then(MovingPose(step.pose(values, f), *step.rate(values, rates)))
    return motion
