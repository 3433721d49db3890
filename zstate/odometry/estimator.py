"""BaseEstimator: where the base of a robot is, from an IMU, wheels, legs, velocities, poses and more.

All events are kept for ``history_s`` in the order of their stamps, each with the estimate after it, which is
immutable. A late event is sorted in, and the events after it are fused again when a state is next read. So
the order of arrival does not matter, and a replay of the same calls gives the same states, bit for bit. No
clock is read; jumps of time are found by the stamps (``zstate.odometry.stamp_order``).

No event stops it. One that cannot be fused is rejected, with a reason in ``health``. If the estimate itself
is not finite any more, it starts again from its last finite pose.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from zstate import se3
from zstate._util.format import did_you_mean, format_duration
from zstate.buffer.buffer import TransformBuffer, check_duration
from zstate.checks import Floats, real_numbers
from zstate.clock import Clock, check_stamp
from zstate.errors import InFuture, InPast, InvalidInput, NoData
from zstate.odometry.alignment import COARSE_S, Alignment, align, start_at
from zstate.odometry.fusion import (
    COASTING_RATE_DENSITY,
    LOST_NS,
    SILENCE_NS,
    STANDSTILL,
    Contacts,
    Displacement,
    Estimate,
    Field,
    Fusion,
    Heading,
    Height,
    Inertia,
    Reading,
    Steps,
    imu_remarks,
    is_still,
    lead_remarks,
    odom_pose,
)
from zstate.odometry.health import GATE_PROBABILITY, Outcome, SourceHealth, SourceRecord, check_gate
from zstate.odometry.invariant_filter import FilterState, ImuNoise, Measurement
from zstate.odometry.legs import Legs
from zstate.odometry.magnetism import EarthField, check_strength
from zstate.odometry.measurements import (
    ALL_ROWS,
    MAX_SIGMA,
    MIN_SIGMA,
    Rows,
    body_velocity,
    checked_noise,
    checked_vector,
    frame_pose,
    frame_twist,
    pose,
    yaw_curvature,
)
from zstate.odometry.measurements import position as measured_position
from zstate.odometry.messages import MAX_ACCELERATION, MAX_DISTANCE, MAX_FIELD, MAX_RATE, MAX_SPEED
from zstate.odometry.placement import Placement, is_finite, last_pose, placed
from zstate.odometry.relative import RelativePose
from zstate.odometry.source_noise import POSE_AXES, VELOCITY_AXES, RelativeNoise, axis_rows
from zstate.odometry.stamp_order import Held, StampOrder
from zstate.odometry.wheels import Wheels, WheelVelocity, check_wheel_positions, displacement
from zstate.transform import UPPER_TRIANGLE, PoseWithCovariance, Transform

IMU, WHEELS, FEET, CONTACTS = "imu", "wheels", "feet", "contacts"
"""The names of these sources in ``BaseEstimator.health``."""

_ALIGNED_NS = 3_000_000_000
"""After this time without an alignment, the health of the IMU says why."""

COAST_NS = 500_000_000
"""No state is later than the newest event by more than this."""

_MOST_UNFUSED = 2000
_PRUNED_AT_ONCE = 64

_MOST_SOURCES = 64
_MOST_PER_S = 10_000
"""Events of all sources in a second of history. More are refused."""

_UNALIGNED_NS = round(2.0 * COARSE_S * 1e9)
"""Before the alignment, events are kept for so long, or for the history."""

_RESTART_TOLD_NS = 60_000_000_000
"""How long ``health`` reports a new start."""

_LARGEST_YAW = 1e6
"""[rad] Of a heading that counts its turns on. Doubles then still resolve 1e-10 rad."""


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
    odom_from_base: PoseWithCovariance
    twist: BaseTwist
    covariance: BaseCovariance
    gyro_bias: Floats
    accel_bias: Floats
    is_coasting: bool


_Input: TypeAlias = (
    Inertia | Reading | Displacement | RelativePose | Heading | Height | Field | Contacts | Steps | Placement
)


class _Event:
    """An entry of the log. ``key`` sorts by stamp, kind, source and numbers, so that ties have one order."""

    __slots__ = ("estimate", "key", "outcome", "reading", "source")

    def __init__(self, source: str, reading: _Input, numbers: Sequence[float] = ()) -> None:
        kind = 0 if isinstance(reading, Inertia) else 2 if isinstance(reading, Placement) else 1
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
    IMU. Events older than ``history_s`` before the newest one are refused and counted. ``wheels`` and
    ``legs`` are those that ``joints`` reads.

    Events may arrive in any order; an event that comes twice counts once. A reading more than ``history_s``,
    and more than a second, after the newest one is used once a second one confirms it. If time goes back by
    as much for half a second of readings, as in a recording in a loop, it restarts, and ``epoch``, the
    number of such starts and of calls of ``reset``, grows (``zstate.odometry.stamp_order``).

    Not safe for several threads at once. Raises InvalidInput for a sensor that moves on the base,
    UnknownFrame with near misses, and other errors of lookups. Its methods for events raise InvalidInput for
    more than 64 sources and for more than 10,000 events in a second of stamps.
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
        self._is_continuous = True
        self._follower: BaseEstimator | None = None
        self.imu_frame = imu
        self.history_s = check_duration("history_s", history_s)
        self._history_ns = round(history_s * 1e9)
        self._unaligned_ns = max(self._history_ns, _UNALIGNED_NS)
        self._most_events = _MOST_UNFUSED + round(_MOST_PER_S * self._unaligned_ns * 1e-9)
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
        self.epoch = 0
        """How often it has restarted: by ``reset``, or because time went back."""
        self.placements = 0
        """How often it was placed by ``set_pose``."""
        self._begin()

    def _begin(self) -> None:
        """Forget all events and what came of them."""
        self._log: list[_Event] = []
        self._start: Estimate | None = None
        self._is_settled = False
        """Whether no later event can change the alignment."""
        self._alignment_end = 0
        """Events from here on in the log had no part in the alignment."""
        self._fused = 0
        """Events up to here have the estimate after them."""
        self._missing = "no samples of the IMU yet, which give roll and pitch"
        self._order = StampOrder(self._history_ns, IMU)
        self._rotations: list[tuple[int, dict[str, float]]] = []
        """Readings of the wheels, by stamp."""
        self._sources: dict[str, SourceRecord] = {}
        self._follower = None
        self._restarts: dict[str, tuple[int, str]] = {}
        """By source, when and why it restarted the estimate."""

    def reset(self, odom_from_base: Transform | None = None) -> None:
        """Restart: forget all events, biases and the pose, and align again, at rest.

        The base is then at the origin of ``odom``, or at ``odom_from_base`` from the next event on, as with
        ``initial_pose``, whose place it takes. It is no correction: in the terms of REP 105 the pose in
        ``odom`` is continuous, and this breaks it as a restart of the robot does. A pose in a map belongs
        to map -> odom (``MapCorrection``).
        """
        if odom_from_base is not None:
            self._check_placement(odom_from_base)
            self._initial_pose = odom_from_base
        self._begin()
        self.epoch += 1

    def follower(self, odom: str) -> BaseEstimator:
        """Another estimator with all that this one knows, in the world ``odom``, whose pose may jump.

        It gets all further events of this one, but for poses in this one's ``odom``, placements and new
        starts. Its states have the estimated pose, where those of this one have the continuous one. The last
        follower is the only one.
        """
        other = copy(self)
        other.odom, other._is_continuous = odom, False
        other._log = [copy(event) for event in self._log]
        other._order = self._order.copied()
        other._rotations, other._mounts = list(self._rotations), dict(self._mounts)
        other._sources, other._restarts = deepcopy(self._sources), dict(self._restarts)
        self._follower, other._follower = other, None
        return other

    def position(
        self,
        stamp: int,
        position: ArrayLike,
        covariance: ArrayLike,
        *,
        source: str,
        frame: str,
        gate: float = GATE_PROBABILITY,
    ) -> None:
        """The ``position`` of the origin of ``frame`` in ``odom`` at ``stamp`` [m], (3,), as of an antenna.

        ``covariance`` (3, 3) is that of errors that are independent of those of other readings. ``source``
        and ``gate`` are as in ``velocity``. Raises InvalidInput and UnknownFrame as ``pose``.
        """
        measured = checked_vector(position, source, "position", MAX_DISTANCE)
        noise = checked_noise(None, covariance, 3, source)
        mount = self._mount(frame)

        def measure(state: FilterState, _: Floats) -> Measurement:
            return measured_position(state, measured, noise, mount)

        reading = Reading(check_stamp(stamp), measure, is_position=True, gate=check_gate(gate))
        self._offer(_Event(source, reading, (*measured.tolist(), *noise.diagonal().tolist())))

    def set_pose(self, odom_from_base: Transform) -> None:
        """Place the base now: x, y, z and yaw of ``odom_from_base``, as of the newest event.

        Velocity in the axes of the base, roll and pitch, which gravity shows, and biases stay. The position
        and the yaw are then as uncertain as the covariance of the transform says, or certain. Late events
        from before do not change the place. By REP 105 a jump of ``odom`` is the user's alone, and readers
        that take differences of poses see it as a motion. Raises NoData before the alignment, and
        InvalidInput for other frames.
        """
        self._check_placement(odom_from_base)
        stamp = self.state().stamp
        self.placements += 1
        reading = Placement(stamp, odom_from_base.matrix, odom_from_base.covariance)
        self._insert(_Event("", reading, (self.placements,)))

    def _check_placement(self, odom_from_base: Transform) -> None:
        if (odom_from_base.target, odom_from_base.source) != (self.odom, self.base):
            raise InvalidInput(
                f"the base is placed by {self.odom!r} from {self.base!r}; got {odom_from_base.target!r} from "
                f"{odom_from_base.source!r}"
            )
        checked_vector(odom_from_base.translation, "set_pose", "position", MAX_DISTANCE)

    def imu(self, stamp: int, gyro: ArrayLike, accel: ArrayLike) -> None:
        """A sample of the IMU at ``stamp`` [ns]: rate [rad/s] and specific force [m/s^2] in its axes, (3,).

        Raises InvalidInput for other shapes, NaN and infinity, and for numbers that no IMU measures, above
        1e3 rad/s or 1e5 m/s^2.
        """
        rate = checked_vector(gyro, IMU, "gyro", MAX_RATE)
        force = checked_vector(accel, IMU, "accel", MAX_ACCELERATION)
        self._offer(_Event(IMU, Inertia(check_stamp(stamp), rate, force), (*rate.tolist(), *force.tolist())))

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
        axes: Sequence[str] = VELOCITY_AXES,
        gate: float = GATE_PROBABILITY,
    ) -> None:
        """The ``linear`` velocity of the origin of ``frame`` in its own axes at ``stamp``, x y z [m/s], (3,).

        ``source`` is the name of the sensor, under which ``health`` lists it. Its noise is given by
        ``sigma``, standard deviations (3,), or by ``covariance``, (3, 3). ``frame`` is the base by default.
        ``angular`` [rad/s] (3,) is used while the IMU is silent, and to know standstill. ``scale`` is the
        standard deviation of a constant relative error, as of a radius of wheels. ``axes`` are those that are
        measured, and ``gate`` the part of readings that pass if all sigmas are right. Raises InvalidInput,
        which names the source, for NaN, for what is no covariance, for more than 1e4 m/s or 1e3 rad/s, and
        for standard deviations outside of 1e-9 to 1e9; UnknownFrame for the frame.
        """
        vector = checked_vector(linear, source, "velocity", MAX_SPEED)
        rate = None if angular is None else checked_vector(angular, source, "angular velocity", MAX_RATE)
        rows = list(axis_rows("velocity", axes, VELOCITY_AXES))
        vector[[row for row in range(3) if row not in rows]] = 0.0
        noise = checked_noise(sigma, covariance, 3, source, rows)
        measured = WheelVelocity(vector, np.zeros(3) if rate is None else rate, noise)
        check_gate(gate)
        if not 0.0 <= scale <= MAX_SIGMA:
            raise InvalidInput(
                f"the scale of source {source!r} is a standard deviation of 0 to {MAX_SIGMA:g}; got {scale!r}"
            )
        stamp = check_stamp(stamp)
        self._mount(frame or self.base)  # raises here, where the mistake is made
        self._offer_reading(
            source,
            stamp,
            lambda base: base._insert_velocity(
                stamp,
                measured,
                frame,
                source,
                scale=scale,
                gate=gate,
                has_rate=rate is not None,
                rows=rows,
            ),
        )

    def joints(
        self,
        stamp: int,
        positions: Mapping[str, float],
        *,
        velocities: Mapping[str, float] | None = None,
        efforts: Mapping[str, float] | None = None,
    ) -> None:
        """The joints by name at ``stamp`` [ns]: positions [rad] or [m], for wheels and legs.

        Two readings of wheels are a displacement, whose mean velocity is fused at the middle of the interval;
        the delay of ``WheelNoise`` is subtracted from their stamps.
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
        wheels = self._wheels
        if wheels is not None:
            found = check_wheel_positions(wheels, positions)
            rolled = check_stamp(stamp - wheels.noise.delay_ns)
            self._offer_reading(WHEELS, rolled, lambda base: base._insert_rotations(wheels, rolled, found))
        if self._legs is not None:
            numbers = [float(positions.get(name, math.nan)) for name in self._legs.joint_names]
            steps = Steps(stamp, self._legs.feet(positions), velocities, efforts)
            if not all(map(math.isfinite, numbers)):
                raise InvalidInput(f"positions of legs must be finite; got {dict(positions)}")
            if not self._has_contacts:
                self._legs.check_detection(velocities, efforts)
            self._record(FEET).has_bounds = True
            self._offer(_Event(FEET, steps, numbers))

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
        self._offer(_Event(CONTACTS, Contacts(check_stamp(stamp), down), flags))

    def pose(
        self,
        stamp: int,
        odom_from_base: Transform,
        covariance: ArrayLike,
        *,
        source: str,
        axes: Sequence[str] = POSE_AXES,
        gate: float = GATE_PROBABILITY,
    ) -> None:
        """The pose of a frame on the robot in ``odom`` at ``stamp``, as of motion capture.

        ``odom_from_base`` is that pose, whose source is the base or another frame on it. ``covariance``
        (6, 6) has the order and axes of ``Transform.covariance``, and ``axes`` are those of them that are
        measured; ``gate`` is as in ``velocity``. Raises InvalidInput, which names the source, for another
        target than ``odom``, NaN, what is no covariance, more than 1e8 m, and standard deviations outside of
        1e-9 to 1e9; UnknownFrame for the frame.
        """
        if odom_from_base.target != self.odom:
            raise InvalidInput(
                f"poses of source {source!r} are in {odom_from_base.target!r}; they must be in {self.odom!r}"
            )
        checked_vector(odom_from_base.translation, source, "position", MAX_DISTANCE)
        mount = self._mount(odom_from_base.source)
        rows = list(axis_rows("pose", axes, POSE_AXES))
        noise = checked_noise(None, covariance, 6, source, rows)
        matrix = odom_from_base.matrix

        def measure(state: FilterState, _: Floats) -> Measurement:
            return pose(state, matrix, noise, mount, rows=rows)

        reading = Reading(check_stamp(stamp), measure, is_position=True, rows=rows, gate=check_gate(gate))
        numbers = (*odom_from_base.pose7.tolist(), *noise.diagonal().tolist())
        self._offer(_Event(source, reading, numbers), is_shared=False)

    def relative_pose(
        self,
        stamp: int,
        world_from_frame: Transform,
        covariance: ArrayLike | None = None,
        *,
        source: str,
        noise: RelativeNoise | None = None,
    ) -> None:
        """A pose of another odometry at ``stamp``, as of visual or lidar odometry, in a world of its own.

        The displacement since its last one is used, with a constant scale, which is estimated. The target of
        ``world_from_frame`` is any frame, its source one on the robot. ``covariance`` (6, 6), of
        ``Transform.covariance``, is used if ``noise`` asks for it, and if it is one: zeros are none. A
        displacement that the other sources contradict is rejected, and so a jump does no harm.
        Raises InvalidInput, which names the source, for NaN and more than 1e8 m; UnknownFrame for the frame.
        """
        checked_vector(world_from_frame.translation, source, "position", MAX_DISTANCE)
        mount, matrix = self._mount(world_from_frame.source), world_from_frame.matrix
        known = (
            None if covariance is None else real_numbers(covariance, f"the covariance of source {source!r}")
        )
        if known is not None and (known.shape != (6, 6) or not np.isfinite(known).all()):
            raise InvalidInput(f"the covariance of source {source!r} is finite, (6, 6); got {known.tolist()}")
        world = world_from_frame.target
        self._record(source).has_bounds = True
        reading = RelativePose(check_stamp(stamp), world, matrix, known, noise or RelativeNoise(), mount)
        variances: list[float] = [] if known is None else known.diagonal().tolist()
        self._offer(_Event(source, reading, (*world_from_frame.pose7.tolist(), *variances)))

    def heading(
        self,
        stamp: int,
        yaw: float,
        sigma: float,
        *,
        source: str,
        frame: str | None = None,
        gate: float = GATE_PROBABILITY,
    ) -> None:
        """The yaw of ``frame``, by default the base, at ``stamp`` [rad], with a standard deviation.

        It is relative to the first one of this source, because the odometry frame has no north. ``sigma`` is
        that of errors that do not average out: the yaw will not be known better by it. See
        ``zstate.odometry.fusion``. A heading while the axis is within 6 degrees of the vertical, where it has
        none, is rejected. ``gate`` is as in ``velocity``. Raises InvalidInput, which names the source, for
        NaN and a sigma outside of 1e-9 to 1e9.
        """
        mount = self._mount(frame or self.base)
        if not (abs(yaw) <= _LARGEST_YAW and MIN_SIGMA <= sigma <= MAX_SIGMA):
            raise InvalidInput(
                f"a heading of source {source!r} is at most {_LARGEST_YAW:g} rad, with a sigma of "
                f"{MIN_SIGMA:g} to {MAX_SIGMA:g} rad; got yaw={yaw!r}, sigma={sigma!r}"
            )
        axis = mount[:3, 0]
        reading = Heading(check_stamp(stamp), float(yaw), float(sigma) ** 2, axis, check_gate(gate))
        self._offer(_Event(source, reading, (yaw, sigma)))

    def height(
        self,
        stamp: int,
        height: float,
        sigma: float,
        *,
        source: str,
        frame: str | None = None,
        wander: float = 0.0,
        correlated_s: float = 300.0,
        gate: float = GATE_PROBABILITY,
    ) -> None:
        """The height of ``frame``, by default the base, at ``stamp`` [m], above any level, up positive.

        It is relative to the first one of this source, as the odometry frame has no sea level. ``sigma`` [m]
        is the standard deviation of each reading, ``wander`` [m] that of an error besides that changes over
        ``correlated_s`` [s], as by weather. The height will not be known better by it than both together
        allow, and nothing but the height is corrected. ``gate`` is as in ``velocity``. Raises InvalidInput,
        which names the source, for NaN, more than 1e8 m, a sigma outside of 1e-9 to 1e9, a wander outside of
        0 to 1e9, and a time that is not above zero.
        """
        mount = self._mount(frame or self.base)
        is_known = abs(height) <= MAX_DISTANCE and MIN_SIGMA <= sigma <= MAX_SIGMA
        if not (is_known and 0.0 <= wander <= MAX_SIGMA and 0.0 < correlated_s < math.inf):
            raise InvalidInput(
                f"a height of source {source!r} is at most {MAX_DISTANCE:g} m, with a sigma of {MIN_SIGMA:g} "
                f"to {MAX_SIGMA:g} m and a wander of 0 to {MAX_SIGMA:g} m in a time above zero; got "
                f"height={height!r}, sigma={sigma!r}, wander={wander!r}, correlated_s={correlated_s!r}"
            )
        numbers = float(height), float(sigma) ** 2, float(wander) ** 2, float(correlated_s)
        self._record(source).has_bounds = True
        self._offer(_Event(source, Height(check_stamp(stamp), *numbers, mount, check_gate(gate)), numbers))

    def magnetic_field(
        self,
        stamp: int,
        field: ArrayLike,
        sigma: float,
        *,
        source: str,
        frame: str | None = None,
        expected: EarthField | None = None,
        gate: float = GATE_PROBABILITY,
    ) -> None:
        """The magnetic ``field`` in the axes of ``frame`` at ``stamp``, x y z [T], (3,), which gives a yaw.

        ``frame`` is the base by default. ``source`` is the name of the sensor in ``health``, ``gate`` is as
        in ``velocity``. ``sigma`` [rad] is that of the yaw, which is levelled by the attitude at that stamp,
        and is used as that of a ``heading``. A field is rejected, with a sentence in ``health``, if its
        strength differs by more than 10 %, or its dip by more than 5 degrees, from the mean of ten readings
        in a row at the start, or from the field of the Earth that is ``expected``. Raises InvalidInput, which
        names the source, for NaN, for less than 1e-6 or more than 1e-3 T, and for a sigma outside of 1e-9 to
        1e9.
        """
        vector = checked_vector(field, source, "magnetic field", MAX_FIELD)
        check_strength(math.sqrt(vector @ vector), source)
        if not MIN_SIGMA <= sigma <= MAX_SIGMA:
            raise InvalidInput(
                f"the yaw by a field of source {source!r} has a sigma of {MIN_SIGMA:g} to {MAX_SIGMA:g} rad; "
                f"got {sigma!r}"
            )
        vector, ahead = self._mount(frame or self.base)[:3, :3].dot(vector), self._imu_from_base[:3, 0]
        reading = Field(check_stamp(stamp), vector, float(sigma) ** 2, ahead, expected, check_gate(gate))
        self._record(source).has_bounds = True
        self._offer(_Event(source, reading, (*vector.tolist(), sigma)))

    @property
    def clock(self) -> Clock:
        """The clock of the buffer of the mounts. The estimator does not read it."""
        return self._buffer.clock

    @property
    def newest(self) -> int:
        """The newest stamp of all events [ns]; readings of another time are not among them. 0 without any."""
        return self._order.newest or 0

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
        return self._state_of(self._predicted(self._estimate_before(place), stamp, self._following(place))[0])

    def health(self) -> tuple[SourceHealth, ...]:
        """The health of each source, by name; standstill is one as soon as it is found."""
        self._fuse()
        newest = self._order.newest or 0
        recent: dict[str, list[Outcome]] = {name: [] for name in self._sources}
        for event in self._log[: self._fused]:
            if event.outcome is not None:
                recent[_outcome_source(event)].append(event.outcome)
        last = self._estimate_before(self._fused) if self._start is not None else None
        return tuple(
            record.health(
                name,
                newest,
                recent[name],
                self._remarks(name, last, newest),
                history_s=self.history_s,
                leader=self._order.leader,
            )
            for name, record in sorted(self._sources.items())
        )

    def _remarks(self, name: str, last: Estimate | None, newest: int) -> str:
        at, restart = self._restarts.get(name, (0, ""))
        told = restart if newest - at < _RESTART_TOLD_NS else ""
        remark = self._remark(name, self._sources[name], last, newest)
        return "; ".join(text for text in (told, remark) if text)

    def _remark(self, name: str, record: SourceRecord, last: Estimate | None, newest: int) -> str:
        """What the fusion has to say of a source."""
        found = list[str]()
        if name == IMU and record.stamps and newest - max(record.stamps) > SILENCE_NS:
            found.append(
                "silent; the base is predicted from its last velocity and its wheels, with large noise"
            )
        if last is None:
            if name == IMU and self._log and newest - self._log[0].reading.stamp > _ALIGNED_NS:
                found.append(f"the base is not aligned: {self._missing}")
            return "; ".join(found)
        if name == IMU:
            found += imu_remarks(last)
        run = last.runs.get(name)
        if run is not None and run.stamp - run.start > LOST_NS and newest - run.stamp < LOST_NS:
            found.append(
                f"rejected for {(run.stamp - run.start) * 1e-9:.1f} s in a row: the estimate is lost, unless "
                "another source confirms it"
            )
        found += lead_remarks(last, name)
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

    def _record(self, source: str) -> SourceRecord:
        if source not in self._sources:
            if len(self._sources) >= _MOST_SOURCES:
                raise InvalidInput(
                    f"an estimator takes {_MOST_SOURCES} sources; {source!r} is one more. Give the readings "
                    "of one sensor one name"
                )
            self._sources[source] = SourceRecord()
        return self._sources[source]

    def _offer(self, event: _Event, *, is_shared: bool = True) -> None:
        self._offer_reading(
            event.source,
            event.reading.stamp,
            lambda base: base._insert(event if base is self else copy(event)),
            is_shared=is_shared,
        )

    def _offer_reading(
        self, source: str, stamp: int, insert: Callable[[BaseEstimator], None], *, is_shared: bool = True
    ) -> None:
        """Insert a reading, here and in the follower, unless it is of another time than the present."""
        self._offer_here(source, stamp, partial(insert, self))
        if self._follower is not None and is_shared:
            self._follower._offer_reading(source, stamp, insert)

    def _offer_here(self, source: str, stamp: int, insert: Callable[[], None]) -> None:
        record, newest = self._record(source), self._order.newest
        place = self._order.place(source, stamp)
        if place == "present" or newest is None:
            insert()
            return
        if place == "late":
            record.too_late += 1
            record.late_ns = newest - stamp
        else:
            record.ahead += 1
            record.ahead_ns = stamp - newest
        jump = self._order.hold(Held(source, stamp, insert), place)
        if jump is None:
            return
        if jump.is_back:
            self._begin_epoch(source, jump.size_ns)
        for held in jump.held:
            one = self._record(held.source)
            one.ahead = 0
            if self._order.place(held.source, held.stamp) == "present":
                held.insert()

    def _begin_epoch(self, source: str, size_ns: int) -> None:
        order = self._order
        self._begin()
        self._order = order
        self.epoch += 1
        text = f"time went back by {format_duration(size_ns)}; the odometry restarted"
        self._record(source)
        self._restarts = {source: (order.newest or 0, text)}

    def _insert_rotations(self, wheels: Wheels, stamp: int, found: dict[str, float]) -> None:
        """Insert the displacements from the reading before and to that after, instead of that between."""
        place = bisect_left(self._rotations, stamp, key=lambda entry: entry[0])
        if place < len(self._rotations) and self._rotations[place][0] == stamp:
            return  # the same reading again, as after a reconnection
        before = self._rotations[place - 1] if place else None
        after = self._rotations[place] if place < len(self._rotations) else None
        self._rotations.insert(place, (stamp, found))
        if before and after:
            self._remove(WHEELS, _displacement_stamp(before[0], after[0]))
        for first, second in ((before, (stamp, found)), ((stamp, found), after)):
            if first and second:
                self._insert_displacement(wheels, first, second)
        self._record(WHEELS).has_bounds = True

    def _insert_displacement(
        self, wheels: Wheels, first: tuple[int, dict[str, float]], second: tuple[int, dict[str, float]]
    ) -> None:
        stamp, seconds = _displacement_stamp(first[0], second[0]), (second[0] - first[0]) * 1e-9
        if self._order.is_late(stamp):
            return
        measured = wheels.velocity(first[1], second[1], seconds)
        if stamp == second[0]:
            mount = self._mount(wheels.frame or self.base)
            way, turn = displacement(measured, seconds)
            reading = Displacement(stamp, first[0], way, turn, mount)
            self._insert(_Event(WHEELS, reading, (*way.tolist(), turn)))
        else:
            noise = wheels.noise
            self._insert_velocity(
                stamp, measured, wheels.frame, WHEELS, scale=noise.scale, gate=noise.gate, has_rate=True
            )

    def _insert_velocity(
        self,
        stamp: int,
        measured: WheelVelocity,
        frame: str | None,
        source: str,
        *,
        scale: float,
        gate: float,
        has_rate: bool,
        rows: Rows = ALL_ROWS,
    ) -> None:
        """Insert a velocity, whose covariance is that of ``rows`` of it."""
        linear, angular, noise = measured
        mount = self._mount(frame or self.base)
        rate = angular if has_rate else None

        def measure(state: FilterState, gyro: Floats) -> Measurement:
            return body_velocity(state, linear, noise, mount, gyro, rows=rows)

        reading = Reading(
            stamp,
            measure,
            is_still(linear, rate),
            None if rate is None else mount[:3, :3] @ rate,
            scale=scale,
            upright=mount[:3, 2],
            speed=math.sqrt(linear @ linear),
            gate=gate,
        )
        numbers = (*linear.tolist(), *angular.tolist(), *noise.diagonal().tolist())
        self._insert(_Event(source, reading, numbers))

    def _insert(self, event: _Event) -> None:
        """Insert an event of the present, unless the same one is there."""
        if not self._log or event.key > self._log[-1].key:
            place = len(self._log)
        else:
            place = bisect_left(self._log, event.key, key=_key)
            if self._log[place].key == event.key:
                return  # the same event again, as after a reconnection
        if len(self._log) >= self._most_events:
            raise InvalidInput(
                f"{len(self._log)} events in the {self.history_s:g} s of history_s are too many; "
                f"source {event.source!r} has one more"
            )
        self._log.insert(place, event)
        if event.source:
            self._record(event.source).stamps.append(event.reading.stamp)
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
        with np.errstate(all="ignore"):  # what is not finite is found below
            for place in range(self._fused, len(self._log)):
                event = self._log[place]
                estimate, event.outcome = self._after(estimate, event, place)
                event.estimate = estimate
        self._fused = len(self._log)
        self._prune()

    def _after(self, estimate: Estimate, event: _Event, place: int) -> tuple[Estimate, Outcome | None]:
        """The estimate after an event, and its outcome: rejected if it cannot be used."""
        if event.reading.stamp < estimate.stamp:  # before the first estimate
            return estimate, None
        try:
            after, outcome = self._fused_with(estimate, event, self._following(place))
        except InvalidInput as error:
            failure = str(error)
        except Exception as error:  # one event must not stop the odometry, whatever it is
            failure = f"{type(error).__name__}: {error}"
        else:
            if is_finite(after.state):
                return after, outcome
            failure = "the estimate would not be finite with it"
        kept, is_restarted = self._predicted(estimate, event.reading.stamp, self._following(place))
        if is_restarted:
            failure = "the estimate was not finite any more; it started again from its last pose"
        return kept if is_restarted else estimate, Outcome("rejected", math.nan, 0, failure)

    def _predicted(self, before: Estimate, stamp: int, following: Inertia | None) -> tuple[Estimate, bool]:
        """The estimate at ``stamp``; if it is not finite, one that starts from the last pose, and True."""
        try:
            with np.errstate(all="ignore"):
                estimate = self._fusion.predicted(before, stamp, following)
        except (ArithmeticError, ValueError):
            pass
        else:
            if is_finite(estimate.state):
                return estimate, False
        last = last_pose(before, self._imu_from_base, self.odom, self.base)
        return start_at(stamp, last, self._imu_from_base), True

    def _fused_with(
        self, estimate: Estimate, event: _Event, following: Inertia | None
    ) -> tuple[Estimate, Outcome | None]:
        reading, fusion, outcome = event.reading, self._fusion, None
        match reading:
            case Inertia():
                after, outcome = fusion.after_inertia(estimate, reading)
                if outcome is not None:
                    self._count_standstill(reading.stamp)
            case Contacts():
                after = fusion.predicted(estimate, reading.stamp, following)
                after = after._replace(touching=reading.touching)
            case Placement():
                after = fusion.settled(fusion.predicted(estimate, reading.stamp, following))
                after = placed(after, reading, self._imu_from_base)
            case Steps():
                assert self._legs is not None
                after, outcome = fusion.after_steps(self._legs, estimate, reading, following)
            case Displacement():
                after, outcome = fusion.after_pause(estimate, reading, following)
            case RelativePose():
                after, outcome = fusion.after_relative(estimate, event.source, reading, following)
            case Heading():
                after, outcome = fusion.after_heading(estimate, event.source, reading, following)
            case Height():
                after, outcome = fusion.after_height(estimate, event.source, reading, following)
            case Field():
                after, outcome = fusion.after_field(estimate, event.source, reading, following)
            case Reading():
                after, outcome = fusion.after_reading(estimate, event.source, reading, following)
        return after, outcome

    def _count_standstill(self, stamp: int) -> None:
        record = self._sources.setdefault(STANDSTILL, SourceRecord())
        record.has_bounds = True
        if not record.stamps or stamp > record.stamps[-1]:  # else it is replayed
            record.stamps.append(stamp)

    def _align(self) -> None:
        if self._initial_pose is not None and self._log:
            self._start = start_at(self._log[0].reading.stamp, self._initial_pose, self._imu_from_base)
            self._alignment_end = 1
            return
        samples = [event.reading for event in self._log if isinstance(event.reading, Inertia)]
        readings = [event.reading for event in self._log if isinstance(event.reading, Reading)]
        turns = [(one.stamp, one.angular) for one in readings if one.angular is not None]
        outcome = align(samples, turns, self._imu_from_base)
        if isinstance(outcome, Alignment):
            self._start = outcome.estimate
            self._alignment_end = bisect_right(self._log, outcome.end, key=lambda event: event.reading.stamp)
        else:
            self._missing = outcome
            # Wheels and poses are of no use before; of the IMU, the last seconds are.
            self._forget(self._older_than(self._history_ns if not samples else self._unaligned_ns))

    def _prune(self) -> None:
        """Forget events that are too old, but for the estimate after the last of them."""
        count = self._older_than(self._history_ns)
        if count < _PRUNED_AT_ONCE:
            return
        self._start = self._estimate_before(count)
        self._is_settled = True
        for event in self._log[:count]:
            if event.outcome is not None:
                self._sources[_outcome_source(event)].keep(event.outcome)
        self._forget(count)

    def _older_than(self, age_ns: int) -> int:
        """How many events of the log are older than the newest one by more than ``age_ns``."""
        oldest = (self._order.newest or 0) - age_ns
        return bisect_left(self._log, oldest, key=lambda event: event.reading.stamp)

    def _forget(self, count: int) -> None:
        del self._log[:count]
        self._fused = max(0, self._fused - count)
        oldest = (self._order.newest or 0) - self._history_ns
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
        matrix, pose_covariance = frame_pose(settled.state, self._imu_from_base)
        pose_covariance[:2, :2] += yaw_curvature(pose_covariance)
        if self._is_continuous:
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


def _displacement_stamp(first: int, second: int) -> int:
    """That of a displacement between two readings: their middle, as of a mean velocity, but for a pause."""
    return (first + second) // 2 if second - first <= COAST_NS else second


def _outcome_source(event: _Event) -> str:
    """The source of an outcome. A sample of the IMU has none of its own, unless it could not be used."""
    is_standstill = isinstance(event.reading, Inertia) and event.outcome and not event.outcome.failure
    return STANDSTILL if is_standstill else event.source
