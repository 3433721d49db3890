"""The delay of a source's stamps against those of the IMU, from what both measure of one motion.

Wheels, velocities and poses give the yaw or the speed of the base at their stamps; the integral of the gyro
and of the accelerometer gives its changes. With a delay ``d``, the change of the source between two stamps is
that of the IMU ``d`` earlier, up to a scale and a bias:

    C(t2) - C(t1) = a (S(t2 - d) - S(t1 - d)) + b (t2 - t1).

The delay is that of the least squares of a, b and d. Its variance is that of the residuals by the curvature
of their sum of squares, which counts intervals that overlap once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.checks import Floats
from zstate.model.joint_history import JointHistory
from zstate.odometry import Wheels
from zstate.odometry.messages import Imu
from zstate.odometry.sensors import SensorKind
from zstate.wire.messages import StampedMessage, from_block

_REACH_S, _STEP_S = 0.5, 0.01
"""Delays are searched up to this size, in these steps: a base does not change its turn in less."""

_INTERVAL_S = 0.2
"""Changes over less are mostly the steps of encoders."""

_MOST_INTERVALS = 20_000
_LEAST_INTERVALS = 20

_LEAST_PART = 0.5
"""The least part of a source's variance that the IMU explains; less is no motion that both measure."""

_LARGEST_SIGMA_S = 0.02


class Series(NamedTuple):
    """The yaw [rad] or the speed [m/s] of a base, up to a constant, at increasing times [s]: (n,) each."""

    seconds: Floats
    values: Floats


class Delay(NamedTuple):
    """How much later the stamps of a source are than those of the IMU, and its standard deviation [s]."""

    delay_s: float
    sigma_s: float


class Motions:
    """Yaw and speed of a base by its IMU and by other sources, which give the delays of their stamps.

    Times are seconds since the first reading of the IMU.
    """

    def __init__(self, mounts: TransformBuffer, base: str, readings: Sequence[Imu]) -> None:
        self._mounts, self._base, self._origin = mounts, base, readings[0].stamp
        rotation = self._rotation(readings[0].frame)
        seconds = self._times(readings)
        gyro, accel = (
            np.array([from_block(block) for block in blocks]) @ rotation.T
            for blocks in ([one.gyro for one in readings], [one.accel for one in readings])
        )
        self._yaw, self._speed = _integrated(seconds, gyro[:, 2]), _integrated(seconds, accel[:, 0])

    def delay_of(self, kind: SensorKind, messages: Sequence[Any]) -> Delay | None:
        """That of a sensor whose messages show a yaw or a speed; None for one of another kind."""
        if kind.motion is None:
            return None
        motion, seconds = kind.motion(messages, self._rotation), self._times(messages)
        yaw = None if motion.yaw is None else Series(seconds, motion.yaw)
        if motion.yaw_rate is not None:
            yaw = _integrated(seconds, motion.yaw_rate)
        return self.delay(yaw, None if motion.speed is None else Series(seconds, motion.speed))

    def delay(self, yaw: Series | None, speed: Series | None) -> Delay | None:
        """That of a source with this yaw and this speed, where it has them."""
        pairs = ((self._yaw, yaw), (self._speed, speed))
        return _surest_delay((imu, source) for imu, source in pairs if source is not None)

    def of_wheels(self, wheels: Wheels, joints: JointHistory) -> tuple[Series, Series]:
        """Their yaw at the readings, and their speed in the middle between two of them."""
        seconds = _seconds(joints.stamps, self._origin)
        rows = [dict(zip(joints.coordinates, row, strict=True)) for row in joints.positions.tolist()]
        steps = np.diff(seconds)
        moves = [
            wheels.velocity(before, after, dt_s)
            for before, after, dt_s in zip(rows, rows[1:], steps.tolist(), strict=False)
        ]
        yaw_rates = np.array([move.angular[2] for move in moves])
        yaw = np.concatenate(((0.0,), np.cumsum(yaw_rates * steps)))
        return Series(seconds, yaw), Series(
            seconds[:-1] + 0.5 * steps, np.array([one.linear[0] for one in moves])
        )

    def _rotation(self, frame: str) -> Floats:
        return self._mounts.lookup(self._base, frame).matrix[:3, :3]

    def _times(self, messages: Sequence[StampedMessage]) -> Floats:
        return _seconds(np.array([one.stamp for one in messages], dtype=np.int64), self._origin)


def _seconds(stamps: NDArray[np.int64], origin: int) -> Floats:
    return (stamps - origin).astype(np.float64) * 1e-9


def _integrated(seconds: Floats, rates: Floats) -> Series:
    """The integral of ``rates``, by the trapezoidal rule."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(seconds)
    return Series(seconds, np.concatenate(((0.0,), np.cumsum(steps))))


def _surest_delay(pairs: Iterable[tuple[Series, Series]]) -> Delay | None:
    """The surest delay of ``pairs`` of the IMU and the source, as of yaw and of speed; None without any."""
    found = [delay for imu, source in pairs if (delay := fitted_delay(imu, source)) is not None]
    return min(found, key=lambda delay: delay.sigma_s, default=None)


def fitted_delay(imu: Series, source: Series) -> Delay | None:
    """The delay of ``source``; None if the motion does not determine it within 20 ms."""
    intervals = _intervals(imu, source)
    if intervals is None:
        return None
    starts, ends, changes, period_s = intervals
    durations = ends - starts
    unexplained, _ = _fit(changes, durations, np.zeros(len(changes)))
    delays = np.arange(-_REACH_S, _REACH_S + 0.5 * _STEP_S, _STEP_S)
    fits = [
        _fit(changes, durations, np.interp(ends - delay, *imu) - np.interp(starts - delay, *imu))
        for delay in delays.tolist()
    ]
    sums = np.array([fit[0] for fit in fits])
    best = int(sums.argmin())
    if best in {0, len(sums) - 1} or sums[best] > (1.0 - _LEAST_PART) * unexplained or fits[best][1] <= 0.0:
        return None
    before, at, after = sums[best - 1 : best + 2].tolist()
    curvature = 0.5 * (before - 2.0 * at + after)  # per step squared
    if curvature <= 0.0:
        return None
    shift = 0.25 * (before - after) / curvature
    count = len(changes) * min(1.0, period_s / float(durations.mean()))
    sigma_s = _STEP_S * math.sqrt(
        max(at - curvature * shift * shift, 0.0) / (curvature * max(count - 3.0, 1.0))
    )
    if sigma_s > _LARGEST_SIGMA_S:
        return None
    return Delay(float(delays[best]) + shift * _STEP_S, sigma_s)


def _intervals(imu: Series, source: Series) -> tuple[Floats, Floats, Floats, float] | None:
    """Begin and end of intervals [s], the change of the source in each, and their mean period [s]."""
    seconds, values = source
    if len(seconds) < _LEAST_INTERVALS or len(imu.seconds) < _LEAST_INTERVALS:
        return None
    length_s = max(_INTERVAL_S, 1.5 * float(np.median(np.diff(seconds))))
    first = np.arange(0, len(seconds), max(1, len(seconds) // _MOST_INTERVALS))
    last = np.searchsorted(seconds, seconds[first] + length_s - 1e-6)
    first, last = first[last < len(seconds)], last[last < len(seconds)]
    starts, ends = seconds[first], seconds[last]
    kept = (
        (starts >= imu.seconds[0] + _REACH_S)
        & (ends <= imu.seconds[-1] - _REACH_S)
        & (ends - starts <= 2.0 * length_s)
    )
    if np.count_nonzero(kept) < _LEAST_INTERVALS:
        return None
    starts, ends, changes = starts[kept], ends[kept], (values[last] - values[first])[kept]
    return starts, ends, changes, float(starts[-1] - starts[0]) / (len(starts) - 1)


def _fit(changes: Floats, durations: Floats, explained: Floats) -> tuple[float, float]:
    """The least sum of squares of ``changes - a explained - b durations``, and ``a``."""
    free = explained - durations * (durations @ explained) / (durations @ durations)
    rest = changes - durations * (durations @ changes) / (durations @ durations)
    size = float(free @ free)
    scale = float(free @ rest) / size if size > 0.0 else 0.0
    return float(rest @ rest) - scale * scale * size, scale
