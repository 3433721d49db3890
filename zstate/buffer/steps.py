"""Steps: what one edge of a path contributes, given the values its cells have at an instant.

``values[u][c]`` is the value of cell c of the u-th track of the path; ``rates`` likewise. A motion is
``parent_from_child`` with the linear and angular velocity of the child, in the parent's axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from zstate import se3
from zstate.buffer.cells import Rate
from zstate.model.edges import EdgeForm
from zstate.se3 import Component, Functions, Pose, Vector

Values: TypeAlias = Sequence[Sequence[Any]]

STILL: Rate = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class Fixed:
    """Static edges, multiplied out."""

    constant: Pose

    def pose(self, values: Values, f: Functions) -> Pose:
        """parent_from_child."""
        return self.constant

    def rate(self, values: Values, rates: Values) -> Rate:
        """A static edge does not move."""
        return STILL


@dataclass(frozen=True, slots=True)
class Hinge:
    """A joint that turns: see ``zstate.model.edges`` for the formula."""

    form: EdgeForm
    use: int
    cell: int

    def pose(self, values: Values, f: Functions) -> Pose:
        """parent_from_child."""
        form = self.form
        half = 0.5 * (form.scale * values[self.use][self.cell] + form.shift)
        c, s = f.cos(half), f.sin(half)
        a, b = form.q_cos, form.q_sin
        x, y, z = form.t0
        return (x, y, z, a[0] * c + b[0] * s, a[1] * c + b[1] * s, a[2] * c + b[2] * s, a[3] * c + b[3] * s)

    def rate(self, values: Values, rates: Values) -> Rate:
        """A turn about the axis."""
        speed = self.form.scale * rates[self.use][self.cell]
        x, y, z = se3.rotate(self.form.q_cos, self.form.axis)
        return STILL[0], (x * speed, y * speed, z * speed)


@dataclass(frozen=True, slots=True)
class Slide:
    """A prismatic joint."""

    form: EdgeForm
    use: int
    cell: int

    def pose(self, values: Values, f: Functions) -> Pose:
        """parent_from_child."""
        form = self.form
        n = form.scale * values[self.use][self.cell] + form.shift
        translation = (form.t0[0] + form.t1[0] * n, form.t0[1] + form.t1[1] * n, form.t0[2] + form.t1[2] * n)
        return (*translation, *form.q_cos)

    def rate(self, values: Values, rates: Values) -> Rate:
        """A motion along the axis."""
        speed = self.form.scale * rates[self.use][self.cell]
        x, y, z = self.form.t1
        return (x * speed, y * speed, z * speed), STILL[1]


@dataclass(frozen=True, slots=True)
class Planar:
    """A joint that moves in a plane: cells x, y and yaw, one after the other."""

    form: EdgeForm
    use: int
    cell: int

    def pose(self, values: Values, f: Functions) -> Pose:
        """parent_from_child."""
        x, y, yaw = values[self.use][self.cell : self.cell + 3]
        return se3.compose(self.form.origin, (x, y, 0.0, 0.0, 0.0, f.sin(0.5 * yaw), f.cos(0.5 * yaw)))

    def rate(self, values: Values, rates: Values) -> Rate:
        """A motion in the plane, a turn about its normal."""
        vx, vy, spin = rates[self.use][self.cell : self.cell + 3]
        q = self.form.origin[3:]
        return se3.rotate(q, (vx, vy, 0.0)), se3.rotate(q, (0.0, 0.0, spin))


@dataclass(frozen=True, slots=True)
class Given:
    """An edge whose pose is given: a pose track's, or a floating joint behind its origin."""

    origin: Pose
    use: int
    cell: int

    def pose(self, values: Values, f: Functions) -> Pose:
        """parent_from_child."""
        given: Pose = values[self.use][self.cell]
        return given if self.origin == se3.IDENTITY else se3.compose(self.origin, given)

    def rate(self, values: Values, rates: Values) -> Rate:
        """As its cell says."""
        linear, angular = rates[self.use][self.cell]
        q = self.origin[3:]
        return se3.rotate(q, linear), se3.rotate(q, angular)


Step: TypeAlias = Fixed | Hinge | Slide | Planar | Given


@dataclass(frozen=True, slots=True)
class Motion:
    """A pose and the velocities of its child, in the parent's axes."""

    pose: Pose
    linear: Vector
    angular: Vector

    def then(self, other: Motion) -> Motion:
        """The motion of the child of ``other``, whose parent is the child of this one."""
        q = self.pose[3:]
        arm = se3.rotate(q, other.pose[:3])
        linear = _sum(self.linear, se3.cross(self.angular, arm), se3.rotate(q, other.linear))
        angular = _sum(self.angular, se3.rotate(q, other.angular))
        return Motion(se3.compose(self.pose, other.pose), linear, angular)

    def inverse(self) -> Motion:
        """The motion of the parent, seen from the child."""
        q = se3.conjugate(self.pose[3:])
        x, y, z = se3.cross(self.angular, self.pose[:3])
        vx, vy, vz = self.linear
        wx, wy, wz = self.angular
        linear = se3.rotate(q, (x - vx, y - vy, z - vz))
        return Motion(se3.invert(self.pose), linear, se3.rotate(q, (-wx, -wy, -wz)))


AT_REST = Motion(se3.IDENTITY, *STILL)


def _sum(*vectors: Vector) -> Vector:
    x, y, z = (sum(parts) for parts in zip(*vectors, strict=True))
    return (x, y, z)


def chain_pose(steps: Sequence[Step], values: Values, f: Functions) -> Pose:
    """The steps' poses, multiplied: top_from_bottom."""
    pose = se3.IDENTITY
    for number, step in enumerate(steps):
        next_pose = step.pose(values, f)
        pose = se3.compose(pose, next_pose) if number else next_pose
    return pose


def chain_motion(steps: Sequence[Step], values: Values, rates: Values, f: Functions) -> Motion:
    """The same with velocities."""
    motion = AT_REST
    for step in steps:
        motion = motion.then(Motion(step.pose(values, f), *step.rate(values, rates)))
    return motion


__all__ = ["Component", "Fixed", "Given", "Hinge", "Motion", "Planar", "Slide", "Step", "Values"]
