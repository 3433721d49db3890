"""Initial alignment: the first state of a base, from the first samples of its IMU.

At rest the specific force is opposite to gravity, which gives roll and pitch, and the mean of the gyro is its
bias. The base then starts at the origin of the odometry frame, with the yaw zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from zstate.checks import Floats
from zstate.odometry.fusion import MOST_BIAS, Estimate, Inertia, started
from zstate.odometry.invariant_filter import GRAVITY, POSITION, ROTATION, initial_state
from zstate.odometry.rotations import rotation_exp, skew
from zstate.transform import Transform

ALIGNMENT_S = 0.5
"""How long the base must be at rest."""

COARSE_S = 2.0
"""A base that does not come to rest in this time is aligned with its mean acceleration, coarsely."""

_LEAST_SAMPLES = 5
_BLOCK_S = 0.1
_REST_RATE, _REST_FORCE = 0.1, 0.4
"""[rad/s] and [m/s^2]: means of 0.1 s at rest are no larger: biases, and what is left of the noise."""

_NO_FORCE = 0.1
"""[m/s^2] What an accelerometer reads without any signal is less."""
_FORCE_PART = 0.5
"""A part of gravity: the mean of a robot that drives differs by less."""

# Standard deviations of the first state, in the order of the filter: rad, m/s, m, rad/s, m/s^2.
_YAW, _POSITION = 1e-4, 1e-4
_TILT, _COARSE_TILT = 0.02, 0.2
_SPEED = 2.0
_GYRO_BIAS, _UNKNOWN_GYRO_BIAS, _ACCEL_BIAS = 0.01, 0.02, 0.05
_TURN = 0.3
"""The standard deviation of a turn by wheels, as a part of it: they may slip, or skid."""


class Alignment(NamedTuple):
    """The first estimate, and the stamp of the last sample that had a part in it."""

    estimate: Estimate
    end: int


def align(
    samples: Sequence[Inertia], turns: Sequence[tuple[int, Floats]], imu_from_base: Floats
) -> Alignment | str:
    """The first estimate by ``samples``, in the order of their stamps; or what is missing.

    A robot that moves evenly seems to be at rest, so that its velocity is left open: wheels measure it.
    ``turns`` are rates by wheels in the IMU's axes [rad/s], (3,), with their stamps. What the gyro measures
    beyond an even turn is its bias.
    """
    if not samples:
        return "no samples of the IMU yet, which give roll and pitch"
    # Accelerometers that warm up read zeros, which show no direction.
    samples = [sample for sample in samples if sample.accel @ sample.accel > _NO_FORCE**2]
    if not samples:
        return "the accelerometer reads 0; at rest it measures 9.8 m/s^2 upwards"
    chosen, is_at_rest = _chosen(samples)
    if not chosen:
        span = (samples[-1].stamp - samples[0].stamp) * 1e-9
        return (
            f"{span:.2g} s of samples of the IMU, {len(samples)} in number; roll and pitch take "
            f"{ALIGNMENT_S:g} s at rest, or {COARSE_S:g} s in motion"
        )
    gyro, accel = _mean(chosen)
    force = math.sqrt(accel @ accel)
    if abs(force + GRAVITY[2]) > _FORCE_PART * -GRAVITY[2]:
        return (
            f"the accelerometer reads {force:.3g} m/s^2 in the mean of {len(chosen)} samples, and gravity is "
            "9.8 m/s^2: check its unit, which is not g, and that gravity is not subtracted"
        )
    rotation = _level(accel, imu_from_base)
    tilt = _TILT if is_at_rest else _COARSE_TILT
    gyro_bias, bias_sigma = np.zeros(3), _UNKNOWN_GYRO_BIAS
    if is_at_rest:
        rates = [rate for stamp, rate in turns if chosen[0].stamp <= stamp <= chosen[-1].stamp]
        turn = np.mean(rates, axis=0) if rates else np.zeros(3)
        if float(np.abs(gyro - turn).max()) < MOST_BIAS:
            gyro_bias, bias_sigma = gyro - turn, math.hypot(_GYRO_BIAS, _TURN * math.sqrt(turn @ turn))
    sigmas = np.repeat((tilt, _SPEED, _POSITION, bias_sigma, _ACCEL_BIAS), 3)
    sigmas[2] = _YAW
    covariance = np.diag(sigmas**2)
    estimate = _started(chosen[0].stamp, rotation, imu_from_base, gyro_bias, covariance)
    return Alignment(estimate, chosen[-1].stamp)


def start_at(stamp: int, odom_from_base: Transform, imu_from_base: Floats) -> Estimate:
    """The estimate at a given pose, whose covariance is that of the transform, or that of ``align``."""
    covariance = np.diag(np.repeat((_TILT, _SPEED, _POSITION, _UNKNOWN_GYRO_BIAS, _ACCEL_BIAS), 3) ** 2)
    if odom_from_base.covariance is None:
        covariance[2, 2] = _YAW**2
    else:
        rows = np.r_[6:9, 0:3]
        covariance[np.ix_(rows, rows)] = odom_from_base.covariance
    matrix = odom_from_base.matrix
    rotation = matrix[:3, :3] @ imu_from_base[:3, :3].T
    return _started(stamp, rotation, imu_from_base, np.zeros(3), covariance, matrix[:3, 3])


def _started(  # noqa: PLR0917 - the parts of one state
    stamp: int,
    rotation: Floats,
    imu_from_base: Floats,
    gyro_bias: Floats,
    covariance: Floats,
    base: Floats | None = None,
) -> Estimate:
    lever = rotation @ imu_from_base[:3, 3]
    position = (np.zeros(3) if base is None else base) - lever
    # It is the position of the base that is known: that of the IMU has the error of the tilt.
    imu_from_plain = np.eye(15)
    imu_from_plain[POSITION, ROTATION] = skew(lever)
    state = initial_state(
        rotation=rotation,
        velocity=np.zeros(3),
        position=position,
        gyro_bias=gyro_bias,
        accel_bias=np.zeros(3),
        covariance=imu_from_plain @ covariance @ imu_from_plain.T,
    )
    return started(stamp, state)


def _chosen(samples: Sequence[Inertia]) -> tuple[Sequence[Inertia], bool]:
    """The first samples that are enough, and whether they are at rest; none while there are too few."""
    start = block = 0
    still: tuple[Floats, Floats] | None = None
    for end, sample in enumerate(samples, 1):
        if sample.stamp - samples[block].stamp < _BLOCK_S * 1e9:
            continue
        mean = _mean(samples[block:end])
        if not _is_at_rest(*mean, mean if still is None else still):
            start, still = end, None
        else:
            still = still or mean
            if _is_long(samples[start:end], ALIGNMENT_S):
                return samples[start:end], True
        block = end
        if _is_long(samples[:end], COARSE_S):
            return samples[:end], False
    return (), False


def _mean(samples: Sequence[Inertia]) -> tuple[Floats, Floats]:
    """The mean rate and force."""
    gyro, accel = np.mean([(one.gyro, one.accel) for one in samples], axis=0)
    return gyro, accel


def _is_long(samples: Sequence[Inertia], seconds: float) -> bool:
    return len(samples) >= _LEAST_SAMPLES and samples[-1].stamp - samples[0].stamp >= seconds * 1e9


def _is_at_rest(gyro: Floats, accel: Floats, first: tuple[Floats, Floats]) -> bool:
    """Whether the means of a block are those of a base at rest, and the same as in the first block."""
    force = math.sqrt(accel @ accel)
    return (
        float(np.abs(gyro).max()) < _REST_RATE
        and abs(force + GRAVITY[2]) < _REST_FORCE
        and float(np.abs(accel - first[1]).max()) < _REST_FORCE
    )


def _level(force: Floats, imu_from_base: Floats) -> Floats:
    """world_from_imu whose z axis is that of ``force``, with the yaw of the base zero: (3, 3)."""
    up = force / math.sqrt(force @ force)
    axis = np.cross(up, (0.0, 0.0, 1.0))
    sine, cosine = math.sqrt(axis @ axis), float(up[2])
    if sine < 1e-9:
        turn = np.array([0.0 if cosine > 0.0 else math.pi, 0.0, 0.0])
    else:
        turn = axis * (math.atan2(sine, cosine) / sine)
    rotation = rotation_exp(turn)
    forward = rotation @ imu_from_base[:3, 0]
    return rotation_exp(np.array([0.0, 0.0, -math.atan2(forward[1], forward[0])])) @ rotation
