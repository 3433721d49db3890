"""Fusion of readings: from the estimate after one event to that after the next, as a function of both alone.

``Estimate`` has all that decides on the next event, so that events can be replayed from any estimate that was
kept.

- Between events the IMU is interpolated, and predicts. Its white noise is the stated one or, if larger, that
  of its samples against their neighbours: a robot that drives vibrates, which no data sheet states. A sample
  that jumps like a shock is not integrated, and may be wrong by its jump.
- Without samples for more than 0.1 s, the base keeps its velocity in its own axes, and turns at the rate of
  the wheels, with large noise. If the wheels are silent, too, it turns at the last rate, give or take a
  constant 0.5 rad/s. The displacement of the wheels over such a pause replaces all of that.
- A reading whose NIS exceeds the gate of its source, by default 99.9 %, is rejected. After two seconds of
  rejections in a row, the estimate follows: it forgets its velocity, or place, and keeps biases and tilt.
- If wheels, or all feet, and the gyro agree for 0.1 s that the base stands, its velocity is zero, and the
  gyro measures its own bias. The yaw rate of wheels shows a bias that was never measured so (``turning.py``).
- A heading is relative to the first one of its source: the odometry frame has no north. The error of a
  compass turns with the robot and its place and does not average out. So the variance of the yaw is never
  lowered below that of the source, which is the stated one or, if larger, the mean square that its
  innovations have shown for 20 s. A compass that is wrong by tens of degrees loses its weight; one that is
  right still bounds the drift. It may be off by 0.5 rad until it has been read in all directions.
- A height by a barometer is relative to the first one of its source as well, and its error wanders with the
  weather. The height is never known better than by what the barometer may have wandered since its first
  reading, and moves alone: velocity, tilt and biases learn nothing from it. A barometer that is rejected for
  two seconds, as in a gust, begins again.
- The displacements between the poses of another odometry are used, with a constant scale, which velocities
  and positions of other sources show. A jump is rejected, and the way goes on from there.
- A magnetic field is a heading, that of the axis along the field. Iron and motors change its strength or its
  dip as well: a field that differs from the one at the start, or from the Earth's, is rejected.
- The pose of the odometry frame is continuous (REP 105): it is the integral of the predictions. What a
  reading corrects of the place or the yaw remains an ``Offset``, whose square is part of the covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from zstate import se3
from zstate.checks import Floats
from zstate.odometry.health import GATE_PROBABILITY, Outcome, gate
from zstate.odometry.invariant_filter import (
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    FilterState,
    ImuNoise,
    Innovation,
    Measurement,
    carried,
    corrected,
    forgotten,
    height_rows,
    initial_state,
    innovation,
    plain_covariance,
    predict,
    tracked_pose,
    updated,
    white_noise,
    with_plain_covariance,
    with_tracked,
    without_tracked,
)
from zstate.odometry.legs import Foot, Legs, Stance, stance_after, updated_by_feet
from zstate.odometry.magnetism import EarthField, UsualField, usual_after
from zstate.odometry.measurements import heading, height, tracking, yaw_rate, zero_velocity
from zstate.odometry.relative import RelativePose, moved_between, way_of
from zstate.odometry.rotations import rotation_exp, skew
from zstate.odometry.turning import (
    COMPARED_S,
    Difference,
    Turning,
    constant_difference,
    disagreement,
    turned,
)

SILENCE_NS = 100_000_000
"""Without samples of the IMU for longer, the base coasts."""

STANDSTILL = "standstill"
"""The name of zero-velocity updates as a source."""

_REACQUIRE_NS, _REACQUIRE_COUNT = 2_000_000_000, 10
_PLACED_STEPS = 4
"""From a yaw that is wrong by 3 rad to a millimetre."""
LOST_NS = 1_000_000_000
"""A source is rejected for so long: the estimate is called lost."""
_REMEMBERED_NS = 30_000_000_000
"""An event is told of for so long."""
_LONGEST_STEP_S = 0.1
_REST_NS = 100_000_000
_WHEELS_VALID_NS = 300_000_000
_REST_SPEED = 0.02
"""[m/s] The velocity of a base at rest is zero up to this standard deviation: it may rock."""
_REST_RATE = 1e-3  # rad/s
_STILL_SPEED, _STILL_RATE = 0.005, 0.02
"""[m/s], [rad/s]: wheels at rest measure no more. Stated sigmas are no bound: drivers state generous ones."""
_REST_FORCE = 0.5
"""[m/s^2] The specific force of a base at rest differs from gravity by less; a bias is part of it."""

_VIBRATION_S = 1.0
"""The noise of the samples of the IMU is averaged for so long."""
_NOISIER = 1.5
"""Variances that are larger than stated by less are those of the mean of few samples."""
_SHOCK = (10.0, 10.0, 10.0, 50.0, 50.0, 50.0)
"""[rad/s], [m/s^2]: no sample of an IMU differs from the one before by more, but in a shock or by a fault."""

_APART = 3.0
"""The gyro and wheels that are so many standard deviations apart contradict each other."""
_UNKNOWN_BIAS = 0.008
"""[rad/s] A bias with a larger standard deviation was never measured."""
_USUAL_BIAS = 0.002
"""[rad/s] The standard deviation of the biases of gyros that are calibrated."""
_TELLING = 0.5
"""Wheels correct a bias that is not contradicted if their standard deviation is this part of its own."""
_FROZEN, _FROZEN_RATE = 10, 0.03
"""So many samples that repeat the one before, while wheels turn otherwise [rad/s], are of a frozen IMU. Those
of a simulation without noise repeat as well, but turn as the wheels do."""

_LEAST_SPEED_BOUND = 2.0
"""[m/s] The velocity of a base that nothing measures is so unsure, or twice the fastest that was measured."""
_TILT_BOUND, _YAW_BOUND = 0.3, math.pi
"""[rad] Standard deviations after a pause: a base does not fall over."""
_PAUSE_NS = 500_000_000
_PAUSE_SLIP, _PAUSE_PLACE, _PAUSE_YAW, _PAUSE_TILT = 0.3, 0.02, 0.02, 0.02
"""Standard deviations of a displacement by wheels over a pause: a part of it, [m], [rad] and [rad]."""

_TILT_RATE = 0.05
"""[rad/s] The tilt of the continuous pose follows that of the estimate so fast."""
_PLACE_RATE, _YAW_RATE = 0.2, 0.05
"""[m/s], [rad/s] It follows measured poses so fast."""

MOST_BIAS = 0.03
"""[rad/s] A gyro that measures more while wheels stand is turned: it may be carried, or on a turntable."""
_TILTED, _SECTORS_TILTED, _TILT_SHARE = math.radians(4.0), 8, 0.01
"""[rad] A base that is tilted by more in so many directions is not; the mean of many readings is taken."""

_DEVIATION_S = 20.0
_UNPROVEN, _SECTORS = 0.5, 12
"""[rad] The standard deviation of a compass at first, and in how many directions it is proven."""
_PROVEN = 0.1
"""[rad] One that may be off by less, from ten directions on, measures the gyro's bias and turns the pose."""
_SCALE_SIGMAS, _SCALE = 3.0, 0.03
"""A scale of another odometry that differs from 1 by more, in standard deviations and by part, is named."""
_SAMPLED_S, _SAMPLED_GAIN, _SLOWEST_NS = 0.01, 0.05, 350_000_000
"""The time between samples of the IMU before it is known, and how fast its mean follows."""

_YAW = ROTATION.start + 2
POSE_ROTATION, POSE_YAW = 3, 5
"""The places of the rotation, and of that about z, in the covariance of a pose."""
_LEVEL = slice(POSITION.start, POSITION.start + 2)
_UP = POSITION.start + 2

COASTING_RATE_DENSITY, _COASTING_FORCE_DENSITY = 0.1, 1.0
"""Noise densities of the rate by wheels [rad/s/sqrt(Hz)] and of unknown accelerations [m/s^2/sqrt(Hz)]."""
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
    known, and ``upright`` the z axis of the frame there. ``is_position``: it measures the position in the
    world, or other numbers of a pose: ``rows`` are their places in its covariance. ``scale`` is the standard
    deviation of a constant relative error of a velocity, ``speed`` its length [m/s]. ``gate`` is the
    probability that a reading passes.
    """

    stamp: int
    measure: Callable[[FilterState, Floats], Measurement]
    is_still: bool | None = None
    angular: Floats | None = None
    is_position: bool = False
    scale: float = 0.0
    upright: Floats | None = None
    speed: float = 0.0
    gate: float = GATE_PROBABILITY
    rows: Sequence[int] = range(6)


class Displacement(NamedTuple):
    """The way of a base by its wheels since the stamp ``since``, over a pause of other data.

    ``way`` (3,) [m] is in the axes of the frame at the beginning, and ``turn`` [rad] about its z axis.
    """

    stamp: int
    since: int
    way: Floats
    turn: float
    imu_from_frame: Floats


class Heading(NamedTuple):
    """The yaw of an axis in the axes of a compass [rad], with its variance [rad^2].

    ``axis`` (3,) has the length 1 and is in the axes of the IMU.
    """

    stamp: int
    yaw: float
    variance: float
    axis: Floats
    gate: float = GATE_PROBABILITY


class Field(NamedTuple):
    """A magnetic field in the axes of the IMU [T], (3,), with the variance of the yaw that it shows [rad^2].

    ``ahead`` (3,) is the x axis of the base there, and ``expected`` the field of the Earth, if known.
    """

    stamp: int
    field: Floats
    variance: float
    ahead: Floats
    expected: EarthField | None
    gate: float = GATE_PROBABILITY


class Height(NamedTuple):
    """The height of a frame above an unknown level [m], with its variance [m^2].

    ``wander`` is the variance of an error besides that changes over ``correlated_s`` [s].
    """

    stamp: int
    height: float
    variance: float
    wander: float
    correlated_s: float
    imu_from_frame: Floats
    gate: float = GATE_PROBABILITY


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
    """Rejections of a source in a row: from ``start`` to ``stamp``, ``length`` in number."""

    start: int
    stamp: int
    length: int


class Compass(NamedTuple):
    """What is known of a source of headings.

    ``start`` is the stamp of its first reading, ``offset`` its yaw minus ours then, and ``offset_variance``
    that of our yaw then. ``deviation`` is the variance by which its errors exceed the stated one, and
    ``excess`` their present mean. ``sectors`` has for each direction the stamp of its last
    reading there and what it differed from the yaw by the gyro then [rad].
    """

    start: int
    stamp: int
    offset: float
    offset_variance: float
    excess: float
    deviation: float
    sectors: dict[int, tuple[int, float]]


class Altimeter(NamedTuple):
    """The stamp of the first reading of a source of heights, and how much it was above the estimate then.

    ``variance`` is that of this difference: of the reading, and of our height.
    """

    start: int
    offset: float
    variance: float


class Vibration(NamedTuple):
    """The noise of the samples of the IMU: ``variance`` of gyro and accelerometer in each axis, (6,).

    ``values`` are the last sample as it was received, (6,), and ``change`` its difference to the one before.
    ``averaged`` are those in the mean, ``repeated`` those in a row that repeat the last one. ``white`` is the
    squared density of the noise to predict with, (6,).
    """

    values: Floats
    change: Floats | None
    variance: Floats
    averaged: int
    white: Floats
    repeated: int = 0


class Lead(NamedTuple):
    """The last pose of another odometry, and how many of its displacements the sigmas were stated for."""

    last: RelativePose
    stated: int = 0
    shown: int = 0


class Offset(NamedTuple):
    """From the estimate to the continuous pose of the IMU: ``rotation @ place + shift``. ``rotation`` (3, 3).

    It was last changed at ``stamp``. ``is_followed``: it fades, as poses are measured in the odometry frame;
    ``is_turned``: its yaw fades, as a compass is right, or another odometry measures turns; ``is_lifted``:
    its height fades, by a barometer.
    """

    rotation: Floats
    shift: Floats
    stamp: int
    is_followed: bool = False
    is_turned: bool = False
    is_lifted: bool = False


class Pause(NamedTuple):
    """Data of all sources paused until ``stamp`` for ``seconds``. ``is_bridged``: wheels measured the way."""

    stamp: int
    seconds: float
    is_bridged: bool


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
    IMU's axes [rad/s], ``wheels_at`` their stamp, ``swept`` the integral of the gyro since then [rad], (3,).
    ``touching`` are the feet on the ground, if measured. ``fields`` are what magnetometers usually measure.
    ``sampled_s`` is the mean time between samples of the IMU, over which the noise of a rate is averaged.
    ``tilts`` has for each direction the vertical less that of the base, in the IMU's axes, (3,). ``fastest``
    is the greatest speed that was measured [m/s]. ``anchor`` is the estimate at the last reading before
    wheels and IMU fell silent. ``lost_at`` is when the estimate last followed a source that it had rejected,
    and ``biased_at`` when the wheels last contradicted the bias of the gyro. ``turn_at_rest`` is the rate of
    the gyro while wheels stand, if too large for a bias [rad/s]; ``was_at_rest``: the bias was measured then.
    """

    stamp: int
    state: FilterState
    rate: Floats
    force: Floats
    imu: Inertia | None
    rest: Rest
    drift: Drift
    offset: Offset
    is_coasting: bool = False
    sampled_s: float = _SAMPLED_S
    wheels_at: int | None = None
    swept: Floats = np.zeros(3)
    moved_at: int = 0
    angular: Floats | None = None
    upright: Floats | None = None
    touching: frozenset[str] | None = None
    stance: Stance | None = None
    vibration: Vibration | None = None
    turning: Turning = Turning()
    turn_at_rest: float = 0.0
    was_at_rest: bool = False
    is_frozen: bool = False
    biased_at: int | None = None
    fastest: float = 0.0
    tilts: dict[int, Floats] = {}  # noqa: RUF012 - replaced, never written to
    anchor: Estimate | None = None
    pause: Pause | None = None
    lost_at: int | None = None
    runs: dict[str, Run] = {}  # noqa: RUF012 - replaced, never written to
    compasses: dict[str, Compass] = {}  # noqa: RUF012 - replaced, never written to
    altimeters: dict[str, Altimeter] = {}  # noqa: RUF012 - replaced, never written to
    leads: dict[str, Lead] = {}  # noqa: RUF012 - replaced, never written to
    fields: dict[str, UsualField] = {}  # noqa: RUF012 - replaced, never written to


def started(stamp: int, state: FilterState) -> Estimate:
    """The first estimate, before any event."""
    rate, force = state.gyro_bias, state.rotation.T @ -GRAVITY + state.accel_bias
    offset = Offset(np.eye(3), np.zeros(3), stamp)
    return Estimate(stamp, state, rate, force, None, _new_rest(stamp), Drift(state.position), offset)


@dataclass(frozen=True, slots=True)
class Fusion:
    """The functions from one estimate to the next, for an IMU with ``noise``, and ``legs`` if any."""

    noise: ImuNoise
    legs: Legs | None = None

    def after_inertia(self, before: Estimate, sample: Inertia) -> tuple[Estimate, Outcome | None]:
        """The estimate at a sample of the IMU; with an outcome if the base was found to stand."""
        estimate = self.predicted(before, sample.stamp, sample)
        vibration = self._vibration(before, sample)
        is_frozen = _is_frozen(estimate._replace(vibration=vibration))
        if is_frozen:
            return estimate._replace(vibration=vibration, is_frozen=True), None
        sample = _without_shock(before, sample)
        start, size, gyro, accel, was_still = estimate.rest
        rest = Rest(start, size + 1, gyro + sample.gyro, accel + sample.accel, was_still)
        sampled_s = estimate.sampled_s
        if before.imu is not None and sample.stamp - before.imu.stamp < _SLOWEST_NS:
            sampled_s += _SAMPLED_GAIN * ((sample.stamp - before.imu.stamp) * 1e-9 - sampled_s)
        estimate = estimate._replace(
            imu=sample,
            rate=sample.gyro,
            force=sample.accel,
            is_coasting=False,
            is_frozen=False,
            rest=rest,
            sampled_s=sampled_s,
            vibration=vibration,
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
            estimate = self._with_turn(estimate, reading)._replace(
                wheels_at=reading.stamp,
                swept=np.zeros(3),
                moved_at=estimate.moved_at if reading.is_still else reading.stamp,
                angular=reading.angular,
                upright=reading.upright,
                tilts=_with_tilt(estimate, reading),
                fastest=max(estimate.fastest, reading.speed),
            )
        if reading.scale > estimate.drift.scale:
            estimate = estimate._replace(drift=estimate.drift._replace(scale=reading.scale))
        if reading.is_position:
            estimate = self.settled(estimate)
            follows = {"is_followed" if min(reading.rows) < POSE_ROTATION else "is_turned": True}
            estimate = estimate._replace(offset=estimate.offset._replace(**follows))
        measurement = reading.measure(estimate.state, estimate.rate)
        residual = measurement.residual

        def lost(state: FilterState, seconds: float) -> FilterState:
            if reading.is_position:
                return _without_place(state, residual, reading.rows)
            return _without_velocity(state, residual, seconds)

        kept = None if reading.upright is None else partial(_without_yaw_bias, axis=reading.upright)
        after, outcome = _gated(estimate, source, measurement, lost, kept=kept, probability=reading.gate)
        if outcome.fate == "reacquired" and reading.is_position:
            after = _placed_by(after, reading, residual)
        return after, outcome

    def after_pause(
        self, before: Estimate, reading: Displacement, following: Inertia | None
    ) -> tuple[Estimate, Outcome | None]:
        """The estimate after a displacement by wheels; without an outcome if other data have not paused."""
        estimate = self.predicted(before, reading.stamp, following)
        anchor, pause, seconds = estimate.anchor, estimate.pause, (reading.stamp - reading.since) * 1e-9
        if anchor is None or pause is None or abs(anchor.stamp - reading.since) > _PAUSE_NS:
            return estimate, None
        if reading.stamp - pause.stamp > _PAUSE_NS or pause.seconds < seconds - 2e-9 * _PAUSE_NS:
            return estimate, None
        state, frame = anchor.state, reading.imu_from_frame
        turned = frame[:3, :3] @ rotation_exp(np.array((0.0, 0.0, reading.turn))) @ frame[:3, :3].T
        way = state.rotation @ (frame[:3, 3] + frame[:3, :3] @ reading.way - turned @ frame[:3, 3])
        length = math.sqrt(reading.way @ reading.way)
        # The yaw before the pause, and what it is unsure by, turns the way.
        carry = np.eye(15)
        carry[POSITION, ROTATION] = -skew(way)
        covariance = carry @ plain_covariance(state)[:15, :15] @ carry.T
        forgotten(covariance, VELOCITY, (_REST_SPEED + 2.0 * length / seconds) ** 2)
        added = np.zeros(15)
        added[ROTATION] = _PAUSE_TILT**2, _PAUSE_TILT**2, (_PAUSE_YAW + _PAUSE_SLIP * abs(reading.turn)) ** 2
        added[POSITION] = (_PAUSE_PLACE + _PAUSE_SLIP * length) ** 2
        state = initial_state(
            rotation=state.rotation @ turned,
            velocity=np.zeros(3),
            position=state.position + way,
            gyro_bias=state.gyro_bias,
            accel_bias=state.accel_bias,
            covariance=covariance + np.diag(added),
        )
        # Not a correction: the way was driven, so that the continuous pose has it as well.
        estimate = estimate._replace(
            state=state, offset=anchor.offset, pause=Pause(reading.stamp, seconds, is_bridged=True)
        )
        return estimate, Outcome("accepted", math.nan, 0)

    def after_field(
        self, before: Estimate, source: str, reading: Field, following: Inertia | None
    ) -> tuple[Estimate, Outcome]:
        """The estimate after a magnetic field, and what became of it: its axis has the yaw of north, zero.

        Raises InvalidInput if it is not the field that is usual, or expected.
        """
        estimate = self.predicted(before, reading.stamp, following)
        rotation, strength = estimate.state.rotation, math.sqrt(reading.field @ reading.field)
        axis = reading.field / strength
        x, y, z = rotation.dot(axis).tolist()
        dip = math.atan2(-z, math.hypot(x, y))
        usual = usual_after(estimate.fields.get(source), strength, dip, reading.expected)
        compasses = estimate.compasses
        if usual.readings == 1:
            compasses = {name: one for name, one in compasses.items() if name != source}
        estimate = estimate._replace(fields={**estimate.fields, source: usual}, compasses=compasses)
        ahead = rotation.dot(reading.ahead)
        direction = math.atan2(ahead[1], ahead[0]) - math.atan2(y, x)
        north = Heading(reading.stamp, 0.0, reading.variance, axis)
        return self.after_heading(estimate, source, north, following, direction=direction)

    def after_heading(
        self,
        before: Estimate,
        source: str,
        reading: Heading,
        following: Inertia | None,
        *,
        direction: float | None = None,
    ) -> tuple[Estimate, Outcome]:
        """The estimate after a heading, and what became of it.

        ``direction`` is that of the base by this compass [rad], by default the yaw itself.
        """
        sector = _sector(reading.yaw if direction is None else direction)
        estimate = self.predicted(before, reading.stamp, following)
        compass = estimate.compasses.get(source)
        offset = 0.0 if compass is None else compass.offset
        measurement = heading(estimate.state, reading.yaw - offset, reading.variance, reading.axis)
        residual = float(measurement.residual[0])
        row = measurement.jacobian[0]
        settled = self.settled(estimate)
        variance = float(row @ settled.state.covariance @ row)
        # The yaw of the continuous pose is that of the gyro alone, which this source has not pulled.
        turned = estimate.offset.rotation
        against_gyro = residual - math.atan2(float(turned[1, 0]), float(turned[0, 0]))
        if compass is None:
            sectors = {sector: (reading.stamp, against_gyro - residual)}  # less the offset
            first = Compass(reading.stamp, reading.stamp, residual, variance, 0.0, 0.0, sectors)
            return _with_compass(estimate, source, first), Outcome("accepted", 1.0, 1)
        # The first reading has an error as well, and that of our yaw then is part of the present one.
        expected = variance + 2.0 * reading.variance
        share = 1.0 - math.exp(-(reading.stamp - compass.stamp) * 1e-9 / _DEVIATION_S)
        excess = compass.excess + share * (residual * residual - expected - compass.excess)
        sectors = {**compass.sectors, sector: (reading.stamp, against_gyro)}
        bias_variance = float(np.diag(estimate.state.covariance)[GYRO_BIAS].max())
        spread = _spread(sectors, reading.stamp, against_gyro, bias_variance) - 2.0 * reading.variance
        deviation = max(compass.deviation, excess, spread)
        compass = compass._replace(stamp=reading.stamp, excess=excess, deviation=deviation, sectors=sectors)
        estimate = _with_compass(estimate, source, compass)
        deviation = max(deviation, (_UNPROVEN * (1.0 - len(sectors) / _SECTORS)) ** 2)
        nis = residual * residual / expected
        if residual * residual > gate(1, reading.gate) * (expected + deviation):
            return estimate, Outcome("rejected", nis, 1)
        floor = reading.variance + deviation + compass.offset_variance
        if variance > floor:
            # Such a noise lowers the variance to the floor: 1 / variance + 1 / noise = 1 / floor.
            noise = np.array([[variance * floor / (variance - floor)]])
            measurement = measurement._replace(covariance=noise)
            found = innovation(estimate.state, measurement)
            if deviation < _PROVEN * _PROVEN:
                estimate = estimate._replace(offset=estimate.offset._replace(is_turned=True))
            else:
                found = _without_yaw_bias(found, estimate.state.rotation[2])
            estimate = _moved(estimate, corrected(estimate.state, measurement, found))
        return estimate, Outcome("accepted", nis, 1)

    def after_height(
        self, before: Estimate, source: str, reading: Height, following: Inertia | None
    ) -> tuple[Estimate, Outcome]:
        """The estimate after a height, and what became of it."""
        estimate = self.predicted(before, reading.stamp, following)
        known = estimate.altimeters.get(source)
        offset = 0.0 if known is None else known.offset
        measurement = height(
            estimate.state, reading.height - offset, reading.variance, reading.imu_from_frame
        )
        residual, row = float(measurement.residual[0]), measurement.jacobian[0]
        variance = float(row @ self.settled(estimate).state.covariance @ row)
        if known is None:
            first = Altimeter(reading.stamp, residual, variance + reading.variance)
            return _with_altimeter(estimate, source, first), Outcome("accepted", 1.0, 1)
        elapsed_s = (reading.stamp - known.start) * 1e-9
        wandered = 2.0 * reading.wander * -math.expm1(-elapsed_s / reading.correlated_s)
        floor = known.variance + reading.variance + wandered
        nis = residual * residual / (variance + floor)
        if nis > gate(1, reading.gate):
            estimate, is_enough = _with_rejection(estimate, source)
            if not is_enough:
                return estimate, Outcome("rejected", nis, 1)
            first = Altimeter(reading.stamp, offset + residual, variance + reading.variance)
            return _with_altimeter(estimate, source, first), Outcome("reacquired", nis, 1)
        estimate = _with_run(estimate, source, None) if source in estimate.runs else estimate
        if variance > floor:
            # The error of the height becomes (1 - gain) of its own and gain of the barometer's, which it has
            # a part of already: whatever their correlation, standard deviations add to no more than this.
            gain = 1.0 - floor / variance
            noise = floor + 2.0 * (1.0 - gain) / gain * math.sqrt(variance * floor)
            state = _raised(estimate.state, residual, noise, gain, reading.imu_from_frame)
            estimate = estimate._replace(offset=estimate.offset._replace(is_lifted=True))
            estimate = _moved(estimate, state)
        return estimate, Outcome("accepted", nis, 1)

    def after_relative(
        self, before: Estimate, source: str, reading: RelativePose, following: Inertia | None
    ) -> tuple[Estimate, Outcome]:
        """The estimate after a pose of another odometry, by the displacement from the last one."""
        estimate = self.predicted(before, reading.stamp, following)
        lead = estimate.leads.get(source)
        found = tracked_pose(estimate.state, source)  # none as after a pause of all data
        is_first = lead is None or lead.last.world != reading.world or lead.last.stamp == reading.stamp
        if lead is None or found is None or is_first:
            return _led(estimate, source, Lead(reading)), Outcome("accepted", math.nan, 0)
        estimate = estimate._replace(offset=estimate.offset._replace(is_turned=True))
        move, elapsed_s = moved_between(lead.last, reading), (reading.stamp - lead.last.stamp) * 1e-9
        mount = reading.imu_from_frame
        state = carried(estimate.state, source, move.moved, move.walk, mount, dt_s=elapsed_s)
        wheels_at = estimate.wheels_at
        is_driven = wheels_at is not None and reading.stamp - wheels_at <= _WHEELS_VALID_NS
        is_confirmed = is_driven and not estimate.runs.keys() - {source}
        measurement = tracking(state, source, move.spread, mount)
        # The second half of the residual is of the frame: the shift of the world's origin.
        tracked = next(one for one in state.tracked if one.source == source)
        there, lever = tracked.position, (tracked.rotation - state.rotation).dot(mount[:3, 3])
        apart, angle = there - state.position + lever, math.hypot(*measurement.residual[:3].tolist())

        def lost(state: FilterState, seconds: float) -> FilterState:
            state = _without_velocity(state, apart / elapsed_s, seconds)
            # Its turn is not followed, as gyros are right: that is an error about where it has the base.
            turned, rows = np.vstack((np.eye(3), skew(there))) * angle, slice(found[0], found[0] + 6)
            covariance = state.covariance.copy()
            covariance[rows, rows] += turned @ turned.T
            return state._replace(covariance=covariance)

        after, outcome = _gated(
            estimate._replace(state=state),
            source,
            measurement,
            None if is_confirmed else lost,
            kept=None if is_driven else partial(_without_scale, row=found[0] + 6),
            is_step=True,
            probability=reading.noise.gate,
        )
        if outcome.fate == "rejected":
            way = math.hypot(*apart.tolist())
            failure = (
                f"it moved by {round(way_of(move.moved), 4):.2g} m in {elapsed_s:.2g} s, {way:.2g} m and "
                f"{math.degrees(angle):.2g} degrees away from the motion by the other sources"
            )
            outcome = outcome._replace(failure=failure)
        counted = Lead(reading, lead.stated + move.is_stated, lead.shown + (not move.is_stated))
        if outcome.fate == "accepted":
            return after._replace(leads={**after.leads, source: counted}), outcome
        return _led(after, source, counted), outcome

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
        stance = stance_after(
            estimate.stance, reading.stamp, reading.feet, is_whole=touching == frozenset(legs.names)
        )
        is_standing = stance is not None and stance.is_still
        moved_at = estimate.moved_at if is_standing else reading.stamp
        estimate = estimate._replace(
            stance=stance, wheels_at=reading.stamp, swept=np.zeros(3), moved_at=moved_at
        )
        state, squares = updated_by_feet(estimate.state, reading.feet, touching, gate(3))
        estimate = _moved(estimate, state, is_step=True)
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
        if until - last > max(SILENCE_NS, 3e9 * before.sampled_s) or (
            before.imu is None and following is None
        ):
            return self._coasted(before, stamp)
        white = white_noise(self.noise) if before.vibration is None else before.vibration.white
        if following is not None and before.vibration is not None:
            shock = _shock(before.vibration, following)
            if shock is not None:
                following = _without_shock(before, following)
                white = white + shock * ((following.stamp - last) * 1e-9)
        rate, force = _interpolated(before.imu, following, stamp)
        if before.is_coasting or before.imu is None:
            before = before._replace(rate=rate, force=force)
        gyro, accel = 0.5 * (before.rate + rate), 0.5 * (before.force + force)
        dt_s = (stamp - before.stamp) * 1e-9
        drift = _drifted(before, gyro, dt_s) if self._has_drift else before.drift
        state = predict(
            before.state, gyro, accel, dt_s, self.noise, contact_noise=self._foot_slip, white=white
        )
        swept = before.swept + gyro * dt_s
        return before._replace(
            stamp=stamp, state=state, rate=rate, force=force, swept=swept, is_coasting=False, drift=drift
        )

    @property
    def _has_drift(self) -> bool:
        return self.noise.gyro_scale > 0.0 or self.noise.gyro_bias_shift > 0.0

    @property
    def _foot_slip(self) -> float:
        return 0.0 if self.legs is None else self.legs.noise.slip

    def _coasted(self, before: Estimate, stamp: int) -> Estimate:
        if not before.is_coasting:
            before = before._replace(anchor=before._replace(anchor=None))
        state = before.state
        angular, density = before.angular, COASTING_RATE_DENSITY
        end = min(stamp, before.stamp + _PAUSE_NS)
        is_known = before.wheels_at is not None and end - before.wheels_at <= _COASTING_WHEELS_NS
        if angular is None or not is_known:
            angular = before.rate - state.gyro_bias
            # The angle of an unknown constant rate has the variance (s t)^2, whose growth is 2 s^2 t.
            silent_s = 0.0 if before.imu is None else (end - before.imu.stamp) * 1e-9
            density = max(density, _UNKNOWN_RATE * math.sqrt(2.0 * silent_s))
        white = np.repeat((density, _COASTING_FORCE_DENSITY), 3) ** 2
        left = (end - before.stamp) * 1e-9
        count = max(1, math.ceil(left / _LONGEST_STEP_S))
        rate = angular + state.gyro_bias
        force = before.force
        for _ in range(count):
            body_velocity = state.rotation.T @ state.velocity
            force = np.cross(angular, body_velocity) - state.rotation.T @ GRAVITY + state.accel_bias
            state = predict(
                state, rate, force, left / count, self.noise, contact_noise=self._foot_slip, white=white
            )
        state = _bounded(state, _speed_bound(before))
        estimate = before._replace(
            stamp=end,
            state=state,
            rate=rate,
            force=force,
            swept=before.swept + rate * left,
            is_coasting=True,
            vibration=before.vibration if before.is_frozen else None,
            rest=_new_rest(stamp),
        )
        return estimate if end == stamp else self._paused(estimate, stamp)

    def _paused(self, estimate: Estimate, stamp: int) -> Estimate:
        """The estimate after a pause of all data: the base stays, and may have driven anywhere."""
        state, speed = estimate.state, _speed_bound(estimate)
        seconds = (stamp - estimate.stamp) * 1e-9
        covariance = plain_covariance(state)[:15, :15]
        forgotten(covariance, VELOCITY, speed * speed)
        added = np.zeros(15)
        added[_YAW] = min(_UNKNOWN_RATE * seconds, _YAW_BOUND) ** 2
        added[POSITION] = (speed * seconds) ** 2
        added[GYRO_BIAS] = self.noise.gyro_bias**2 * seconds
        state = initial_state(
            rotation=state.rotation,
            velocity=np.zeros(3),
            position=state.position,
            gyro_bias=state.gyro_bias,
            accel_bias=state.accel_bias,
            covariance=covariance + np.diag(added),
        )
        anchor = estimate.anchor
        assert anchor is not None  # it coasts
        return estimate._replace(
            stamp=stamp,
            state=_bounded(state, speed),
            rate=state.gyro_bias,
            pause=Pause(stamp, (stamp - anchor.stamp) * 1e-9, is_bridged=False),
        )

    def _vibration(self, before: Estimate, sample: Inertia) -> Vibration:
        """The noise of the IMU with one more sample: three of them are in line but for their noise.

        The second difference of white noise with the variance s has the variance 6 s.
        """
        values = np.concatenate((sample.gyro, sample.accel))
        last = before.vibration
        if last is None or before.imu is None or sample.stamp <= before.imu.stamp:
            return Vibration(values, None, np.zeros(6), 0, white_noise(self.noise))
        change, variance, count = values - last.values, last.variance, last.averaged
        if last.change is not None and not _jumps(change):
            count += 1
            share = max((sample.stamp - before.imu.stamp) * 1e-9 / _VIBRATION_S, 1.0 / count)
            bend = change - last.change
            variance = variance + min(share, 1.0) * (bend * bend / 6.0 - variance)
        stated, seen = white_noise(self.noise), variance * before.sampled_s
        white = np.where(seen > _NOISIER * stated, seen, stated)
        repeated = 0 if change.any() else last.repeated + 1
        return Vibration(values, change, variance, count, white, repeated)

    def _with_turn(self, estimate: Estimate, reading: Reading) -> Estimate:
        """The estimate after the yaw rate of wheels, which is compared with that of the gyro.

        Both are means since the previous reading. Single samples of a vibrating gyro vary too much.
        """
        axis, angular, wheels_at = reading.upright, reading.angular, estimate.wheels_at
        vibration = estimate.vibration
        if axis is None or angular is None or wheels_at is None or vibration is None or reading.is_still:
            return estimate
        if not 0 < reading.stamp - wheels_at <= _PAUSE_NS:
            return estimate
        dt_s = (reading.stamp - wheels_at) * 1e-9
        if estimate.angular is not None:
            angular = 0.5 * (estimate.angular + angular)
        gyro = float(axis @ (estimate.swept / dt_s - estimate.state.gyro_bias))
        noise = float((axis * axis) @ vibration.variance[:3]) * min(1.0, estimate.sampled_s / dt_s)
        estimate = estimate._replace(
            turning=turned(estimate.turning, float(axis @ angular), gyro, noise, dt_s)
        )
        compared = constant_difference(estimate.turning)
        if compared is None:
            return estimate
        rate = float(axis @ (estimate.rate - estimate.state.gyro_bias))
        return _with_bias_by_wheels(estimate, axis, rate, compared)

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
        assert estimate.vibration is not None  # after a sample
        seconds = (stamp - rest.start) * 1e-9
        noise = max(self.noise.gyro**2 / seconds, float(estimate.vibration.variance[:3].max()) / rest.size)
        sigma = math.sqrt(max(_REST_RATE**2, noise))
        bias_variance = float(np.diag(state.covariance)[GYRO_BIAS].max())
        turn = float(np.abs(gyro).max())
        is_plausible = turn < MOST_BIAS or bias_variance < (0.1 * MOST_BIAS) ** 2
        is_still = (
            wheels_stand
            and is_plausible
            and float(np.abs(gyro - state.gyro_bias).max()) < 3.5 * math.sqrt(bias_variance + sigma * sigma)
            and abs(math.sqrt(accel @ accel) + GRAVITY[2]) < _REST_FORCE
        )
        estimate = estimate._replace(
            rest=_new_rest(stamp, was_still=is_still),
            turn_at_rest=turn if wheels_stand and not is_plausible else 0.0,
        )
        if not (is_still and rest.was_still):
            return self._within_bounds(estimate), None
        # The base may be turned or carried while its wheels stand.
        still = zero_velocity(state, gyro, _REST_SPEED, sigma)
        found, outcome = _gated(estimate, STANDSTILL, still, None)
        if outcome.fate == "accepted" and not estimate.was_at_rest:
            # The comparison with the wheels is of the bias before.
            found = found._replace(was_at_rest=True, turning=Turning())
        return found, outcome

    def _within_bounds(self, estimate: Estimate) -> Estimate:
        """The estimate with a velocity that is plausible, if nothing measures it any more."""
        wheels_at, state, bound = estimate.wheels_at, estimate.state, _speed_bound(estimate)
        if wheels_at is None or estimate.stamp - wheels_at <= _PAUSE_NS:
            return estimate
        largest = max(
            float(np.diag(state.covariance)[VELOCITY].max()), float(state.velocity @ state.velocity)
        )
        if largest <= bound * bound:
            return estimate
        slow = zero_velocity(state, state.gyro_bias, bound, 1.0)
        slow = Measurement(slow.residual[:3], slow.jacobian[:3], slow.covariance[:3, :3])
        return _moved(estimate, updated(state, slow))


def is_still(linear: Floats, angular: Floats | None) -> bool:
    """Whether a velocity, (3,) [m/s] and [rad/s], is that of a base at rest."""
    if angular is not None and float(angular @ angular) > _STILL_RATE**2:
        return False
    return float(linear @ linear) <= _STILL_SPEED**2


def at_its_estimate(estimate: Estimate) -> Estimate:
    """The estimate whose continuous pose is the estimated one, as at its start."""
    return estimate._replace(offset=Offset(np.eye(3), np.zeros(3), estimate.stamp))


def odom_pose(estimate: Estimate, imu_from_frame: Floats) -> tuple[Floats, Floats]:
    """The continuous pose of a frame, (4, 4), and by how much the estimate differs from it.

    That is (6,): position, then rotation about the axes of the world, as in ``Transform.covariance``.
    """
    state, offset = estimate.state, estimate.offset
    point = state.position + state.rotation.dot(imu_from_frame[:3, 3])
    matrix = np.eye(4)
    matrix[:3, :3] = offset.rotation.dot(state.rotation).dot(imu_from_frame[:3, :3])
    matrix[:3, 3] = offset.rotation.dot(point) + offset.shift
    quaternion = se3.quaternion_from_matrix(offset.rotation.T)
    return matrix, np.concatenate((point - matrix[:3, 3], se3.rotation_vector(quaternion, se3.SCALARS)))


def imu_remarks(estimate: Estimate) -> list[str]:
    """What the IMU, and the prediction from it, have come to, in sentences."""
    found = [disagreement(estimate.turning)]
    if len(estimate.tilts) >= _SECTORS_TILTED:
        tilt = np.mean(list(estimate.tilts.values()), axis=0)
        if float(tilt @ tilt) > _TILTED * _TILTED:
            found.append(
                f"the base is tilted by {math.degrees(math.sqrt(tilt @ tilt)):.2g} degrees whichever way it "
                "heads: the mount of the IMU is off by that"
            )
    if estimate.turn_at_rest:
        found.append(
            f"the gyro reads {estimate.turn_at_rest:.2g} rad/s while the wheels stand: the base is turned, "
            f"or the bias is larger than {MOST_BIAS:g} rad/s and is found on a straight drive"
        )
    if _is_recent(estimate, estimate.biased_at):
        found.append(
            "the yaw rates of gyro and wheels differ by a constant: the bias of the gyro has changed, or the "
            "radii of the wheels differ"
        )
    if estimate.is_frozen:
        found.append("it repeats its last numbers while the wheels turn the base: it counts as silent")
    if _is_recent(estimate, estimate.lost_at):
        found.append(
            "the estimate was lost and follows the sources that it had rejected; its place is unsure"
        )
    pause = estimate.pause
    if pause is not None and _is_recent(estimate, pause.stamp):
        how = "wheels measured the way" if pause.is_bridged else "the base may have driven anywhere meanwhile"
        found.append(f"all data paused for {pause.seconds:.1f} s: {how}")
    return [text for text in found if text]


def lead_remarks(estimate: Estimate, source: str) -> list[str]:
    """What is known of another odometry: its scale, and whether its covariances are of use."""
    found, lead = tracked_pose(estimate.state, source), estimate.leads.get(source)
    if found is None or lead is None:
        return []
    texts = list[str]()
    row, tracked = found
    sigma = math.sqrt(float(estimate.state.covariance[row + 6, row + 6]))
    if abs(tracked.log_scale) > max(_SCALE_SIGMAS * sigma, _SCALE):
        factor = math.exp(-tracked.log_scale)
        what = "long" if factor > 1.0 else "short"
        texts.append(
            f"its displacements are {factor:.2f} times as long as those by the other sources: they are too "
            f"{what}, and scaled so"
        )
    kind = lead.last.noise.covariance
    if kind != "stated" and lead.stated > lead.shown:
        texts.append(
            f"its covariances do not grow as {kind} ones do, or are zero: the stated sigmas were used for "
            f"{lead.stated} of {lead.stated + lead.shown} displacements"
        )
    return texts


def _with_tilt(estimate: Estimate, reading: Reading) -> dict[int, Floats]:
    """The tilt of the base in each direction, with one reading more, by a slow mean."""
    if reading.upright is None or reading.is_still:
        return estimate.tilts
    rotation = estimate.state.rotation
    sector = _sector(math.atan2(rotation[1, 0], rotation[0, 0]))
    tilt = rotation[2] - reading.upright
    before = estimate.tilts.get(sector, tilt)
    return {**estimate.tilts, sector: before + _TILT_SHARE * (tilt - before)}


def _is_recent(estimate: Estimate, stamp: int | None) -> bool:
    return stamp is not None and estimate.stamp - stamp < _REMEMBERED_NS


def _with_bias_by_wheels(estimate: Estimate, axis: Floats, gyro: float, difference: Difference) -> Estimate:
    """The estimate after a comparison: wheels turn by ``difference`` more than the gyro about ``axis``.

    ``gyro`` is the rate that the gyro reads less its bias [rad/s]. A bias that was not measured at rest is
    corrected, if it is larger than that of a calibrated gyro. One that was measured is not, because the radii
    of wheels may differ: it is as unsure as the difference.
    """
    apart, sigma, noise = difference
    state, turning = estimate.state, estimate.turning
    variance = float(axis @ state.covariance[GYRO_BIAS, GYRO_BIAS] @ axis)
    corrected_by_wheels = yaw_rate(state, gyro + apart, sigma * sigma, axis, estimate.rate)
    if not estimate.was_at_rest and variance > _UNKNOWN_BIAS * _UNKNOWN_BIAS:
        if abs(apart) < _APART * math.hypot(sigma, _USUAL_BIAS):
            # What noise hides, the wheels do not confirm.
            usual = _USUAL_BIAS**2 + noise * noise + max(0.0, apart * apart - sigma * sigma)
            if usual < 0.9 * variance:
                # A measurement of what is known already, with the noise that leads to this variance.
                known = 1.0 / (1.0 / usual - 1.0 / variance)
                measurement = yaw_rate(state, gyro, known, axis, estimate.rate)
                return _moved(estimate._replace(turning=Turning()), updated(state, measurement))
            if sigma * sigma > _TELLING**2 * variance:
                return estimate
        estimate = estimate._replace(turning=Turning(), biased_at=estimate.stamp)
        return _moved(estimate, updated(state, corrected_by_wheels))
    if abs(apart) < _APART * math.sqrt(variance + sigma * sigma):
        return estimate
    covariance = state.covariance.copy()
    covariance[GYRO_BIAS, GYRO_BIAS] += np.outer(axis, axis) * apart**2
    # The base turned by so much more on its way of these seconds, about the middle of it. About the origin of
    # the world, as the yaw alone would be, the error of the position would vanish on the way back.
    seconds = min(turning.time_s, COMPARED_S)
    x, y, _ = (state.position - 0.5 * seconds * state.velocity).tolist()
    shift = np.zeros(len(covariance))
    shift[_YAW], shift[_LEVEL] = 1.0, (y, -x)
    covariance += np.outer(shift, shift) * (apart * seconds) ** 2
    state = state._replace(covariance=covariance)
    estimate = estimate._replace(state=state, turning=Turning(), biased_at=estimate.stamp)
    return estimate if estimate.was_at_rest else _moved(estimate, updated(state, corrected_by_wheels))


def _is_frozen(estimate: Estimate) -> bool:
    """Whether the IMU repeats its numbers while the wheels turn the base otherwise."""
    vibration, angular, upright = estimate.vibration, estimate.angular, estimate.upright
    if vibration is None or vibration.repeated < _FROZEN or angular is None or upright is None:
        return False
    if estimate.is_frozen:
        return True
    wheels, gyro = float(upright @ angular), float(upright @ (estimate.rate - estimate.state.gyro_bias))
    return abs(wheels - gyro) > _FROZEN_RATE + 0.1 * abs(wheels)


def _speed_bound(estimate: Estimate) -> float:
    return max(_LEAST_SPEED_BOUND, 2.0 * estimate.fastest)


def _bounded(state: FilterState, speed: float) -> FilterState:
    """The state with plausible standard deviations of tilt, yaw and velocity."""
    covariance = plain_covariance(state)
    sigmas = np.sqrt(np.diag(covariance))
    bounds = np.full(len(sigmas), math.inf)
    bounds[:6] = _TILT_BOUND, _TILT_BOUND, _YAW_BOUND, speed, speed, speed
    if (sigmas <= bounds).all():
        return state
    factors = np.minimum(1.0, bounds / np.maximum(sigmas, 1e-300))
    return with_plain_covariance(state, covariance * np.outer(factors, factors))


def _shock(before: Vibration, sample: Inertia) -> Floats | None:
    """The variance of a sample that jumps, (6,); None for all others."""
    change = np.concatenate((sample.gyro, sample.accel)) - before.values
    if not _jumps(change):
        return None
    return np.where(np.abs(change) > _SHOCK, change * change, 0.0)


def _jumps(change: Floats) -> bool:
    """Whether any number of a sample has changed as in a shock. In Python, a third of the time of arrays."""
    return any(abs(one) > bound for one, bound in zip(change.tolist(), _SHOCK, strict=True))


def _without_shock(before: Estimate, sample: Inertia) -> Inertia:
    """The sample, with the numbers that jump as they were before. One that stays there is believed."""
    if before.vibration is None or before.imu is None:
        return sample
    shock = _shock(before.vibration, sample)
    if shock is None:
        return sample
    gyro, accel = np.where(shock[:3] > 0.0, before.imu.gyro, sample.gyro), sample.accel
    return Inertia(sample.stamp, gyro, np.where(shock[3:] > 0.0, before.imu.accel, accel))


def _moved(estimate: Estimate, state: FilterState, *, is_step: bool = False) -> Estimate:
    """The estimate corrected to ``state``, while the continuous pose stays.

    ``place`` is that of the IMU. Tilt, and poses that are measured, are followed slowly. ``is_step``: feet
    measure displacements, which the place follows, slowly as well.
    """
    before, offset = estimate.state, estimate.offset
    place = offset.rotation.dot(before.position) + offset.shift
    rotation = offset.rotation.dot(before.rotation).dot(state.rotation.T)
    elapsed_s = (estimate.stamp - offset.stamp) * 1e-9
    if is_step:
        step = offset.rotation.dot(state.position - before.position)
        most = _PLACE_RATE * min(elapsed_s, _LONGEST_STEP_S)
        place = place + step * min(1.0, most / max(math.sqrt(step @ step), 1e-12))
    # The offset turns the vertical into the first two numbers; turning it back levels the pose.
    x, y = float(rotation[0, 2]), float(rotation[1, 2])
    angle = math.hypot(x, y)
    if angle > 1e-12:
        part = min(1.0, _TILT_RATE * elapsed_s / angle)
        rotation = rotation_exp(np.array((y * part, -x * part, 0.0))).dot(rotation)
    if offset.is_followed or offset.is_turned:
        yaw = math.atan2(rotation[1, 0], rotation[0, 0])
        most = _YAW_RATE * elapsed_s
        rotation = rotation_exp(np.array((0.0, 0.0, -max(-most, min(yaw, most))))).dot(rotation)
    if offset.is_followed or offset.is_lifted:
        gap = state.position - place
        if not offset.is_followed:
            gap[:2] = 0.0
        place = place + gap * min(1.0, _PLACE_RATE * elapsed_s / max(math.sqrt(gap @ gap), 1e-12))
    offset = offset._replace(
        rotation=rotation, shift=place - rotation.dot(state.position), stamp=estimate.stamp
    )
    return estimate._replace(state=state, offset=offset)


def _spread(
    sectors: Mapping[int, tuple[int, float]], stamp: int, against_gyro: float, bias_variance: float
) -> float:
    """The variance of a compass whose difference to the gyro turns with its direction: (range / 2)^2.

    What the gyro may have drifted since is no error of the compass.
    """
    found = 0.0
    for then, other in sectors.values():
        apart, elapsed_s = math.remainder(against_gyro - other, math.tau), (stamp - then) * 1e-9
        found = max(found, 0.25 * apart * apart - bias_variance * elapsed_s * elapsed_s)
    return found


def _sector(yaw: float) -> int:
    return math.floor(yaw / math.tau * _SECTORS) % _SECTORS


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


def _gated(
    estimate: Estimate,
    source: str,
    measurement: Measurement,
    lost: Callable[[FilterState, float], FilterState] | None,
    *,
    kept: Callable[[Innovation], Innovation] | None = None,
    is_step: bool = False,
    probability: float = GATE_PROBABILITY,
) -> tuple[Estimate, Outcome]:
    """The estimate after a measurement, if it passes the gate of ``probability``.

    ``lost(state, seconds)`` has forgotten what a source that was rejected for so long contradicts; without it
    a source is never followed. ``kept`` makes a gain that keeps a part of the state; for ``is_step`` see
    ``_moved``.
    """
    state, dimension = estimate.state, len(measurement.residual)
    found = innovation(state, measurement)
    nis = found.nis
    if nis <= gate(dimension, probability):
        if source in estimate.runs:
            estimate = _with_run(estimate, source, None)
        if kept is not None:
            found = kept(found)
        after = _moved(estimate, corrected(state, measurement, found), is_step=is_step)
        return after, Outcome("accepted", nis, dimension)
    if lost is None:
        return estimate, Outcome("rejected", nis, dimension)
    estimate, is_enough = _with_rejection(estimate, source)
    run = estimate.runs[source]
    if not is_enough:
        return estimate, Outcome("rejected", nis, dimension)
    state = lost(state, (estimate.stamp - run.start) * 1e-9)
    found = innovation(state, measurement)
    state = corrected(state, measurement, found if kept is None else kept(found))
    estimate = _moved(_with_run(estimate, source, None), state)._replace(lost_at=estimate.stamp)
    return estimate, Outcome("reacquired", nis, dimension)


def _without_yaw_bias(found: Innovation, axis: Floats) -> Innovation:
    """The innovation with a gain that leaves the bias of the gyro about ``axis``, (3,), as it is.

    A velocity shows it only by the force across the base in turns, which tilt, slip and play are part of.
    What it seems to show leads away on real drives. This is a consider filter (S. F. Schmidt, "Application of
    state-space methods to navigation problems", 1966); the covariance is that of this gain.
    """
    gain = found.gain.copy()
    gain[GYRO_BIAS] -= np.outer(axis, axis.dot(gain[GYRO_BIAS]))
    return found._replace(gain=gain)


def _without_scale(found: Innovation, row: int) -> Innovation:
    """The innovation with a gain that leaves the scale of the source, the error ``row``, as it is.

    With an IMU alone another odometry would learn it from accelerations, which vibration and tilt are part
    of: on a real drive it became 0.6. Wheels, feet, velocities and positions show it.
    """
    gain = found.gain.copy()
    gain[row] = 0.0
    return found._replace(gain=gain)


def _without_velocity(state: FilterState, residual: Floats, seconds: float) -> FilterState:
    """The state with an unknown velocity: it was wrong by the residual for so long."""
    error = float(residual[:3] @ residual[:3])
    covariance = forgotten(state.covariance.copy(), VELOCITY, error)
    covariance[POSITION, POSITION] += np.eye(3) * (error * seconds * seconds)
    return state._replace(covariance=covariance)


def _without_place(state: FilterState, residual: Floats, rows: Sequence[int]) -> FilterState:
    """The state without what was measured of position and yaw: they are wrong by the residual."""
    state = without_tracked(state)  # the jump is no motion from there
    measured = dict(zip(rows, residual.tolist(), strict=False))
    covariance = plain_covariance(state)
    places = [row for row in measured if row < POSE_ROTATION]
    error = sum(measured[row] ** 2 for row in places)
    for row in places:
        forgotten(covariance, slice(POSITION.start + row, POSITION.start + row + 1), error)
    if POSE_YAW in measured:
        forgotten(covariance, slice(_YAW, _YAW + 1), measured[POSE_YAW] ** 2)
    return with_plain_covariance(state, covariance)


def _raised(
    state: FilterState, residual: float, noise: float, gain: float, imu_from_frame: Floats
) -> FilterState:
    """The state after a height of a frame that was ``residual`` [m] more, with the variance ``noise`` [m^2].

    The part ``gain`` of it raises the base with its contacts and tracked poses, and nothing else: what an
    error that lasts would say of velocity, tilt and biases is wrong. It is a consider filter, as
    ``_without_yaw_bias``, with the covariance of this gain.
    """
    size = len(state.covariance)
    row, up = np.zeros(size), np.zeros(size)
    row[ROTATION], row[_UP] = -skew(state.rotation @ imu_from_frame[:3, 3])[2], 1.0
    up[height_rows(state)] = gain
    rest = np.eye(size) - np.outer(up, row)
    covariance = rest @ plain_covariance(state) @ rest.T + noise * np.outer(up, up)
    raised = np.array((0.0, 0.0, gain * residual))
    state = state._replace(
        position=state.position + raised,
        contacts=state.contacts + raised,
        tracked=tuple(one._replace(position=one.position + raised) for one in state.tracked),
    )
    return with_plain_covariance(state, covariance)


def _with_rejection(estimate: Estimate, source: str) -> tuple[Estimate, bool]:
    """The estimate after a rejection more, and whether there were enough in a row to follow the source."""
    run = estimate.runs.get(source) or Run(estimate.stamp, 0, 0)
    run = Run(run.start, estimate.stamp, run.length + 1)
    is_enough = run.length >= _REACQUIRE_COUNT and estimate.stamp - run.start >= _REACQUIRE_NS
    return _with_run(estimate, source, run), is_enough


def _with_altimeter(estimate: Estimate, source: str, altimeter: Altimeter) -> Estimate:
    """The estimate with a source of heights that begins, or begins again."""
    estimate = _with_run(estimate, source, None)
    return estimate._replace(altimeters={**estimate.altimeters, source: altimeter})


def _placed_by(estimate: Estimate, reading: Reading, residual: Floats) -> Estimate:
    """The estimate where a pose has it that is followed after all: an update is linear, a large turn is not.

    Each step leaves an error of the second order of the one before. The place is as unsure before each as by
    the ``residual`` of the first, and as sure after it as the pose.
    """
    for _ in range(_PLACED_STEPS):
        measurement = reading.measure(estimate.state, estimate.rate)
        state = _without_place(estimate.state, residual, reading.rows)
        estimate = _moved(estimate, updated(state, measurement))
    return estimate


def _with_run(estimate: Estimate, source: str, run: Run | None) -> Estimate:
    others = {name: other for name, other in estimate.runs.items() if name != source}
    return estimate._replace(runs=others if run is None else {**others, source: run})


def _led(estimate: Estimate, source: str, lead: Lead) -> Estimate:
    """The estimate with the pose by a source at its own."""
    state = with_tracked(estimate.state, source, lead.last.noise.scale)
    return estimate._replace(state=state, leads={**estimate.leads, source: lead})


def _with_compass(estimate: Estimate, source: str, compass: Compass) -> Estimate:
    return estimate._replace(compasses={**estimate.compasses, source: compass})
