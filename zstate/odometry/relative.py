"""Another odometry as a source: the displacement between two of its poses, and what it is worth.

Poses T1 and T2 of a frame, in whichever world, have the displacement ``Z = T1^-1 T2``. A pose has an error
that stays, as that of dead reckoning, and noise of its own. Z has the growth of the former: with P1 and P2
the covariances of the errors, as of ``T = exp(error) T'``, ``Ad (P2 - P1) Ad^T`` with Ad the adjoint of
``T1^-1``. Noise of its own is that of the second pose alone: the first one was there when T1 was fused.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zstate import se3
from zstate.checks import Floats
from zstate.odometry.invariant_filter import adjoint
from zstate.odometry.rotations import skew
from zstate.odometry.source_noise import RelativeNoise

_TURNED = 0.02
"""The standard deviation of a turn of any source, as a part of the turn."""

_NEGATIVE = -1e-9
"""Eigenvalues below this part of the largest one are negative, and not by rounding."""


class RelativePose(NamedTuple):
    """A pose of a frame of the robot in the world of a source, (4, 4).

    ``covariance`` (6, 6) is that of ``Transform.covariance``, None if it is not known or of no use.
    """

    stamp: int
    world: str
    pose: Floats
    covariance: Floats | None
    noise: RelativeNoise
    imu_from_frame: Floats


class Move(NamedTuple):
    """earlier_from_present of a frame, (4, 4), and what two poses add to the error; rotation first, (6, 6).

    ``walk`` is the covariance of what the error grows by, of ``exp(error) moved``; ``spread`` that of the
    noise of the present pose alone, in the axes of the frame. ``is_stated``: by the stated sigmas, because
    covariances of the poses are of no use.
    """

    moved: Floats
    walk: Floats
    spread: Floats
    is_stated: bool


def way_of(moved: Floats) -> float:
    """The length of the translation of a displacement, (4, 4) [m]."""
    return math.sqrt(float(moved[:3, 3] @ moved[:3, 3]))


def moved_between(first: RelativePose, second: RelativePose) -> Move:
    """What a source says of the way from the first pose to the second one."""
    moved, noise = _inverse(first.pose).dot(second.pose), second.noise
    way = way_of(moved)
    turn = math.hypot(*se3.rotation_vector(se3.quaternion_from_matrix(moved[:3, :3]), se3.SCALARS))
    floor = np.diag(np.repeat((math.radians(noise.floor_deg) ** 2, noise.floor**2), 3))
    known = first.covariance is not None and second.covariance is not None
    if noise.covariance == "independent" and known and _is_one(_of_noise(second)):
        return Move(moved, np.zeros((6, 6)), floor + _of_noise(second), is_stated=False)
    if noise.covariance == "dependent" and known:
        grown = _of_error(second) - _of_error(first)
        if _is_one(grown):
            back = adjoint(_inverse(first.pose))
            return Move(moved, back @ grown @ back.T, floor, is_stated=False)
    turned = math.radians(noise.sigma_deg) ** 2 * way + (_TURNED * turn) ** 2
    walk = np.diag(np.repeat((turned, noise.sigma**2 * way), 3))
    return Move(moved, walk, floor, is_stated=True)


def _is_one(covariance: Floats) -> bool:
    """Whether it is a covariance, and not of zeros or of what is certain."""
    eigenvalues = np.linalg.eigvalsh(covariance)
    return bool(eigenvalues[-1] > 0.0 and eigenvalues[0] > _NEGATIVE * eigenvalues[-1])


def _of_noise(one: RelativePose) -> Floats:
    """The covariance of a pose in the axes of the frame, rotation first."""
    assert one.covariance is not None
    turned = np.kron(np.eye(2), one.pose[:3, :3].T)
    return turned @ np.roll(one.covariance, (3, 3), axis=(0, 1)) @ turned.T


def _of_error(one: RelativePose) -> Floats:
    """The covariance of ``exp(error)``, rotation first, by that of position and rotation as differences."""
    assert one.covariance is not None
    plain = np.roll(one.covariance, (3, 3), axis=(0, 1))
    change = np.eye(6)
    change[3:, :3] = skew(one.pose[:3, 3])
    return change @ plain @ change.T


def _inverse(pose: Floats) -> Floats:
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T.dot(pose[:3, 3])
    return inverse
