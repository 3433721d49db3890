"""Arithmetic of rigid motions, for single poses and for arrays of poses.

A pose is seven components x y z qx qy qz qw; a component is a float, or an array of them for many
poses at once. Every function works on both, because ``+ - *`` do. Functions that need sin, cos, sqrt,
atan2 or a selection have a parameter for it, ``SCALARS`` or ``ARRAYS``.

Formulas: unit quaternions act as ``R(q) p = p + 2 w (u x p) + 2 u x (u x p)`` with u = (qx, qy, qz).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Floats or arrays of one shape; exact types would need every function twice.
Component: TypeAlias = Any
Vector: TypeAlias = tuple[Component, Component, Component]
Quaternion: TypeAlias = tuple[Component, Component, Component, Component]
Pose: TypeAlias = tuple[Component, Component, Component, Component, Component, Component, Component]

IDENTITY: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Backend:
    """Functions beyond arithmetic. ``select(condition, a, b)`` evaluates both a and b."""

    sin: Any
    cos: Any
    sqrt: Any
    atan2: Any
    select: Any


def _select(condition: bool, chosen: float, otherwise: float) -> float:
    return chosen if condition else otherwise


def _sin(angle: float) -> float:
    return math.sin(angle) if math.isfinite(angle) else math.nan


def _cos(angle: float) -> float:
    return math.cos(angle) if math.isfinite(angle) else math.nan


# ``math`` raises ValueError for infinite angles; numpy and C return NaN.
SCALARS = Backend(_sin, _cos, math.sqrt, math.atan2, _select)
ARRAYS = Backend(np.sin, np.cos, np.sqrt, np.arctan2, np.where)


def cross(a: Vector, b: Vector) -> Vector:
    """The vector product a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def rotate(q: Quaternion, p: Vector) -> Vector:
    """The vector p turned by q."""
    x, y, z, w = q
    px, py, pz = p
    ux, uy, uz = 2.0 * (y * pz - z * py), 2.0 * (z * px - x * pz), 2.0 * (x * py - y * px)
    return (
        px + w * ux + y * uz - z * uy,
        py + w * uy + z * ux - x * uz,
        pz + w * uz + x * uy - y * ux,
    )


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The quaternion product: first b, then a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse of a unit quaternion."""
    return (-q[0], -q[1], -q[2], q[3])


def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """a_from_c."""
    q = a_from_b[3:]
    x, y, z = rotate(q, b_from_c[:3])
    turned = multiply(q, b_from_c[3:])
    return (a_from_b[0] + x, a_from_b[1] + y, a_from_b[2] + z, *turned)


def invert(a_from_b: Pose) -> Pose:
    """b_from_a."""
    q = conjugate(a_from_b[3:])
    x, y, z = rotate(q, a_from_b[:3])
    return (-x, -y, -z, *q)


def normalize(pose: Pose, f: Backend) -> Pose:
    """The pose with its quaternion scaled to length one."""
    x, y, z, qx, qy, qz, qw = pose
    scale = 1.0 / f.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    return (x, y, z, qx * scale, qy * scale, qz * scale, qw * scale)


def interpolate(first: Pose, second: Pose, ratio: Component, f: Backend) -> Pose:
    """The pose at ``ratio`` of the way: translation along the line, rotation by slerp the short way.

    Shoemake, "Animating rotation with quaternion curves" (1985). The half angle comes from the
    chords of both quaternions, which keeps small angles exact where arccos would not.
    """
    translation = tuple(a + ratio * (b - a) for a, b in zip(first[:3], second[:3], strict=True))
    qa, qb = first[3:], second[3:]
    dot = qa[0] * qb[0] + qa[1] * qb[1] + qa[2] * qb[2] + qa[3] * qb[3]
    sign = f.select(dot < 0.0, -1.0, 1.0)
    qb = (sign * qb[0], sign * qb[1], sign * qb[2], sign * qb[3])
    less = sum((b - a) * (b - a) for a, b in zip(qa, qb, strict=True))
    more = sum((b + a) * (b + a) for a, b in zip(qa, qb, strict=True))
    angle = 2.0 * f.atan2(f.sqrt(less), f.sqrt(more))
    sine = f.sin(angle)
    same = sine < 1e-300
    safe = f.select(same, 1.0, sine)
    wa = f.select(same, 1.0 - ratio, f.sin((1.0 - ratio) * angle) / safe)
    wb = f.select(same, ratio, f.sin(ratio * angle) / safe)
    rotation = tuple(wa * a + wb * b for a, b in zip(qa, qb, strict=True))
    return (*translation, *rotation)  # type: ignore[return-value]


def rotation_vector(q: Quaternion, f: Backend) -> Vector:
    """The turn q as axis times angle [rad], the short way round."""
    x, y, z, w = q
    sign = f.select(w < 0.0, -1.0, 1.0)
    sine = f.sqrt(x * x + y * y + z * z)
    small = sine < 1e-300
    angle = 2.0 * f.atan2(sine, sign * w)
    scale = sign * f.select(small, 2.0, angle / f.select(small, 1.0, sine))
    return (scale * x, scale * y, scale * z)


def quaternion_exp(vector: Vector, f: Backend) -> Quaternion:
    """The quaternion of a turn given as axis times angle [rad]."""
    x, y, z = vector
    angle = f.sqrt(x * x + y * y + z * z)
    small = angle < 1e-300
    scale = f.select(small, 0.5, f.sin(0.5 * angle) / f.select(small, 1.0, angle))
    return (scale * x, scale * y, scale * z, f.cos(0.5 * angle))


def to_matrix(pose: Sequence[float]) -> NDArray[np.float64]:
    """The homogeneous (4, 4) matrix of one pose7."""
    matrix = np.eye(4)
    q = (pose[3], pose[4], pose[5], pose[6])
    matrix[:3, 0] = rotate(q, (1.0, 0.0, 0.0))
    matrix[:3, 1] = rotate(q, (0.0, 1.0, 0.0))
    matrix[:3, 2] = rotate(q, (0.0, 0.0, 1.0))
    matrix[:3, 3] = pose[:3]
    return matrix


def quaternion_from_matrix(rotation: NDArray[np.float64]) -> Quaternion:
    """The unit quaternion of a (3, 3) rotation matrix.

    Shepperd's method: divide by the largest of the four components, so that none is ill-conditioned.
    """
    (a, b, c), (d, e, g), (h, i, k) = rotation.tolist()
    squares = (1.0 + a - e - k, 1.0 - a + e - k, 1.0 - a - e + k, 1.0 + a + e + k)
    largest = max(range(4), key=squares.__getitem__)
    rows = (
        (squares[0], b + d, c + h, i - g),
        (b + d, squares[1], g + i, c - h),
        (c + h, g + i, squares[2], d - b),
        (i - g, c - h, d - b, squares[3]),
    )
    x, y, z, w = rows[largest]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    return (x * scale, y * scale, z * scale, w * scale)


def quaternion_from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """From URDF's angles: roll about x, then pitch about y, then yaw about z, all of the fixed axes."""
    about_x = (math.sin(roll / 2.0), 0.0, 0.0, math.cos(roll / 2.0))
    about_y = (0.0, math.sin(pitch / 2.0), 0.0, math.cos(pitch / 2.0))
    about_z = (0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))
    return multiply(about_z, multiply(about_y, about_x))


def rpy_from_quaternion(q: Quaternion) -> tuple[float, float, float]:
    """Roll, pitch, yaw as in URDF. At a pitch of a right angle roll is 0."""
    m00, m10, m20 = rotate(q, (1.0, 0.0, 0.0))
    m01, m11, m21 = rotate(q, (0.0, 1.0, 0.0))
    _, _, m22 = rotate(q, (0.0, 0.0, 1.0))
    level = math.hypot(m00, m10)
    pitch = math.atan2(-m20, level)
    if level < 1e-12:
        return (0.0, pitch, math.atan2(-m01, m11))
    return (math.atan2(m21, m22), pitch, math.atan2(m10, m00))


def unstack(poses: ArrayLike) -> Pose:
    """Poses (..., 7) as seven component arrays."""
    array = np.asarray(poses, dtype=np.float64)
    return tuple(array[..., k] for k in range(7))  # type: ignore[return-value]
