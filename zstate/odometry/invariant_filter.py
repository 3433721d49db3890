"""Invariant Kalman filter of a body with an IMU: orientation, velocity, position, biases and contacts.

The state is (R, v, p, c_1 ... c_k) of SE_{2+k}(3), with the IMU's axes as the body: ``R`` world_from_imu,
``v`` and ``p`` of the IMU's origin in the world, contact points ``c`` in the world, with the biases of
gyro and accelerometer. The world has z up, and gravity (0, 0, -9.80665) m/s^2.

The error is right-invariant: truth X and estimate X' are ``X = exp(xi) X'``, and a bias is ``b = b' + zeta``.
To first order ``xi`` is, with the cross product matrix [.],

    rotation   phi                   R = exp([phi]) R', about world axes [rad]
    velocity   v - v' + [v'] phi     [m/s]
    position   p - p' + [p'] phi     [m], and contacts likewise

Covariances have this order, then the biases of gyro and accelerometer, then contacts: (15 + 3k, 15 + 3k).
Apart from biases, the propagation of this error does not depend on the estimate, so that the filter stays
consistent where one with Euler angles or a linear position error does not.

Formulas: Hartley, Ghaffari, Eustice, Grizzle, "Contact-aided invariant extended Kalman filtering for robot
state estimation", IJRR 39 (2020), with the sign of the error changed; Barrau, Bonnabel, "The invariant
extended Kalman filter as a stable observer", IEEE TAC 62 (2017).
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
"""The places of the errors in a covariance; that of contact i is 15 + 3i to 18 + 3i."""

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


class FilterState(NamedTuple):
    """An estimate and the covariance of its error. Arrays are not to be written to.

    ``rotation`` is world_from_imu, (3, 3); ``velocity`` [m/s] and ``position`` [m] of the IMU in the world,
    (3,); ``gyro_bias`` [rad/s] and ``accel_bias`` [m/s^2] in the IMU's axes, (3,). ``feet`` are the names of
    the k contacts, and ``contacts`` their points in the world [m], (k, 3). ``covariance`` is that of the
    right-invariant error, (15 + 3k, 15 + 3k), in the order of the module's docstring.
    """

    rotation: Floats
    velocity: Floats
    position: Floats
    gyro_bias: Floats
    accel_bias: Floats
    feet: tuple[str, ...]
    contacts: Floats
    covariance: Floats


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
    """The covariance of plain errors: (15 + 3k, 15 + 3k).

    They are the rotation about world axes [rad] and the differences of velocity, position, biases and
    contacts, each truth minus estimate.
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

    size = len(state.covariance)
    transition = _identity(size).copy()
    fall = _STANDARD_GRAVITY * dt_s
    transition[3, 1], transition[4, 0] = fall, -fall
    transition[6, 1], transition[7, 0] = 0.5 * fall * dt_s, -0.5 * fall * dt_s
    transition[6, 3] = transition[7, 4] = transition[8, 5] = dt_s
    transition[ROTATION, GYRO_BIAS] = transition[VELOCITY, ACCEL_BIAS] = turn
    transition[3:9, GYRO_BIAS] = shifts[:6]
    transition[POSITION, ACCEL_BIAS] = turned[2] * (-dt_s * dt_s)
    if state.feet:
        transition[15:, GYRO_BIAS] = shifts[6:]
    walks = _walks(noise, contact_noise, size)
    if white is None:
        white = white_noise(noise)
    effects = transition[:, 9:15] - _constant_biases(size)
    added = walks * dt_s
    added[POSITION] = white[3:].max() * dt_s**3 / 12.0

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
    return 15 + 3 * state.feet.index(foot)


def _moved(state: FilterState, error: Floats, covariance: Floats) -> FilterState:
    """The estimate ``exp(error) X'`` and the biases plus theirs, with ``covariance``."""
    rotation, left_jacobian, _ = gammas(error[ROTATION])
    turned: Floats = rotation.dot(state.rotation)
    # A step of Newton's iteration towards the nearest rotation keeps rounding from accumulating.
    turned = turned.dot(_THREE_HALVES - turned.T.dot(turned) * 0.5)
    contacts = state.contacts
    if state.feet:
        contacts = contacts.dot(rotation.T) + error[15:].reshape(-1, 3).dot(left_jacobian.T)
    return FilterState(
        turned,
        rotation.dot(state.velocity) + left_jacobian.dot(error[VELOCITY]),
        rotation.dot(state.position) + left_jacobian.dot(error[POSITION]),
        state.gyro_bias + error[GYRO_BIAS],
        state.accel_bias + error[ACCEL_BIAS],
        state.feet,
        contacts,
        covariance,
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
    matrix[15:, ROTATION] = (state.contacts @ SKEW).reshape(-1, 3)
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
def _walks(noise: ImuNoise, contact_noise: float, size: int) -> Floats:
    """Squared densities of the random walks of the errors: (size,)."""
    return np.repeat((0.0, noise.gyro_bias, noise.accel_bias, contact_noise), (9, 3, 3, size - 15)) ** 2
