"""Measurements of the invariant filter, and the pose and twist of a frame by its state.

Each function linearises one kind of measurement at a state. ``imu_from_frame``, (4, 4), is the mount of the
frame that was measured. The derivatives are by the right-invariant error (``invariant_filter.py``), whose
order they have. Numbers are those that ``checked_vector`` and ``checked_noise`` have let pass.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from zstate import se3
from zstate.checks import Floats, real_numbers
from zstate.errors import InvalidInput
from zstate.odometry.invariant_filter import (
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    FilterState,
    Measurement,
    adjoint,
    contact_row,
    tracked_pose,
)
from zstate.odometry.rotations import IDENTITY, gammas, skew

MIN_SIGMA, MAX_SIGMA = 1e-9, 1e9
"""The bounds of standard deviations, in any unit. What is worse measures nothing; squares stay in range."""

Rows: TypeAlias = slice | list[int]
ALL_ROWS = slice(None)
"""All numbers of a measurement."""

_LEVEL = math.sin(math.radians(6.0))
"""The shortest level part of a unit vector that has a heading: 84 degrees of pitch."""


def body_velocity(
    state: FilterState,
    linear: Floats,
    covariance: Floats,
    imu_from_frame: Floats,
    gyro: Floats,
    *,
    rows: Rows = ALL_ROWS,
) -> Measurement:
    """The velocity of a frame's origin in the world, in the axes of the frame [m/s], as wheels measure it.

    ``R_f^T (R^T v + omega x r)``, with ``r`` and ``R_f`` of ``imu_from_frame`` and omega of ``gyro``, the
    IMU's rate at this instant [rad/s], less its bias. ``covariance`` (m, m) is that of the m ``rows`` which
    are measured, by default all three, in the axes of the frame.
    """
    frame_from_imu, lever = imu_from_frame[:3, :3].T, imu_from_frame[:3, 3]
    frame_from_world: Floats = frame_from_imu.dot(state.rotation.T)
    # omega x r = -[r] omega; a bias lowers omega.
    by_bias: Floats = frame_from_imu.dot(skew(lever))
    expected: Floats = frame_from_world.dot(state.velocity) - by_bias.dot(gyro - state.gyro_bias)
    jacobian = np.zeros((3, len(state.covariance)))
    jacobian[:, VELOCITY] = frame_from_world
    jacobian[:, GYRO_BIAS] = by_bias
    return Measurement((linear - expected)[rows], jacobian[rows], covariance)


def yaw_rate(state: FilterState, rate: float, variance: float, upright: Floats, gyro: Floats) -> Measurement:
    """The rate about the axis ``upright`` of the IMU's axes, (3,) [rad/s], as wheels measure it.

    It is that of ``gyro`` less its bias.
    """
    jacobian = np.zeros((1, len(state.covariance)))
    jacobian[0, GYRO_BIAS] = -upright
    residual = rate - float(upright.dot(gyro - state.gyro_bias))
    return Measurement(np.array([residual]), jacobian, np.array([[variance]]))


def zero_velocity(state: FilterState, gyro: Floats, velocity_sigma: float, rate_sigma: float) -> Measurement:
    """A body at rest: six numbers, its velocity [m/s] and rate [rad/s] are zero up to these sigmas.

    The rate makes the bias of the gyro observable, also about the vertical.
    """
    jacobian = np.zeros((6, len(state.covariance)))
    jacobian[:3, VELOCITY] = state.rotation.T
    jacobian[3:, GYRO_BIAS] = IDENTITY
    residual = np.concatenate((-(state.rotation.T @ state.velocity), gyro - state.gyro_bias))
    return Measurement(residual, jacobian, np.diag(np.repeat((velocity_sigma, rate_sigma), 3) ** 2))


def position(state: FilterState, measured: Floats, covariance: Floats, imu_from_frame: Floats) -> Measurement:
    """The position of a frame's origin in the world [m], as a GNSS antenna or a prism measures it."""
    point = state.position + state.rotation @ imu_from_frame[:3, 3]
    return Measurement(measured - point, _point_jacobian(state, point), covariance)


def height(state: FilterState, measured: float, variance: float, imu_from_frame: Floats) -> Measurement:
    """The height of a frame's origin in the world [m], as a barometer measures it."""
    point = state.position + state.rotation @ imu_from_frame[:3, 3]
    residual = np.array([measured - float(point[2])])
    return Measurement(residual, _point_jacobian(state, point)[2:], np.array([[variance]]))


def pose(
    state: FilterState,
    world_from_frame: Floats,
    covariance: Floats,
    imu_from_frame: Floats,
    *,
    rows: Rows = ALL_ROWS,
) -> Measurement:
    """The pose of a frame in the world, (4, 4), as motion capture or scan matching measures it.

    ``covariance`` (m, m) is that of the m ``rows`` which are measured, by default all six of
    ``Transform.covariance``: position, then rotation about the axes of the world.
    """
    expected = _world_from_frame(state, imu_from_frame)
    turn = world_from_frame[:3, :3] @ expected[:3, :3].T
    angles = se3.rotation_vector(se3.quaternion_from_matrix(turn), se3.SCALARS)
    residual = np.concatenate((world_from_frame[:3, 3] - expected[:3, 3], angles))
    return Measurement(residual[rows], _pose_jacobian(state, expected)[rows], covariance)


def tracking(state: FilterState, source: str, covariance: Floats, imu_from_frame: Floats) -> Measurement:
    """Another odometry has the body where it is: ``log(X_s X^-1)`` of its pose and that of the state.

    ``covariance`` (6, 6) is that of the noise of its pose of the frame, in the axes of the frame: rotation,
    then position.
    """
    found = tracked_pose(state, source)
    assert found is not None
    row, tracked = found
    turn = tracked.rotation.dot(state.rotation.T)
    angles = np.array(se3.rotation_vector(se3.quaternion_from_matrix(turn), se3.SCALARS))
    shift = _inverse(gammas(angles)[1]).dot(tracked.position - turn.dot(state.position))
    jacobian = np.zeros((6, len(state.covariance)))
    jacobian[:3, ROTATION] = jacobian[3:, POSITION] = IDENTITY
    jacobian[:, row : row + 6] = -np.eye(6)
    spread = adjoint(_world_from_frame(state, imu_from_frame))
    return Measurement(np.concatenate((angles, shift)), jacobian, spread.dot(covariance).dot(spread.T))


def heading(state: FilterState, yaw: float, variance: float, axis: Floats) -> Measurement:
    """The direction of ``axis`` in the level plane [rad], from the world's x axis towards its y axis.

    ``axis`` (3,) has the length 1 and is in the IMU's axes. Raises InvalidInput if it is within 6 degrees of
    the vertical, where it has none.
    """
    x, y, z = (state.rotation @ axis).tolist()
    level = x * x + y * y
    if level < _LEVEL * _LEVEL:
        raise InvalidInput(
            f"this axis has no heading: it is {math.degrees(math.asin(abs(z))):.0f} degrees "
            "from level; leave headings out at such poses"
        )
    jacobian = np.zeros((1, len(state.covariance)))
    jacobian[0, ROTATION] = -x * z / level, -y * z / level, 1.0
    residual = math.remainder(yaw - math.atan2(y, x), math.tau)
    return Measurement(np.array([residual]), jacobian, np.array([[variance]]))


def contact(state: FilterState, foot: str, offset: Floats, covariance: Floats) -> Measurement:
    """The position of a foot that is in contact, from the IMU and in its axes [m], by its joints.

    ``R^T (c - p)``; ``covariance`` (3, 3) is in the IMU's axes. Raises InvalidInput if the foot has no
    contact in ``state``.
    """
    row = contact_row(state, foot)
    imu_from_world = state.rotation.T
    jacobian = np.zeros((3, len(state.covariance)))
    jacobian[:, POSITION] = -imu_from_world
    jacobian[:, row : row + 3] = imu_from_world
    expected = imu_from_world @ (state.contacts[state.feet.index(foot)] - state.position)
    return Measurement(offset - expected, jacobian, covariance)


def frame_pose(state: FilterState, imu_from_frame: Floats) -> tuple[Floats, Floats]:
    """world_from_frame, (4, 4), and its covariance, (6, 6), that of ``Transform.covariance``."""
    world_from_frame = _world_from_frame(state, imu_from_frame)
    jacobian = _pose_jacobian(state, world_from_frame)
    return world_from_frame, jacobian.dot(state.covariance).dot(jacobian.T)


def yaw_curvature(covariance: Floats) -> Floats:
    """What an error of the yaw adds to the covariance of x and y in the second order: (2, 2).

    ``covariance`` (6, 6) is that of ``frame_pose``, to first order: its error of the position by an error t
    of the yaw is ``t (z x r)``, with ``z x r`` the covariance of position and yaw by the variance s of the
    yaw. A turn by t about a point moves what is at r from it by ``(cos t - 1) r`` as well: positions lie on
    an arc (Long, Wolfe, Mashner, Chirikjian, "The banana distribution is Gaussian", RSS 2012). The mean of
    (1 - cos t)^2 is ``3/2 - 2 exp(-s / 2) + exp(-2 s) / 2``, nearly 3/4 s^2.
    """
    variance = float(covariance[5, 5])
    x, y = covariance[:2, 5].tolist()
    # The exponentials cancel: below 0.01 the next term is 1 % of the result.
    mean = 1.5 - 2.0 * math.exp(-0.5 * variance) + 0.5 * math.exp(-2.0 * variance)
    factor = 0.75 if variance < 0.01 else mean / (variance * variance)
    return factor * np.array(((y * y, -x * y), (-x * y, x * x)))


def frame_twist(
    state: FilterState, imu_from_frame: Floats, gyro: Floats, gyro_variance: float
) -> tuple[Floats, Floats]:
    """The velocity of a frame in its own axes, linear [m/s] and angular [rad/s], (6,), and its covariance,
    (6, 6).

    ``gyro`` is the IMU's rate at this instant, and ``gyro_variance`` [rad^2/s^2] that of its white noise in
    each axis: the squared density of ``ImuNoise`` times the bandwidth.
    """
    frame_from_imu, lever = imu_from_frame[:3, :3].T, imu_from_frame[:3, 3]
    frame_from_world: Floats = frame_from_imu.dot(state.rotation.T)
    by_bias = np.concatenate((frame_from_imu.dot(skew(lever)), -frame_from_imu))
    twist: Floats = by_bias.dot(state.gyro_bias - gyro)
    twist[:3] += frame_from_world.dot(state.velocity)
    jacobian = np.zeros((6, len(state.covariance)))
    jacobian[:3, VELOCITY] = frame_from_world
    jacobian[:, GYRO_BIAS] = by_bias
    # White noise of the rate acts as a bias of this instant.
    covariance: Floats = jacobian.dot(state.covariance).dot(jacobian.T)
    covariance += by_bias.dot(by_bias.T) * gyro_variance
    return twist, covariance


def checked_vector(values: ArrayLike, source: str, what: str, limit: float) -> Floats:
    """A copy of ``values``, (3,).

    Raises InvalidInput, which names the source, for other shapes, NaN, and sizes above ``limit``.
    """
    vector = real_numbers(values, f"the {what} of source {source!r}")
    if vector.shape != (3,):
        raise InvalidInput(f"the {what} of source {source!r} has shape (3,); got {vector.shape}")
    if not math.isfinite(sum(vector.tolist())):
        raise InvalidInput(f"the {what} of source {source!r} must be finite; got {vector.tolist()}")
    if float(np.abs(vector).max()) > limit:
        raise InvalidInput(
            f"the {what} of source {source!r} is at most {limit:g}, more than any sensor measures; got "
            f"{vector.tolist()}"
        )
    return vector.copy()


def checked_noise(
    sigma: ArrayLike | None,
    covariance: ArrayLike | None,
    size: int,
    source: str,
    rows: Rows = ALL_ROWS,
) -> Floats:
    """The covariance of m ``rows`` out of ``size``, (m, m), that is given as such or by standard deviations.

    Raises InvalidInput, which names the source, unless it is finite, symmetric and positive definite, with
    standard deviations from ``MIN_SIGMA`` to ``MAX_SIGMA``; numbers of other rows may be any.
    """
    if (sigma is None) == (covariance is None):
        raise InvalidInput(f"the noise of source {source!r} is given either by sigma or by covariance")
    if sigma is not None:
        sigmas = real_numbers(sigma, f"the sigma of source {source!r}")
        used = sigmas[rows] if sigmas.shape == (size,) else np.zeros(1)
        if not ((used >= MIN_SIGMA) & (used <= MAX_SIGMA)).all():
            raise InvalidInput(
                f"the sigma of source {source!r} is {size} standard deviations above zero, of {MIN_SIGMA:g} "
                f"to {MAX_SIGMA:g}; got {sigmas.tolist()}"
            )
        return np.diag(used * used)
    assert covariance is not None
    matrix = real_numbers(covariance, f"the covariance of source {source!r}")
    if matrix.shape != (size, size):
        raise InvalidInput(
            f"the covariance of source {source!r} has shape ({size}, {size}); got {matrix.shape}"
        )
    matrix = matrix[rows][:, rows]
    if not np.isfinite(matrix).all():
        raise InvalidInput(f"the covariance of source {source!r} must be finite; got {matrix.tolist()}")
    if np.abs(matrix - matrix.T).max() > 1e-6 * np.abs(matrix).max():
        raise InvalidInput(f"the covariance of source {source!r} is symmetric; got {matrix.tolist()}")
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest <= 0.0:
        raise InvalidInput(
            f"the covariance of source {source!r} has no eigenvalue of zero or less; got {smallest:g}. A "
            "variance of 0 is no exact measurement but an unknown noise: state what the sensor has"
        )
    if smallest < MIN_SIGMA**2 or matrix.diagonal().max() > MAX_SIGMA**2:
        raise InvalidInput(
            f"the covariance of source {source!r} has standard deviations of {MIN_SIGMA:g} to {MAX_SIGMA:g}; "
            f"got variances {matrix.diagonal().tolist()}"
        )
    return 0.5 * (matrix + matrix.T)


def _world_from_frame(state: FilterState, imu_from_frame: Floats) -> Floats:
    world_from_frame = state.rotation.dot(imu_from_frame[:3])
    world_from_frame[:, 3] += state.position
    return np.concatenate((world_from_frame, imu_from_frame[3:]))


def _inverse(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _point_jacobian(state: FilterState, point: Floats) -> Floats:
    """The derivative of a point of the body, given in the world: (3, n). ``-[point] phi + xi_p``."""
    jacobian = np.zeros((3, len(state.covariance)))
    jacobian[:, ROTATION] = -skew(point)
    jacobian[:, POSITION] = IDENTITY
    return jacobian


def _pose_jacobian(state: FilterState, world_from_frame: Floats) -> Floats:
    """The derivative of position and rotation about world axes of a frame on the body: (6, n)."""
    jacobian = np.zeros((6, len(state.covariance)))
    jacobian[:3, ROTATION] = -skew(world_from_frame[:3, 3])
    jacobian[:3, POSITION] = jacobian[3:, ROTATION] = IDENTITY
    return jacobian
