"""Fusion of readings: from the estimate after one event to that after the next, as a function of both alone.

``Estimate`` has all that decides on the next event, so that events can be replayed from any estimate that was
kept.

- Between events the IMU is interpolated, and predicts. Without samples for more than 0.1 s, the base keeps
  its velocity in its own axes, and turns at the rate of the wheels, with large noise. If the wheels are
  silent, too, it turns at the last rate, give or take a constant 0.5 rad/s.
- A reading whose NIS exceeds the 99.9 % gate is rejected. After two seconds of rejections that agree with one
  another, the estimate follows: the variance of what they measure grows by their squared residual.
- If wheels and gyro agree for 0.1 s that the base stands, its velocity is zero, and the gyro measures its own
  bias.
- A heading is relative to the first one of its source: the odometry frame has no north. The error of a
  compass turns with the robot and its place and does not average out. So the variance of the yaw is never
  lowered below that of the source, which is the stated one or, if larger, the mean square that its
  innovations have shown for 20 s. A compass that is wrong by tens of degrees loses its weight; one that is
  right still bounds the drift. Until it has shown which, in the first minutes, it may be off by 0.5 rad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from zstate.odometry.health import Outcome, gate
from zstate.odometry.invariant_filter import (
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    FilterState,
    Floats,
    ImuNoise,
    Measurement,
    corrected,
    innovation,
    predict,
    updated,
)
from zstate.odometry.legs import Foot, Legs, updated_by_feet
from zstate.odometry.measurements import heading, zero_velocity

SILENCE_NS = 100_000_000
"""Without samples of the IMU for longer, the base coasts."""

STANDSTILL = "standstill"
"""The name of zero-velocity updates as a source."""

_REACQUIRE_NS, _REACQUIRE_COUNT = 2_000_000_000, 10
_LONGEST_STEP_S = 0.1
_REST_NS = 100_000_000
_WHEELS_VALID_NS = 300_000_000
_REST_SPEED = 0.02
"""[m/s] The velocity of a base at rest is zero up to this standard deviation: it may rock."""
_REST_RATE = 1e-3  # rad/s
_STILL_SPEED, _STILL_RATE = 0.005, 0.02
"""[m/s], [rad/s]: wheels at rest measure no more, unless their noise is larger."""
_REST_FORCE = 0.5
"""[m/s^2] The specific force of a base at rest differs from gravity by less; a bias is part of it."""

_DEVIATION_S = 20.0
_UNPROVEN, _PROVING_S = 0.5, 100.0
"""[rad], [s]: the standard deviation of a compass at its first reading, whose square falls to 1/e so fast."""
_SAMPLED_S, _SAMPLED_GAIN = 0.01, 0.05
"""The time between samples of the IMU before it is known, and how fast its mean follows."""

_YAW = ROTATION.start + 2
_LEVEL = slice(POSITION.start, POSITION.start + 2)

COASTING_RATE_DENSITY, _COASTING_FORCE_DENSITY = 0.1, 1.0
"""Of the rate by wheels [rad/s/sqrt(Hz)], and of unknown accelerations [m/s^2/sqrt(Hz)]."""
_COASTING_WHEELS_NS = 100_000_000
"""The rate of the wheels is used for so long."""
_UNKNOWN_RATE = 0.5
"""[rad/s] The standard deviation of a rate that neither IMU nor wheels measure, about the last one."""


class Inertia(NamedTuple):
    """A sample of an IMU: rate [rad/s] and specific force [m/s^2] in its axes, (3,)."""

    stamp: int
    gyro: Floats
    accel: Floats


class Reading(NamedTuple):
    """A measurement: a function of the state and of the IMU's rate at that instant.

    ``is_still`` is of velocities, else None; ``angular`` is their rate in the IMU's axes [rad/s], (3,), if
    known. ``is_position``: it measures the position in the world.
    """

    stamp: int
    measure: Callable[[FilterState, Floats], Measurement]
    is_still: bool | None = None
    angular: Floats | None = None
    is_position: bool = False
    scale: float = 0.0


class Heading(NamedTuple):
    """The yaw of a frame in the axes of a compass [rad], with its variance [rad^2]."""

    stamp: int
    yaw: float
    variance: float
    imu_from_frame: Floats


class Contacts(NamedTuple):
    """The feet on the ground, as measured."""

    stamp: int
    touching: frozenset[str]


class Steps(NamedTuple):
    """Where feet are by the joints, and what ``Legs.touching`` needs to detect contacts."""

    stamp: int
    feet: tuple[Foot, ...]
    velocities: Mapping[str, float] | None
    efforts: Mapping[str, float] | None


class Run(NamedTuple):
    """Rejections of a source in a row that agree with one another."""

    start: int
    length: int
    residual: Floats


class Compass(NamedTuple):
    """What is known of a source of headings.

    ``start`` is the stamp of its first reading, ``offset`` its yaw minus ours then, and ``offset_variance``
    that of our yaw then. ``deviation`` is the variance by which its errors exceed the stated one, and
    ``excess`` their present mean.
    """

    start: int
    stamp: int
    offset: float
    offset_variance: float
    excess: float
    deviation: float


class Rest(NamedTuple):
    """Sums of the IMU since ``start``, to decide whether the base stands."""

    start: int
    size: int
    gyro: Floats
    accel: Floats
    was_still: bool


class Drift(NamedTuple):
    """What constant errors of wheels and gyro do to the pose, since the position was last measured.

    ``origin`` is that position [m] and ``scale`` the standard deviation of the relative error of wheels.
    ``turns`` (2, 3) are the integrals of (1, y, -x), what a turn does to yaw, x and y of the right-invariant
    error: over the yaw turned since [rad], and over the time in motion since [s].
    """

    origin: Floats
    scale: float = 0.0
    turns: Floats = np.zeros((2, 3))


class Estimate(NamedTuple):
    """The state of the filter after an event, and what decides on the next one.

    ``rate`` and ``force`` are those of the IMU at ``stamp``, interpolated, or assumed if ``is_coasting``.
    ``moved_at`` is the stamp of the last velocity that was not zero, ``angular`` the rate by wheels in the
    IMU's axes [rad/s], ``wheels_at`` their stamp. ``touching`` are the feet on the ground, if measured.
    ``sampled_s`` is the mean time between samples of the IMU, over which the noise of a rate is averaged.
    """

    stamp: int
    state: FilterState
    rate: Floats
    force: Floats
    imu: Inertia | None
    rest: Rest
    drift: Drift
    is_coasting: bool = False
    sampled_s: float = _SAMPLED_S
    wheels_at: int | None = None
    moved_at: int = 0
    angular: Floats | None = None
    touching: frozenset[str] | None = None
    runs: dict[str, Run] = {}  # noqa: RUF012 - replaced, never written to
    compasses: dict[str, Compass] = {}  # noqa: RUF012 - replaced, never written to


def started(stamp: int, state: FilterState) -> Estimate:
    """The first estimate, before any event."""
    rate, force = state.gyro_bias, state.rotation.T @ -GRAVITY + state.accel_bias
    return Estimate(stamp, state, rate, force, None, _new_rest(stamp), Drift(state.position))


@dataclass(frozen=True, slots=True)
class Fusion:
    """The functions from one estimate to the next, for an IMU with ``noise``, and ``legs`` if any."""

    noise: ImuNoise
    legs: Legs | None = None

    def after_inertia(self, before: Estimate, sample: Inertia) -> tuple[Estimate, Outcome | None]:
        """The estimate at a sample of the IMU; with an outcome if the base was found to stand."""
        estimate = self.predicted(before, sample.stamp, sample)
        start, size, gyro, accel, was_still = estimate.rest
        rest = Rest(start, size + 1, gyro + sample.gyro, accel + sample.accel, was_still)
        sampled_s = estimate.sampled_s
        if before.imu is not None and not estimate.is_coasting:
            sampled_s += _SAMPLED_GAIN * ((sample.stamp - before.imu.stamp) * 1e-9 - sampled_s)
        estimate = estimate._replace(
            imu=sample,
            rate=sample.gyro,
            force=sample.accel,
            is_coasting=False,
            rest=rest,
            sampled_s=sampled_s,
        )
        if sample.stamp - start < _REST_NS:
            return estimate, None
        return self._at_end_of_rest(estimate)

    def after_reading(
        self, before: Estimate, source: str, reading: Reading, following: Inertia | None
    ) -> tuple[Estimate, Outcome]:
        """The estimate after a reading, and its outcome. ``following`` is the next sample of the IMU."""
        estimate = self.predicted(before, reading.stamp, following)
        if reading.is_still is not None:
            estimate = estimate._replace(
                wheels_at=reading.stamp,
                moved_at=estimate.moved_at if reading.is_still else reading.stamp,
                angular=reading.angular,
            )
        if reading.scale > estimate.drift.scale:
            estimate = estimate._replace(drift=estimate.drift._replace(scale=reading.scale))
        if reading.is_position:
            estimate = self.settled(estimate)
        return _gated(estimate, source, reading.measure(estimate.state, estimate.rate))

    def after_heading(
        self, before: Estimate, source: str, reading: Heading, following: Inertia | None
    ) -> tuple[Estimate, Outcome]:
        """The estimate after a heading, and what became of it."""
        estimate = self.predicted(before, reading.stamp, following)
        compass = estimate.compasses.get(source)
        offset = 0.0 if compass is None else compass.offset
        measurement = heading(estimate.state, reading.yaw - offset, reading.variance, reading.imu_from_frame)
        residual = float(measurement.residual[0])
        row = measurement.jacobian[0]
        settled = self.settled(estimate)
        variance = float(row @ settled.state.covariance @ row)
        if compass is None:
            first = Compass(reading.stamp, reading.stamp, residual, variance, 0.0, 0.0)
            return _with_compass(estimate, source, first), Outcome("accepted", 1.0, 1)
        # The first reading has an error as well, and that of our yaw then is part of the present one.
        expected = variance + 2.0 * reading.variance
        share = 1.0 - math.exp(-(reading.stamp - compass.stamp) * 1e-9 / _DEVIATION_S)
        excess = compass.excess + share * (residual * residual - expected - compass.excess)
        deviation = max(compass.deviation, excess)
        compass = compass._replace(stamp=reading.stamp, excess=excess, deviation=deviation)
        estimate = _with_compass(estimate, source, compass)
        age_s = (reading.stamp - compass.start) * 1e-9
        deviation = max(deviation, _UNPROVEN * _UNPROVEN * math.exp(-age_s / _PROVING_S))
        nis = residual * residual / expected
        if residual * residual > gate(1) * (expected + deviation):
            return estimate, Outcome("rejected", nis, 1)
        floor = reading.variance + deviation + compass.offset_variance
        if variance > floor:
            # Such a noise lowers the variance to the floor: 1 / variance + 1 / noise = 1 / floor.
            noise = np.array([[variance * floor / (variance - floor)]])
            estimate = estimate._replace(
                state=updated(estimate.state, measurement._replace(covariance=noise))
            )
        return estimate, Outcome("accepted", nis, 1)

    def after_steps(
        self, legs: Legs, before: Estimate, reading: Steps, following: Inertia | None
    ) -> tuple[Estimate, Outcome | None]:
        """The estimate after a reading of the joints; without an outcome if no foot stood before."""
        estimate = self.predicted(before, reading.stamp, following)
        touching = estimate.touching
        if touching is None:
            touching = legs.touching(
                reading.feet,
                estimate.state.feet,
                state=estimate.state,
                gyro=estimate.rate,
                velocities=reading.velocities,
                efforts=reading.efforts,
            )
        state, squares = updated_by_feet(estimate.state, reading.feet, touching, gate(3))
        estimate = estimate._replace(state=state)
        if not squares:
            return estimate, None
        fate = "accepted" if max(squares.values()) <= gate(3) else "rejected"
        return estimate, Outcome(fate, sum(squares.values()) / len(squares), 3)

    def settled(self, estimate: Estimate) -> Estimate:
        """The estimate with constant errors in its covariance, which ``drift`` then has no more.

        Wheels that are s too large move the position by s of its way. A gyro that is s too large turns the
        yaw by s of its turn, and one whose bias is b off by b of the time; in the right-invariant error each
        part of that turn adds to the position what the base was away from the world's origin then, and
        nothing later. White noise would average out instead.
        """
        state, drift, noise = estimate.state, estimate.drift, self.noise
        if not (drift.scale or self._has_drift):
            return estimate._replace(drift=Drift(state.position))
        shifts = np.zeros((3, len(state.covariance)))
        shifts[0, POSITION] = drift.scale * (state.position - drift.origin)
        shifts[1:, _YAW : _YAW + 1] = drift.turns[:, :1]
        shifts[1:, _LEVEL] = drift.turns[:, 1:]
        shifts[1] *= noise.gyro_scale
        shifts[2] *= noise.gyro_bias_shift
        covariance = state.covariance + shifts.T.dot(shifts)
        return estimate._replace(
            state=state._replace(covariance=covariance), drift=Drift(state.position, drift.scale)
        )

    def predicted(self, before: Estimate, stamp: int, following: Inertia | None) -> Estimate:
        """The estimate at ``stamp``; ``following`` is the first sample of the IMU from then on, if known."""
        if stamp <= before.stamp:
            return before
        last = before.stamp if before.imu is None else before.imu.stamp
        until = stamp if following is None else following.stamp
        if until - last > SILENCE_NS or (before.imu is None and following is None):
            return self._coasted(before, stamp)
        rate, force = _interpolated(before.imu, following, stamp)
        if before.is_coasting or before.imu is None:
            before = before._replace(rate=rate, force=force)
        gyro, accel = 0.5 * (before.rate + rate), 0.5 * (before.force + force)
        dt_s = (stamp - before.stamp) * 1e-9
        if self._has_drift:
            before = before._replace(drift=_drifted(before, gyro, dt_s))
        state = predict(before.state, gyro, accel, dt_s, self.noise, contact_noise=self._foot_slip)
        return before._replace(stamp=stamp, state=state, rate=rate, force=force, is_coasting=False)

    @property
    def _has_drift(self) -> bool:
        return self.noise.gyro_scale > 0.0 or self.noise.gyro_bias_shift > 0.0

    @property
    def _foot_slip(self) -> float:
        return 0.0 if self.legs is None else self.legs.noise.slip

    def _coasted(self, before: Estimate, stamp: int) -> Estimate:
        state = before.state
        angular, density = before.angular, COASTING_RATE_DENSITY
        is_known = before.wheels_at is not None and stamp - before.wheels_at <= _COASTING_WHEELS_NS
        if angular is None or not is_known:
            angular = before.rate - state.gyro_bias
            # The angle of an unknown constant rate has the variance (s t)^2, whose growth is 2 s^2 t.
            silent_s = 0.0 if before.imu is None else (stamp - before.imu.stamp) * 1e-9
            density = max(density, _UNKNOWN_RATE * math.sqrt(2.0 * silent_s))
        noise = replace(self.noise, gyro=density, accel=_COASTING_FORCE_DENSITY)
        left = (stamp - before.stamp) * 1e-9
        count = max(1, math.ceil(left / _LONGEST_STEP_S))
        rate = angular + state.gyro_bias
        force = before.force
        for _ in range(count):
            body_velocity = state.rotation.T @ state.velocity
            force = np.cross(angular, body_velocity) - state.rotation.T @ GRAVITY + state.accel_bias
            state = predict(state, rate, force, left / count, noise, contact_noise=self._foot_slip)
        return before._replace(
            stamp=stamp, state=state, rate=rate, force=force, is_coasting=True, rest=_new_rest(stamp)
        )

    def _at_end_of_rest(self, estimate: Estimate) -> tuple[Estimate, Outcome | None]:
        """The estimate with a zero velocity, if the base stood in this interval and in the one before."""
        stamp, state, rest = estimate.stamp, estimate.state, estimate.rest
        gyro, accel = rest.gyro / rest.size, rest.accel / rest.size
        wheels_at = estimate.wheels_at
        wheels_stand = (
            wheels_at is not None
            and stamp - wheels_at <= _WHEELS_VALID_NS
            and estimate.moved_at < rest.start - _REST_NS
        )
        sigma = max(_REST_RATE, self.noise.gyro / math.sqrt((stamp - rest.start) * 1e-9))
        bias_variance = float(np.diag(state.covariance)[GYRO_BIAS].max())
        is_still = (
            wheels_stand
            and float(np.abs(gyro - state.gyro_bias).max()) < 3.5 * math.sqrt(bias_variance + sigma * sigma)
            and abs(math.sqrt(accel @ accel) + GRAVITY[2]) < _REST_FORCE
        )
        estimate = estimate._replace(rest=_new_rest(stamp, was_still=is_still))
        if not (is_still and rest.was_still):
            return estimate, None
        return _gated(estimate, STANDSTILL, zero_velocity(state, gyro, _REST_SPEED, sigma))


def is_still(linear: Floats, sigma: float, angular: Floats | None) -> bool:
    """Whether a velocity, (3,) [m/s] with the standard deviation ``sigma``, is that of a base at rest."""
    if angular is not None and float(angular @ angular) > _STILL_RATE**2:
        return False
    return float(linear @ linear) <= max(_STILL_SPEED, sigma) ** 2


def _drifted(before: Estimate, gyro: Floats, dt_s: float) -> Drift:
    """The drift after a turn with the mean rate ``gyro``. At rest the bias is that which was measured."""
    state, drift = before.state, before.drift
    turn = float(state.rotation[2].dot(gyro - state.gyro_bias)) * dt_s
    moved_s = 0.0 if before.rest.was_still else dt_s
    x, y, _ = state.position.tolist()
    turns = np.array((turn, y * turn, -x * turn, moved_s, y * moved_s, -x * moved_s))
    return Drift(drift.origin, drift.scale, drift.turns + turns.reshape(2, 3))


def _new_rest(stamp: int, *, was_still: bool = False) -> Rest:
    return Rest(stamp, 0, np.zeros(3), np.zeros(3), was_still)


def _interpolated(last: Inertia | None, following: Inertia | None, stamp: int) -> tuple[Floats, Floats]:
    """Rate and force at ``stamp`` between two samples of the IMU; those of the only one."""
    one = last if following is None else following
    assert one is not None  # else the base coasts
    if last is None or following is None or stamp == one.stamp:
        return one.gyro, one.accel
    part = (stamp - last.stamp) / (following.stamp - last.stamp)
    return (
        last.gyro + part * (following.gyro - last.gyro),
        last.accel + part * (following.accel - last.accel),
    )


def _gated(estimate: Estimate, source: str, measurement: Measurement) -> tuple[Estimate, Outcome]:
    state, dimension = estimate.state, len(measurement.residual)
    found = innovation(state, measurement)
    nis = found.nis
    if nis <= gate(dimension):
        if source in estimate.runs:
            estimate = _with_run(estimate, source, None)
        state = corrected(state, measurement, found)
        return estimate._replace(state=state), Outcome("accepted", nis, dimension)
    run = _continued(estimate, source, measurement)
    if run.length < _REACQUIRE_COUNT or estimate.stamp - run.start < _REACQUIRE_NS:
        return _with_run(estimate, source, run), Outcome("rejected", nis, dimension)
    state = updated(_inflated(state, measurement), measurement)
    return _with_run(estimate._replace(state=state), source, None), Outcome("reacquired", nis, dimension)


def _continued(estimate: Estimate, source: str, measurement: Measurement) -> Run:
    """The run of rejections with this one; a new one if its residual does not agree with the last one."""
    residual = measurement.residual
    run = estimate.runs.get(source)
    if run is None:
        return Run(estimate.stamp, 1, residual)
    change = residual - run.residual
    # Two readings that agree differ by the noise of both.
    is_same = float(change @ np.linalg.solve(2.0 * measurement.covariance, change)) <= gate(len(residual))
    return Run(run.start, run.length + 1, residual) if is_same else Run(estimate.stamp, 1, residual)


def _inflated(state: FilterState, measurement: Measurement) -> FilterState:
    """The state with the variance of an error that explains the residual, the smallest such error."""
    error = np.linalg.pinv(measurement.jacobian) @ measurement.residual
    return state._replace(covariance=state.covariance + np.outer(error, error))


def _with_run(estimate: Estimate, source: str, run: Run | None) -> Estimate:
    others = {name: other for name, other in estimate.runs.items() if name != source}
    return estimate._replace(runs=others if run is None else {**others, source: run})


def _with_compass(estimate: Estimate, source: str, compass: Compass) -> Estimate:
    return estimate._replace(compasses={**estimate.compasses, source: compass})
