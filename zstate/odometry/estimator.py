"""BaseEstimator: where the base of a robot is, from an IMU, wheels, legs, velocities, poses and headings.

All events are kept for ``history_s`` in the order of their stamps, each with the estimate after it, which is
immutable. A late event is sorted in, and the events after it are fused again when a state is next read. So
the order of arrival does not matter, and a replay of the same calls gives the same states, bit for bit. No
clock is read.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from zstate import se3
from zstate._util.format import did_you_mean
from zstate.buffer.buffer import TransformBuffer, check_duration
from zstate.clock import check_stamp
from zstate.errors import InFuture, InPast, InvalidInput, NoData
from zstate.odometry.alignment import Alignment, align, start_at
from zstate.odometry.fusion import (
    COASTING_RATE_DENSITY,
    LOST_NS,
    SILENCE_NS,
    STANDSTILL,
    Contacts,
    Displacement,
    Estimate,
    Fusion,
    Heading,
    Inertia,
    Reading,
    Steps,
    imu_remarks,
    is_still,
    odom_pose,
)
from zstate.odometry.health import Outcome, SourceHealth, SourceRecord
from zstate.odometry.invariant_filter import FilterState, Floats, ImuNoise, Measurement
from zstate.odometry.legs import Legs
from zstate.odometry.measurements import (
    body_velocity,
    checked_noise,
    checked_vector,
    frame_pose,
    frame_twist,
    pose,
    yaw_curvature,
)
from zstate.odometry.wheels import Wheels, WheelVelocity, check_wheel_positions, displacement
from zstate.transform import UPPER_TRIANGLE, PoseWithCovariance, Transform

IMU, WHEELS, FEET, CONTACTS = "imu", "wheels", "feet", "contacts"
"""The names of these sources in ``BaseEstimator.health``."""

COAST_NS = 500_000_000
"""No state is later than the newest event by more than this."""

_MOST_UNFUSED = 2000
_PRUNED_AT_ONCE = 64


class BaseTwist(NamedTuple):
    """The velocity of a base in its own axes, (3,) each: ``linear`` [m/s] and ``angular`` [rad/s]."""

    linear: Floats
    angular: Floats


class BaseCovariance(NamedTuple):
    """The covariances of a base, (6, 6) each.

    ``pose`` has the order and axes of ``Transform.covariance``; ``twist`` is linear before angular.
    """

    pose: Floats
    twist: Floats


@dataclass(frozen=True, eq=False, slots=True)
class BaseState:
    """The pose and velocity of a base at ``stamp`` [ns].

    ``covariance`` is that of ``odom_from_base`` and of ``twist``. ``gyro_bias`` [rad/s] and
    ``accel_bias`` [m/s^2] are those of the IMU in its axes, (3,). ``is_coasting``: the IMU is silent.
    """

    stamp: int
    odom_from_base: Transform
    twist: BaseTwist
    covariance: BaseCovariance
    gyro_bias: Floats
    accel_bias: Floats
    is_coasting: bool


_Input: TypeAlias = Inertia | Reading | Displacement | Heading | Contacts | Steps


class _Event:
    """An entry of the log. ``key`` sorts by stamp, kind, source and numbers, so that ties have one order."""

    __slots__ = ("estimate", "key", "outcome", "reading", "source")

    def __init__(self, source: str, reading: _Input, numbers: Sequence[float] = ()) -> None:
        kind = 0 if isinstance(reading, Inertia) else 1
        self.key = (reading.stamp, kind, source, *numbers)
        self.source = source
        self.reading = reading
        self.estimate: Estimate | None = None
        self.outcome: Outcome | None = None


def _key(event: _Event) -> tuple[int | str | float, ...]:
    return event.key


class BaseEstimator:
    """The pose of ``base`` in ``odom``, of a robot with an IMU in the frame ``imu``.

    ``odom`` is the frame in which the base starts, at the origin with the yaw zero and z up, after about 0.5
    s at rest; with an ``initial_pose``, odom_from_base, at the first event. Mounts of sensors are looked up
    in ``buffer`` and must be static; names are bare or with the robot, as there. ``imu_noise`` is that of the
    IMU. Events older than ``history_s`` before the newest one are refused and counted. ``wheels`` are those
    that ``joints`` reads.

    Events may arrive in any order. Not safe for several threads at once. Raises InvalidInput for a sensor
    that moves on the base, UnknownFrame with near misses, and other errors of lookups.
    """

    def __init__(
        self,
        *,
        odom: str,
        base: str,
        imu: str,
        buffer: TransformBuffer,
        imu_noise: ImuNoise,
        history_s: float = 1.0,
        wheels: Wheels | None = None,
        legs: Legs | None = None,
        initial_pose: Transform | None = None,
    ) -> None:
        self.odom, self.base = odom, base
        self.imu_frame = imu
        self.history_s = check_duration("history_s", history_s)
        self._history_ns = round(history_s * 1e9)
        self._buffer = buffer
        self._mounts: dict[str, Floats] = {}
        self._imu_from_base = self._mount(base)
        self._noise = imu_noise
        self._fusion = Fusion(imu_noise, legs)
        self._wheels, self._legs = wheels, legs
        self._has_contacts = False
        if wheels is not None and wheels.frame is not None:
            self._mount(wheels.frame)
        self._initial_pose = initial_pose
        self._log: list[_Event] = []
        self._start: Estimate | None = None
        self._is_settled = False
        """Whether no later event can change the alignment."""
        self._alignment_end = 0
        """Events from here on in the log had no part in the alignment."""
        self._fused = 0
        """Events up to here have the estimate after them."""
        self._missing = "no samples of the IMU yet, which give roll and pitch"
        self._newest: int | None = None
        self._rotations: list[tuple[int, dict[str, float]]] = []
        """Readings of the wheels, by stamp."""
        self._sources: defaultdict[str, SourceRecord] = defaultdict(SourceRecord)

    def imu(self, stamp: int, gyro: ArrayLike, accel: ArrayLike) -> None:
        """A sample of the IMU at ``stamp`` [ns]: rate [rad/s] and specific force [m/s^2] in its axes, (3,).

        Raises InvalidInput for other shapes, NaN and infinity.
        """
        rate, force = checked_vector(gyro, IMU, "gyro"), checked_vector(accel, IMU, "accel")
        self._insert(_Event(IMU, Inertia(check_stamp(stamp), rate, force), (*rate.tolist(), *force.tolist())))

    def velocity(
        self,
        stamp: int,
        linear: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        angular: ArrayLike | None = None,
        frame: str | None = None,
        scale: float = 0.02,
        source: str = WHEELS,
    ) -> None:
        """The velocity of the origin of ``frame`` in its own axes at ``stamp``, x y z [m/s], (3,).

        Its noise is given by ``sigma``, standard deviations (3,), or by ``covariance``, (3, 3). ``frame`` is
        the base by default. ``angular`` [rad/s] (3,) is used while the IMU is silent, and to know standstill.
        ``scale`` is the standard deviation of a constant relative error, as of a radius of wheels.
        Raises InvalidInput, which names the source, for NaN and for what is no covariance; UnknownFrame for
        the frame.
        """
        vector = checked_vector(linear, source, "velocity")
        rate = None if angular is None else checked_vector(angular, source, "angular velocity")
        noise = checked_noise(sigma, covariance, 3, source)
        measured = WheelVelocity(vector, np.zeros(3) if rate is None else rate, noise)
        if not 0.0 <= scale < math.inf:
            raise InvalidInput(
                f"the scale of source {source!r} is a standard deviation of 0 or more; got {scale!r}"
            )
        self._insert_velocity(check_stamp(stamp), measured, frame, source, scale, has_rate=rate is not None)

    def joints(
        self,
        stamp: int,
        positions: Mapping[str, float],
        *,
        velocities: Mapping[str, float] | None = None,
        efforts: Mapping[str, float] | None = None,
    ) -> None:
        """The joints by name at ``stamp`` [ns]: positions [rad] or [m], for wheels and legs.

        Two readings of wheels are a displacement, whose mean velocity is fused at the middle of the interval.
        ``velocities`` or ``efforts`` [Nm] or [N] are needed to detect contacts of feet. Others than the
        joints of wheels and legs are ignored. Raises InvalidInput without wheels and legs, and for missing
        joints and NaN.
        """
        if self._wheels is None and self._legs is None:
            raise InvalidInput(
                "joints() reads wheels and legs; pass wheels=DiffDrive(...) or legs=Legs(...) to "
                "BaseEstimator"
            )
        stamp = check_stamp(stamp)
        if self._wheels is not None:
            self._insert_rotations(self._wheels, stamp, check_wheel_positions(self._wheels, positions))
        if self._legs is not None:
            numbers = [float(positions.get(name, math.nan)) for name in self._legs.joint_names]
            steps = Steps(stamp, self._legs.feet(positions), velocities, efforts)
            if not all(map(math.isfinite, numbers)):
                raise InvalidInput(f"positions of legs must be finite; got {dict(positions)}")
            if not self._has_contacts:
                self._legs.check_detection(velocities, efforts)
            self._sources[FEET].has_bounds = True
            self._insert(_Event(FEET, steps, numbers))

    def contacts(self, stamp: int, touching: Mapping[str, bool]) -> None:
        """Which feet are on the ground from ``stamp`` on, by name; those left out are not.

        From the first call on, contacts are not detected from joints any more. Raises InvalidInput without
        legs and for unknown feet.
        """
        names = () if self._legs is None else self._legs.names
        unknown = [name for name in touching if name not in names]
        if self._legs is None or unknown:
            near = did_you_mean(unknown[0], names) if unknown else ""
            raise InvalidInput(
                f"contacts of {', '.join(touching)}; feet are {', '.join(names) or 'none'}{near}"
            )
        self._has_contacts = True
        down = frozenset(name for name, is_down in touching.items() if is_down)
        flags = [float(name in down) for name in names]
        self._insert(_Event(CONTACTS, Contacts(check_stamp(stamp), down), flags))

    def pose(self, stamp: int, odom_from_base: Transform, covariance: ArrayLike, *, source: str) -> None:
        """The pose of a frame on the robot in ``odom`` at ``stamp``, as of motion capture.

        ``covariance`` (6, 6) has the order and axes of ``Transform.covariance``. Raises InvalidInput, which
        names the source, for another target than ``odom``, NaN and what is no covariance; UnknownFrame for
        the frame.
        """
        if odom_from_base.target != self.odom:
            raise InvalidInput(
                f"poses of source {source!r} are in {odom_from_base.target!r}; they must be in {self.odom!r}"
            )
        mount = self._mount(odom_from_base.source)
        noise = checked_noise(None, covariance, 6, source)
        matrix = odom_from_base.matrix

        def measure(state: FilterState, _: Floats) -> Measurement:
            return pose(state, matrix, noise, mount)

        reading = Reading(check_stamp(stamp), measure, is_position=True)
        self._insert(_Event(source, reading, odom_from_base.pose7.tolist()))

    def heading(self, stamp: int, yaw: float, sigma: float, *, source: str, frame: str | None = None) -> None:
        """The yaw of ``frame``, by default the base, at ``stamp`` [rad], with a standard deviation.

        It is relative to the first one of this source, because the odometry frame has no north. ``sigma`` is
        that of errors that do not average out: the yaw will not be known better by it. See
        ``zstate.odometry.fusion``. Raises InvalidInput, which names the source, for NaN and a sigma that is
        not above zero.
        """
        mount = self._mount(frame or self.base)
        if not (math.isfinite(yaw) and 0.0 < sigma < math.inf):
            raise InvalidInput(
                f"a heading of source {source!r} is finite, with a sigma above zero [rad]; got "
                f"yaw={yaw!r}, sigma={sigma!r}"
            )
        reading = Heading(check_stamp(stamp), float(yaw), float(sigma) ** 2, mount)
        self._insert(_Event(source, reading, (yaw, sigma)))

    def state(self, at: int | None = None) -> BaseState:
        """The state at the stamp ``at`` [ns]; by default at the newest event.

        Before the initial alignment raises NoData, with what is missing. Raises InFuture for an instant more
        than 0.5 s after the newest event, and InPast for one before the oldest that is kept.
        """
        self._fuse()
        if self._start is None:
            error = NoData(self.odom, self.base, edge=(self.odom, self.base), requested=at)
            error.note = f"the base is not aligned: {self._missing}"
            raise error
        newest = self._log[-1].key[0] if self._log else self._start.stamp
        stamp = max(newest, self._start.stamp) if at is None else check_stamp(at)
        if stamp > newest + COAST_NS:
            error = InFuture(
                self.odom, self.base, edge=(self.odom, self.base), requested=stamp, newest=newest
            )
            error.note = "IMU and wheels are silent, and a base does not coast for ever"
            raise error
        if stamp < self._start.stamp:
            raise InPast(
                self.odom,
                self.base,
                edge=(self.odom, self.base),
                requested=stamp,
                oldest=self._start.stamp,
                newest=newest,
            )
        place = bisect_right(self._log, stamp, key=lambda event: event.key[0])
        before = self._estimate_before(place)
        return self._state_of(self._fusion.predicted(before, stamp, self._following(place)))

    def health(self) -> tuple[SourceHealth, ...]:
        """The health of each source, by name; standstill is one as soon as it is found."""
        self._fuse()
        newest = self._newest or 0
        recent: dict[str, list[Outcome]] = {name: [] for name in self._sources}
        for event in self._log[: self._fused]:
            if event.outcome is not None:
                recent[_outcome_source(event)].append(event.outcome)
        last = self._estimate_before(self._fused) if self._start is not None else None
        return tuple(
            record.health(
                name, newest, recent[name], self._remark(name, record, last, newest), self.history_s
            )
            for name, record in sorted(self._sources.items())
        )

    def _remark(self, name: str, record: SourceRecord, last: Estimate | None, newest: int) -> str:
        """What the fusion has to say of a source."""
        found = list[str]()
        if name == IMU and record.stamps and newest - max(record.stamps) > SILENCE_NS:
            found.append(
                "silent; the base is predicted from its last velocity and its wheels, with large noise"
            )
        if last is None:
            return "; ".join(found)
        if name == IMU:
            found += imu_remarks(last)
        run = last.runs.get(name)
        if run is not None and run.stamp - run.start > LOST_NS and newest - run.stamp < LOST_NS:
            found.append(
                f"rejected for {(run.stamp - run.start) * 1e-9:.1f} s in a row: the estimate is lost, unless another "
                "source confirms it"
            )
        compass = last.compasses.get(name)
        if compass is not None and compass.deviation > 0.0:
            degrees = math.degrees(math.sqrt(compass.deviation))
            found.append(
                f"off by about {degrees:.2g} degrees as the base moves, against the gyro, and weighted so"
            )
        return "; ".join(found)

    def _mount(self, frame: str) -> Floats:
        """imu_from_frame, (4, 4), which must be static."""
        if frame not in self._mounts:
            transform = self._buffer.lookup(self.imu_frame, frame)
            if transform.stamp is not None:
                raise InvalidInput(
                    f"{frame!r} moves on the robot, seen from {self.imu_frame!r}; odometry needs sensors "
                    "with a fixed mount"
                )
            self._mounts[frame] = transform.matrix
        return self._mounts[frame]

    def _is_too_late(self, source: str, stamp: int) -> bool:
        """Whether an event is older than what is kept, in which case it is counted."""
        if self._newest is None or stamp >= self._newest - self._history_ns:
            return False
        self._sources[source].too_late += 1
        return True

    def _insert_rotations(self, wheels: Wheels, stamp: int, found: dict[str, float]) -> None:
        """Insert the displacements from the reading before and to that after, instead of that between."""
        if self._is_too_late(WHEELS, stamp):
            return
        place = bisect_left(self._rotations, stamp, key=lambda entry: entry[0])
        if place < len(self._rotations) and self._rotations[place][0] == stamp:
            return  # the same reading again, as after a reconnection
        before = self._rotations[place - 1] if place else None
        after = self._rotations[place] if place < len(self._rotations) else None
        self._rotations.insert(place, (stamp, found))
        if before and after:
            self._remove(WHEELS, (before[0] + after[0]) // 2)
        for first, second in ((before, (stamp, found)), ((stamp, found), after)):
            if first and second:
                self._insert_displacement(wheels, first, second)
        self._sources[WHEELS].has_bounds = True

    def _insert_displacement(
        self, wheels: Wheels, first: tuple[int, dict[str, float]], second: tuple[int, dict[str, float]]
    ) -> None:
        seconds = (second[0] - first[0]) * 1e-9
        measured = wheels.velocity(first[1], second[1], seconds)
        self._newest = max(self._newest or second[0], second[0])
        if second[0] - first[0] > COAST_NS:
            mount = self._mount(wheels.frame or self.base)
            way, turn = displacement(measured, seconds)
            self._insert(_Event(WHEELS, Displacement(second[0], first[0], way, turn, mount), way.tolist()))
            return
        self._insert_velocity(
            (first[0] + second[0]) // 2, measured, wheels.frame, WHEELS, wheels.noise.scale, has_rate=True
        )

    def _insert_velocity(
        self,
        stamp: int,
        measured: WheelVelocity,
        frame: str | None,
        source: str,
        scale: float,
        *,
        has_rate: bool,
    ) -> None:
        linear, angular, noise = measured
        mount = self._mount(frame or self.base)
        rate = angular if has_rate else None

        def measure(state: FilterState, gyro: Floats) -> Measurement:
            return body_velocity(state, linear, noise, mount, gyro)

        reading = Reading(
            stamp,
            measure,
            is_still(linear, rate),
            None if rate is None else mount[:3, :3] @ rate,
            scale=scale,
            upright=mount[:3, 2],
            speed=math.sqrt(linear @ linear),
        )
        self._insert(_Event(source, reading, linear.tolist()))

    def _insert(self, event: _Event) -> None:
        stamp = event.reading.stamp
        if self._is_too_late(event.source, stamp):
            return
        self._sources[event.source].stamps.append(stamp)
        if self._newest is None or stamp > self._newest:
            self._newest = stamp
        if not self._log or event.key >= self._log[-1].key:
            place = len(self._log)
            self._log.append(event)
        else:
            place = bisect_right(self._log, event.key, key=_key)
            self._log.insert(place, event)
        if isinstance(event.reading, Inertia):
            place = self._first_between_samples(place)
        self._rewind(place)
        if len(self._log) - self._fused > _MOST_UNFUSED:
            self._fuse()

    def _first_between_samples(self, place: int) -> int:
        """The first event before a new sample at ``place`` that was fused without it.

        Events after the previous sample were, unless they have its stamp.
        """
        first = place
        while first and not isinstance(self._log[first - 1].reading, Inertia):
            first -= 1
        if not first:
            return 0
        sampled = self._log[first - 1].reading.stamp
        return bisect_right(self._log, sampled, first, place, key=lambda event: event.reading.stamp)

    def _remove(self, source: str, stamp: int) -> None:
        """Remove a displacement that a reading in its middle has divided."""
        place = bisect_left(self._log, (stamp, 1, source), key=_key)
        if place < len(self._log) and self._log[place].key[:3] == (stamp, 1, source):
            del self._log[place]
            self._rewind(place)

    def _rewind(self, place: int) -> None:
        self._fused = min(self._fused, place)
        if not self._is_settled and self._start is not None and place < self._alignment_end:
            self._start, self._fused = None, 0  # another sample may change the alignment

    def _fuse(self) -> None:
        """Fuse all events that have no estimate after them yet, and forget those that are too old."""
        if self._start is None:
            self._align()
        if self._start is None:
            return
        estimate = self._estimate_before(self._fused)
        for place in range(self._fused, len(self._log)):
            event = self._log[place]
            estimate, event.outcome = self._after(estimate, event, place)
            event.estimate = estimate
        self._fused = len(self._log)
        self._prune()

    def _after(self, estimate: Estimate, event: _Event, place: int) -> tuple[Estimate, Outcome | None]:
        reading = event.reading
        if reading.stamp < estimate.stamp:  # before the first estimate
            return estimate, None
        if isinstance(reading, Inertia):
            after, outcome = self._fusion.after_inertia(estimate, reading)
            if outcome is not None:
                self._count_standstill(reading.stamp)
            return after, outcome
        following = self._following(place)
        if isinstance(reading, Contacts):
            after = self._fusion.predicted(estimate, reading.stamp, following)
            return after._replace(touching=reading.touching), None
        if isinstance(reading, Steps):
            assert self._legs is not None
            return self._fusion.after_steps(self._legs, estimate, reading, following)
        if isinstance(reading, Displacement):
            return self._fusion.after_pause(estimate, reading, following)
        if isinstance(reading, Heading):
            return self._fusion.after_heading(estimate, event.source, reading, following)
        return self._fusion.after_reading(estimate, event.source, reading, following)

    def _count_standstill(self, stamp: int) -> None:
        record = self._sources[STANDSTILL]
        record.has_bounds = True
        if not record.stamps or stamp > record.stamps[-1]:  # else it is replayed
            record.stamps.append(stamp)

    def _align(self) -> None:
        if self._initial_pose is not None and self._log:
            self._start = start_at(self._log[0].reading.stamp, self._initial_pose, self._imu_from_base)
            self._alignment_end = 1
            return
        samples = [event.reading for event in self._log if isinstance(event.reading, Inertia)]
        if not samples:
            self._forget(self._too_old())
        readings = [event.reading for event in self._log if isinstance(event.reading, Reading)]
        turns = [(one.stamp, one.angular) for one in readings if one.angular is not None]
        outcome = align(samples, turns, self._imu_from_base)
        if isinstance(outcome, Alignment):
            self._start = outcome.estimate
            self._alignment_end = bisect_right(self._log, outcome.end, key=lambda event: event.reading.stamp)
        else:
            self._missing = outcome

    def _prune(self) -> None:
        """Forget events that are too old, but for the estimate after the last of them."""
        count = self._too_old()
        if count < _PRUNED_AT_ONCE:
            return
        self._start = self._estimate_before(count)
        self._is_settled = True
        for event in self._log[:count]:
            if event.outcome is not None:
                self._sources[_outcome_source(event)].keep(event.outcome)
        self._forget(count)

    def _too_old(self) -> int:
        """How many events of the log are too old to be changed by later ones."""
        oldest = (self._newest or 0) - self._history_ns
        return bisect_left(self._log, oldest, key=lambda event: event.reading.stamp)

    def _forget(self, count: int) -> None:
        del self._log[:count]
        self._fused = max(0, self._fused - count)
        oldest = (self._newest or 0) - self._history_ns
        # A displacement starts at the reading before.
        first = bisect_left(self._rotations, oldest, key=lambda entry: entry[0]) - 1
        del self._rotations[: max(0, first)]

    def _following(self, place: int) -> Inertia | None:
        """The first sample of the IMU in the log from ``place`` on."""
        for index in range(place, len(self._log)):
            reading = self._log[index].reading
            if isinstance(reading, Inertia):
                return reading
        return None

    def _estimate_before(self, place: int) -> Estimate:
        estimate = self._log[place - 1].estimate if place else self._start
        assert estimate is not None
        return estimate

    def _state_of(self, estimate: Estimate) -> BaseState:
        settled = self._fusion.settled(estimate)
        _, pose_covariance = frame_pose(settled.state, self._imu_from_base)
        pose_covariance[:2, :2] += yaw_curvature(pose_covariance)
        matrix, corrected = odom_pose(estimate, self._imu_from_base)
        pose_covariance += np.outer(corrected, corrected)
        density = COASTING_RATE_DENSITY if estimate.is_coasting else self._noise.gyro
        variance = density * density / estimate.sampled_s
        if estimate.vibration is not None:
            variance = max(variance, float(estimate.vibration.variance[:3].max()))
        twist, twist_covariance = frame_twist(settled.state, self._imu_from_base, estimate.rate, variance)
        along = estimate.drift.scale * twist[:3]
        twist_covariance[:3, :3] += np.outer(along, along)
        pose7 = (*matrix[:3, 3].tolist(), *se3.quaternion_from_matrix(matrix[:3, :3]))
        # Names and numbers are our own: checks would take as long as a prediction.
        transform = Transform.trusted(self.odom, self.base, pose7, estimate.stamp, "exact")
        return BaseState(
            estimate.stamp,
            PoseWithCovariance.of_pose(transform, pose_covariance[UPPER_TRIANGLE].tolist),
            BaseTwist(twist[:3], twist[3:]),
            BaseCovariance(pose_covariance, twist_covariance),
            estimate.state.gyro_bias,
            estimate.state.accel_bias,
            estimate.is_coasting,
        )


def _outcome_source(event: _Event) -> str:
    return STANDSTILL if isinstance(event.reading, Inertia) else event.source
