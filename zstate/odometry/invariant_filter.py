"""Invariant Kalman filter of a body with an IMU: orientation, velocity, position, biases and contacts.

The state is (R, v, p, c_1 ... c_k) of SE_{2+k}(3), with the IMU's axes as the body: ``R`` world_from_imu,
``v`` and ``p`` of the IMU's origin in the world, contact points ``c`` in the world, with the biases of
gyro and accelerometer. The world has z up, and gravity (0, 0, -9.80665) m/s^2.

The error is right-invariant: truth X and estimate X' are ``X = exp(xi) X'``, and a bias is ``b = b' + zeta``.
To first order ``xi`` is, with the cross product matrix [.],

    rotation   phi                   R = exp([phi]) R', about world axes [rad]
    velocity   v - v' + [v'] phi     [m/s]
    position   p - p' + [p'] phi     [m], and contacts likewise

Covariances have this order, then the biases of gyro and accelerometer, then tracked poses, then contacts:
(n, n) with n = 15 + 7e + 3k.
Apart from biases, the propagation of this error does not depend on the estimate, so that the filter stays
consistent where one with Euler angles or a linear position error does not.

Formulas: Hartley, Ghaffari, Eustice, Grizzle, "Contact-aided invariant extended Kalman filtering for robot
state estimation", IJRR 39 (2020), with the sign of the error changed; Barrau, Bonnabel, "The invariant
extended Kalman filter as a stable observer", IEEE TAC 62 (2017). Tracked poses with a scale: Weiss, Siegwart,
"Real-time metric state estimation for modular vision-inertial systems", ICRA 2011.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from zstate.checks import Floats
from zstate.errors import InvalidInput
from zstate.odometry.rotations import SKEW, gammas, skew

GRAVITY = np.array([0.0, 0.0, -9.80665])
"""[m/s^2] in the world: standard gravity."""

ROTATION, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCEL_BIAS = slice(9, 12), slice(12, 15)
"""The places of the errors in a covariance; ``tracked_pose`` and ``contact_row`` have the others."""

_TRACKED_SIZE = 7

_STANDARD_GRAVITY = -float(GRAVITY[2])
_HALF_GRAVITY = 0.5 * GRAVITY
_THREE_HALVES = 1.5 * np.eye(3)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuNoise:
    """Noise of an IMU, as in its data sheet or by an Allan variance.

    ``gyro`` [rad/s/sqrt(Hz)] and ``accel`` [m/s^2/sqrt(Hz)] are the densities of white noise, ``gyro_bias``
    [rad/s/sqrt(s)] and ``accel_bias`` [m/s^2/sqrt(s)] those of the random walks of the biases. Constant
    errors have the standard deviations ``gyro_scale``, relative, and ``gyro_bias_shift`` [rad/s], of the
    bias in motion against that at rest (temperature, vibration); the defaults are those of a usual gyro that
    was not calibrated. Raises InvalidInput unless all are finite, and the first two above zero.
    """

    gyro: float
    accel: float
    gyro_bias: float
    accel_bias: float
    gyro_scale: float = 0.01
    gyro_bias_shift: float = 5e-4

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            may_be_zero = field.name.endswith(("_bias", "_scale", "_shift"))
            if not math.isfinite(value) or value < 0.0 or (value == 0.0 and not may_be_zero):
                bound = "0 or more" if may_be_zero else "above 0"
                raise InvalidInput(
                    f"the noise {field.name!r} of an IMU is a finite density, {bound}; got {value!r}. Data "
                    "sheets state it as noise density or random walk"
                )


class Tracked(NamedTuple):
    """The pose of the IMU, world_from_imu, by another odometry: it is carried along by its displacements.

    Its error has seven numbers: rotation and position, as those of the pose of the state, and that of
    ``log_scale``, the logarithm of what the translations of this source have to be multiplied by.
    """

    source: str
    rotation: Floats
    position: Floats
    log_scale: float


class FilterState(NamedTuple):
    """An estimate and the covariance of its error. Arrays are not to be written to.

    ``rotation`` is world_from_imu, (3, 3); ``velocity`` [m/s] and ``position`` [m] of the IMU in the world,
    (3,); ``gyro_bias`` [rad/s] and ``accel_bias`` [m/s^2] in the IMU's axes, (3,). ``feet`` are the names of
    the k contacts, and ``contacts`` their points in the world [m], (k, 3). ``covariance`` is that of the
    right-invariant error, (n, n), in the order of the module's docstring. ``tracked`` are the poses by e
    other odometries.
    """

    rotation: Floats
    velocity: Floats
    position: Floats
    gyro_bias: Floats
    accel_bias: Floats
    feet: tuple[str, ...]
    contacts: Floats
    covariance: Floats
    tracked: tuple[Tracked, ...] = ()


class Measurement(NamedTuple):
    """A linearised measurement of m numbers: ``residual = jacobian @ error + noise``.

    ``residual`` (m,) is measured minus expected, ``jacobian`` (m, n) its derivative by the error of the
    state, and ``covariance`` (m, m) that of the noise.
    """

    residual: Floats
    jacobian: Floats
    covariance: Floats


class Innovation(NamedTuple):
    """The residual of a measurement with its expected covariance, (m, m), and the gain of Kalman, (n, m).

    ``nis``, the normalised innovation squared, follows the chi-square distribution of m degrees of freedom if
    noise and estimate are as their covariances state (Bar-Shalom, Li, Kirubarajan, 2001, 5.4).
    """

    residual: Floats
    covariance: Floats
    gain: Floats
    nis: float


def initial_state(
    *,
    rotation: Floats,
    velocity: Floats,
    position: Floats,
    gyro_bias: Floats,
    accel_bias: Floats,
    covariance: Floats,
) -> FilterState:
    """A state without contacts, from the covariance of plain errors in world axes, (15, 15).

    Plain errors are those of ``plain_covariance``: a rotation about world axes, and differences.
    """
    state = FilterState(
        rotation, velocity, position, gyro_bias, accel_bias, (), np.zeros((0, 3)), np.asarray(covariance)
    )
    return with_plain_covariance(state, covariance)


def plain_covariance(state: FilterState) -> Floats:
    """The covariance of plain errors: (n, n).

    They are the rotation about world axes [rad] and the differences of velocity, position, biases, tracked
    poses and contacts, each truth minus estimate.
    """
    plain_from_invariant = 2.0 * np.eye(len(state.covariance)) - _invariant_from_plain(state)
    return plain_from_invariant @ state.covariance @ plain_from_invariant.T


def with_plain_covariance(state: FilterState, covariance: Floats) -> FilterState:
    """The state whose plain errors have ``covariance``, in the order of ``plain_covariance``."""
    invariant_from_plain = _invariant_from_plain(state)
    return state._replace(covariance=invariant_from_plain @ covariance @ invariant_from_plain.T)


def forgotten(covariance: Floats, rows: slice, variance: float) -> Floats:
    """Set the errors ``rows`` to be independent of all others, with ``variance`` each, in place."""
    covariance[rows] = 0.0
    covariance[:, rows] = 0.0
    block = covariance[rows, rows]
    np.fill_diagonal(block, variance)
    return covariance


def predict(
    state: FilterState,
    gyro: Floats,
    accel: Floats,
    dt_s: float,
    noise: ImuNoise,
    *,
    contact_noise: float = 0.0,
    white: Floats | None = None,
) -> FilterState:
    """The state ``dt_s`` seconds later, from an IMU's rate [rad/s] and specific force [m/s^2] in its axes.

    Both are constant for ``dt_s``. The mean is then exact, and so is the propagation of the error but for
    what a bias of the gyro does to velocity and position inside the step, which has the mean of its effect
    only. White noise is a bias of this step alone, of the variance density^2 / dt; what its changes inside
    the step do is exact for the accelerometer, ``dt^3 / 12`` of the position, and left out for the gyro. The
    walks of the biases are of first order. ``contact_noise`` [m/sqrt(s)] is the drift of contacts, as feet
    slip. ``white``, (6,), are the squared densities of white noise of gyro and accelerometer in each axis, by
    default those of ``noise``.
    """
    # The orientation at the end, its mean in the step, and the integral of the integral, in units of dt.
    turned = state.rotation @ gammas((gyro - state.gyro_bias) * dt_s)
    force = accel - state.accel_bias
    push, double_push = turned[1].dot(force), turned[2].dot(force)
    velocity = state.velocity + (push + GRAVITY) * dt_s
    position = state.position + state.velocity * dt_s + (double_push + _HALF_GRAVITY) * (dt_s * dt_s)

    # A turn at the time u before the end moves them by [v - a u] and [p - a u^2 / 2], and contacts by [c].
    points = np.array((velocity - push * (0.5 * dt_s), position - push * (dt_s * dt_s / 6.0)))
    if state.feet:
        points = np.concatenate((points, state.contacts))
    turn = turned[1] * -dt_s
    shifts = points.dot(SKEW).reshape(-1, 3).dot(turn)

    size, first = len(state.covariance), _first_contact_row(state)
    transition = _identity(size).copy()
    fall = _STANDARD_GRAVITY * dt_s
    transition[3, 1], transition[4, 0] = fall, -fall
    transition[6, 1], transition[7, 0] = 0.5 * fall * dt_s, -0.5 * fall * dt_s
    transition[6, 3] = transition[7, 4] = transition[8, 5] = dt_s
    transition[ROTATION, GYRO_BIAS] = transition[VELOCITY, ACCEL_BIAS] = turn
    transition[3:9, GYRO_BIAS] = shifts[:6]
    transition[POSITION, ACCEL_BIAS] = turned[2] * (-dt_s * dt_s)
    if state.feet:
        transition[first:, GYRO_BIAS] = shifts[6:]
    walks = _walks(noise, contact_noise, first, size)
    if white is None:
        white = white_noise(noise)
    effects = transition[:, 9:15] - _constant_biases(size)
    added = walks * dt_s
    added[POSITION] = max(white[3:].tolist()) * dt_s**3 / 12.0

    covariance: Floats = transition.dot(state.covariance).dot(transition.T)
    covariance += (effects * (white / dt_s)).dot(effects.T)
    covariance.reshape(-1)[:: size + 1] += added
    return FilterState(
        turned[0],
        velocity,
        position,
        state.gyro_bias,
        state.accel_bias,
        state.feet,
        state.contacts,
        covariance,
        state.tracked,
    )


def innovation(state: FilterState, measurement: Measurement) -> Innovation:
    """What ``measurement`` has that is new to the state: all that a gate and ``corrected`` need."""
    residual, jacobian, noise = measurement
    crossed: Floats = jacobian.dot(state.covariance)
    covariance: Floats = crossed.dot(jacobian.T) + noise
    inverse = _inverse(covariance)
    return Innovation(
        residual, covariance, crossed.T.dot(inverse), float(residual.dot(inverse).dot(residual))
    )


def updated(state: FilterState, measurement: Measurement) -> FilterState:
    """The state after ``measurement``."""
    return corrected(state, measurement, innovation(state, measurement))


def corrected(state: FilterState, measurement: Measurement, found: Innovation) -> FilterState:
    """The state after ``measurement``, whose innovation was ``found``: it moves by ``exp`` of gain times
    residual.

    The covariance has Joseph's form, which stays symmetric and positive semidefinite (Bucy, Joseph, 1968).
    """
    residual, jacobian, noise = measurement
    gain = found.gain
    rest = _identity(len(state.covariance)) - gain.dot(jacobian)
    covariance: Floats = rest.dot(state.covariance).dot(rest.T) + gain.dot(noise).dot(gain.T)
    return _moved(state, gain.dot(residual), (covariance + covariance.T) * 0.5)


def with_contact(state: FilterState, foot: str, offset: Floats, covariance: Floats) -> FilterState:
    """The state with a contact of ``foot`` at ``offset`` from the IMU, in its axes [m], (3,).

    ``covariance`` of the offset (3, 3) is in the IMU's axes. The new error is that of the position plus the
    turned error of the offset (Hartley et al., 6.2). Raises InvalidInput if the foot is in contact already.
    """
    if foot in state.feet:
        raise InvalidInput(f"foot {foot!r} is in contact already; measure it with contact()")
    size = len(state.covariance)
    grown = np.empty((size + 3, size + 3))
    grown[:size, :size] = state.covariance
    grown[size:, :size] = state.covariance[POSITION]
    grown[:size, size:] = state.covariance[:, POSITION]
    grown[size:, size:] = (
        state.covariance[POSITION, POSITION] + state.rotation @ covariance @ state.rotation.T
    )
    point = state.position + state.rotation @ offset
    contacts = np.concatenate((state.contacts, point[None]))
    return state._replace(feet=(*state.feet, foot), contacts=contacts, covariance=grown)


def without_contact(state: FilterState, foot: str) -> FilterState:
    """The state without the contact of ``foot``, marginalised. Raises InvalidInput if there is none."""
    row = contact_row(state, foot)
    kept = np.r_[:row, row + 3 : len(state.covariance)]
    index = state.feet.index(foot)
    return state._replace(
        feet=tuple(name for name in state.feet if name != foot),
        contacts=np.delete(state.contacts, index, axis=0),
        covariance=state.covariance[np.ix_(kept, kept)],
    )


def contact_row(state: FilterState, foot: str) -> int:
    """The first row of the contact of ``foot`` in the covariance. Raises InvalidInput if there is none."""
    if foot not in state.feet:
        raise InvalidInput(
            f"foot {foot!r} is not in contact; in contact are: {', '.join(state.feet) or 'none'}"
        )
    return _first_contact_row(state) + 3 * state.feet.index(foot)


def tracked_pose(state: FilterState, source: str) -> tuple[int, Tracked] | None:
    """The first row of the pose by ``source`` in the covariance, and the pose; None without one."""
    for number, tracked in enumerate(state.tracked):
        if tracked.source == source:
            return 15 + _TRACKED_SIZE * number, tracked
    return None


def with_tracked(state: FilterState, source: str, scale_sigma: float) -> FilterState:
    """The state with the pose by ``source`` at the present one, from where its displacements carry it on.

    ``scale_sigma`` is the standard deviation of the logarithm of the scale of a new source.
    """
    found, covariance = tracked_pose(state, source), state.covariance
    if found is None:
        row, size = _first_contact_row(state), len(covariance)
        places = [*range(row), *range(row + _TRACKED_SIZE, size + _TRACKED_SIZE)]
        grown = np.zeros((size + _TRACKED_SIZE, size + _TRACKED_SIZE))
        grown[np.ix_(places, places)] = covariance
        grown[row + 6, row + 6] = scale_sigma * scale_sigma
        covariance = grown
        tracked = (*state.tracked, Tracked(source, state.rotation, state.position, 0.0))
    else:
        row, last = found
        here = last._replace(rotation=state.rotation, position=state.position)
        tracked = tuple(here if one is last else one for one in state.tracked)
    rows = np.arange(len(covariance))
    rows[row : row + 6] = *range(ROTATION.start, ROTATION.stop), *range(POSITION.start, POSITION.stop)
    return state._replace(covariance=covariance[np.ix_(rows, rows)], tracked=tracked)


def carried(
    state: FilterState, source: str, moved: Floats, covariance: Floats, imu_from_frame: Floats, *, dt_s: float
) -> FilterState:
    """The state after ``source`` has measured that a frame moved by ``moved``, earlier_from_present, (4, 4).

    ``covariance`` (6, 6) is that of what its error grows by: rotation, then translation, of ``exp(error)
    moved``. The way of ``dt_s`` seconds that an error of the scale changes is that of the state. The measured
    one has the noise of the poses, which would shrink the scale (attenuation by errors in variables).
    """
    found = tracked_pose(state, source)
    assert found is not None
    row, last = found
    start = _pose(last.rotation, last.position).dot(imu_from_frame)
    scaled = moved.copy()
    scaled[:3, 3] *= math.exp(last.log_scale)
    frame_from_imu = np.linalg.inv(imu_from_frame)
    end = start.dot(scaled).dot(frame_from_imu)
    transition = _identity(len(state.covariance)).copy()
    transition[row + 3 : row + 6, row + 6] = state.velocity * dt_s
    grown = transition.dot(state.covariance).dot(transition.T)
    spread = adjoint(start)
    grown[row : row + 6, row : row + 6] += spread.dot(covariance).dot(spread.T)
    here = last._replace(rotation=end[:3, :3], position=end[:3, 3])
    tracked = tuple(here if one is last else one for one in state.tracked)
    return state._replace(covariance=grown, tracked=tracked)


def height_rows(state: FilterState) -> list[int]:
    """The places of the errors of z in the covariance: of the position, of tracked poses and of contacts."""
    first = _first_contact_row(state)
    return [
        POSITION.start + 2,
        *range(15 + 5, first, _TRACKED_SIZE),
        *range(first + 2, len(state.covariance), 3),
    ]


def without_tracked(state: FilterState) -> FilterState:
    """The state without poses by other odometries, as if its own changes but by motion."""
    first = _first_contact_row(state)
    kept = np.r_[:15, first : len(state.covariance)]
    return state._replace(covariance=state.covariance[np.ix_(kept, kept)], tracked=())


def adjoint(pose: Floats) -> Floats:
    """What turns the error of a displacement from a pose, (4, 4), into that of the world: (6, 6)."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = pose[:3, :3]
    matrix[3:, :3] = skew(pose[:3, 3]).dot(pose[:3, :3])
    return matrix


def _pose(rotation: Floats, position: Floats) -> Floats:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def _first_contact_row(state: FilterState) -> int:
    return 15 + _TRACKED_SIZE * len(state.tracked)


def _moved(state: FilterState, error: Floats, covariance: Floats) -> FilterState:
    """The estimate ``exp(error) X'`` and the biases plus theirs, with ``covariance``."""
    rotation, left_jacobian, _ = gammas(error[ROTATION])
    turned: Floats = rotation.dot(state.rotation)
    # A step of Newton's iteration towards the nearest rotation keeps rounding from accumulating.
    turned = turned.dot(_THREE_HALVES - turned.T.dot(turned) * 0.5)
    contacts = state.contacts
    if state.feet:
        moves = error[_first_contact_row(state) :].reshape(-1, 3)
        contacts = contacts.dot(rotation.T) + moves.dot(left_jacobian.T)
    tracked = state.tracked
    if tracked:
        errors = error[15 : _first_contact_row(state)].reshape(-1, _TRACKED_SIZE)
        tracked = tuple(_moved_tracked(one, moved) for one, moved in zip(tracked, errors, strict=True))
    return FilterState(
        turned,
        rotation.dot(state.velocity) + left_jacobian.dot(error[VELOCITY]),
        rotation.dot(state.position) + left_jacobian.dot(error[POSITION]),
        state.gyro_bias + error[GYRO_BIAS],
        state.accel_bias + error[ACCEL_BIAS],
        state.feet,
        contacts,
        covariance,
        tracked,
    )


def _moved_tracked(pose: Tracked, error: Floats) -> Tracked:
    rotation, left_jacobian, _ = gammas(error[:3])
    return Tracked(
        pose.source,
        rotation.dot(pose.rotation),
        rotation.dot(pose.position) + left_jacobian.dot(error[3:6]),
        pose.log_scale + float(error[6]),
    )


def _inverse(matrix: Floats) -> Floats:
    """The inverse of a covariance; that of three numbers by cofactors, which takes a third of the time."""
    if len(matrix) != 3:
        return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    (a, b, c), (_, d, e), (_, _, f) = matrix.tolist()
    aa, ab, ac = d * f - e * e, c * e - b * f, b * e - c * d
    bb, bc, cc = a * f - c * c, b * c - a * e, a * d - b * b
    return np.array(((aa, ab, ac), (ab, bb, bc), (ac, bc, cc))) * (1.0 / (a * aa + b * ab + c * ac))


def _invariant_from_plain(state: FilterState) -> Floats:
    """The derivative of the invariant error by the plain one: 1 and [v], [p], [c] below the rotation."""
    matrix = np.eye(len(state.covariance))
    matrix[VELOCITY, ROTATION] = skew(state.velocity)
    matrix[POSITION, ROTATION] = skew(state.position)
    first = _first_contact_row(state)
    for row, tracked in zip(range(15, first, _TRACKED_SIZE), state.tracked, strict=True):
        matrix[row + 3 : row + 6, row : row + 3] = skew(tracked.position)
    matrix[first:, ROTATION] = (state.contacts @ SKEW).reshape(-1, 3)
    return matrix


@cache
def _identity(size: int) -> Floats:
    return np.eye(size)


@cache
def _constant_biases(size: int) -> Floats:
    """The part of the transition that keeps biases: (size, 6)."""
    return np.eye(size)[:, 9:15].copy()


@lru_cache(maxsize=64)
def white_noise(noise: ImuNoise) -> Floats:
    """Squared densities of the white noise of gyro and accelerometer, (6,). Not to be written to."""
    return np.repeat((noise.gyro, noise.accel), 3) ** 2


@lru_cache(maxsize=64)
def _walks(noise: ImuNoise, contact_noise: float, first_contact: int, size: int) -> Floats:
    """Squared densities of the random walks of the errors: (size,). Tracked poses have none."""
    counts = (9, 3, 3, first_contact - 15, size - first_contact)
    return np.repeat((0.0, noise.gyro_bias, noise.accel_bias, 0.0, contact_noise), counts) ** 2
