"""A base on two wheels without hardware: its wheels, its IMU, and where it truly is, in steps of 1 ms.

Both wheels follow their setpoints with a time constant of 50 ms. The floor is level, and no wheel moves along
its axle. On the ground a wheel makes the part ``1 - slip`` of its way: the slip of each wheel is a
first-order Gauss-Markov process with a time constant of 0.5 s. At (x, y) in the axes of a base with the speed
v along x and the yaw rate w, an IMU has the acceleration of a point of a rigid body,

    (dv/dt - w^2 x - dw/dt y,  v w + dw/dt x - w^2 y).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from random import Random
from typing import Literal, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.fork_safe import fork_safe_lock
from zstate.checks import Floats
from zstate.errors import InvalidInput
from zstate.odometry.invariant_filter import ImuNoise
from zstate.sources import JointReading
from zstate.sources.square_drive import SquareDriveState, WheelPair
from zstate.transform import Transform

WheelRates: TypeAlias = tuple[float, float]
"""The rates of the left and the right wheel [rad/s]."""

_STEP_NS = 1_000_000
_STEP_S = 1e-9 * _STEP_NS
_HISTORY_NS = 2_000_000_000
_LONGEST_NS = 10_000_000_000
"""What is simulated at most at once: after a longer pause the rover stands where it was."""

_IMU_NS = 5_000_000
"""The period of the IMU, which has its own clock: a late reader finds all readings, none of them longer."""

_MOTOR_S, _SLIP_S = 0.05, 0.5
"""Time constants of the wheels and of their slip."""

_GRAVITY = 9.80665

# Gains of tracking_twist: along the path [1/s], across it [1/m^2], of the heading [1/m].
_ALONG, _ACROSS, _HEADING = 1.0, 4.0, 3.0


class PlanarPose(NamedTuple):
    """x, y [m] and yaw [rad], which counts full turns, in the frame in which the rover started."""

    x: float
    y: float
    yaw: float


class ImuReading(NamedTuple):
    """Angular velocity [rad/s] and specific force [m/s^2], (3,), in the axes of the IMU.

    They are the means of 5 ms, whose middle is ``stamp`` [ns].
    """

    stamp: int
    gyro: Floats
    accel: Floats


class SimulatedRover:
    """A base on two driven wheels, which starts at the identity, at rest, at the first ``advance``.

    ``wheels`` are their radius and their distance. ``base_from_imu`` is the mount of the IMU on the base,
    whose origin is below the middle of the axle. ``slip`` is the standard deviation of the slip of each
    wheel; ``noise`` that of the IMU, whose biases start at ``gyro_bias`` [rad/s] and ``accel_bias`` [m/s^2].
    A function of ``seed``, of the setpoints and of the stamps alone. Raises InvalidInput for a negative slip.
    Safe from any thread.
    """

    def __init__(
        self,
        wheels: WheelPair,
        base_from_imu: Transform,
        noise: ImuNoise,
        *,
        slip: float = 0.0,
        gyro_bias: ArrayLike = (0.0, 0.0, 0.0),
        accel_bias: ArrayLike = (0.0, 0.0, 0.0),
        seed: int = 0,
    ) -> None:
        if not 0.0 <= slip < 1.0:
            raise InvalidInput(f"slip is a standard deviation from 0 to 1, not {slip!r}")
        self._wheels = wheels
        self._imu = _Imu(base_from_imu, noise, gyro_bias, accel_bias, seed)
        self._slip = slip
        self._random = Random(seed)
        self._slips = [0.0, 0.0]
        self._targets = [0.0, 0.0]
        self._rates = [0.0, 0.0]
        self._angles = [0.0, 0.0]
        self._speed = self._yaw_rate = 0.0
        self._stamp: int | None = None
        self._poses: deque[PlanarPose] = deque([PlanarPose(0.0, 0.0, 0.0)], _HISTORY_NS // _STEP_NS + 1)
        """Those of the newest instants, the last one at ``_stamp``."""
        self._lock = fork_safe_lock()

    @property
    def pose(self) -> PlanarPose:
        """Where the rover truly is, at the last instant."""
        return self._poses[-1]

    def drive(self, rates: WheelRates) -> None:
        """The rates that the wheels shall have from now on. Raises InvalidInput unless finite."""
        if not all(map(math.isfinite, rates)):
            raise InvalidInput(f"rates of wheels are finite [rad/s], not {rates!r}")
        with self._lock:
            self._targets = list(rates)

    def advance(self, stamp: int) -> int:
        """Simulate all steps until ``stamp`` [ns], an earlier one none; returns the instant of the last."""
        with self._lock:
            return self._advance(stamp)

    def joints(self, stamp: int) -> JointReading:
        """Positions and velocities of the left and the right wheel at the last step before ``stamp`` [ns]."""
        with self._lock:
            last = self._advance(stamp)
            return JointReading(np.array(self._angles), np.array(self._rates), stamp=last)

    def imu(self, stamp: int) -> list[ImuReading]:
        """The readings of the IMU until ``stamp`` [ns] since the last call, of 2 s at most."""
        with self._lock:
            self._advance(stamp)
            return self._imu.unread()

    def has_poses_since(self, stamp: int) -> bool:
        """Whether ``poses`` are known from ``stamp`` [ns] on: it is neither too old nor before a pause."""
        with self._lock:
            return self._stamp is not None and self._stamp - (len(self._poses) - 1) * _STEP_NS <= stamp

    def poses(self, stamps: ArrayLike) -> Floats:
        """Where the rover truly was at ``stamps`` [ns], (N,) of the last 2 s: (N, 3), x y [m], yaw [rad].

        Raises InvalidInput for stamps that are older, before a pause, or later than the last step.
        """
        instants = np.asarray(stamps, dtype=np.int64)
        with self._lock:
            if self._stamp is None:
                raise InvalidInput("the rover has no pose before the first advance")
            newest, known = self._stamp, np.array(self._poses)
        steps = (instants - newest) / _STEP_NS + len(known) - 1
        if not ((steps >= 0.0) & (steps <= len(known) - 1)).all():
            raise InvalidInput(
                f"the rover has poses of the {(len(known) - 1) * _STEP_S:.3g} s until {newest}, and none for "
                f"stamps from {instants.min()} to {instants.max()}"
            )
        columns = [np.interp(steps, np.arange(len(known)), known[:, column]) for column in range(3)]
        return np.stack(columns, axis=1)

    def _advance(self, stamp: int) -> int:
        """Simulate until ``stamp``, and return the instant of the last step; with the lock."""
        if self._stamp is None:
            self._stamp = stamp
        if stamp - self._stamp > _LONGEST_NS:
            self._stamp = stamp
            self._poses = deque([self.pose], self._poses.maxlen)
            self._rates = [0.0, 0.0]
            self._speed = self._yaw_rate = 0.0
            self._imu.skip()
        while self._stamp + _STEP_NS <= stamp:
            self._stamp += _STEP_NS
            self._step(self._stamp)
        return self._stamp

    def _step(self, stamp: int) -> None:
        fade = math.exp(-_STEP_S / _SLIP_S)
        scatter = self._slip * math.sqrt(1.0 - fade * fade)
        ways: list[float] = []
        for side in range(2):
            self._rates[side] += (self._targets[side] - self._rates[side]) * -math.expm1(-_STEP_S / _MOTOR_S)
            self._angles[side] += self._rates[side] * _STEP_S
            self._slips[side] = fade * self._slips[side] + self._random.gauss(0.0, scatter)
            ways.append((1.0 - self._slips[side]) * self._rates[side] * self._wheels.radius_m)
        left, right = ways
        speed, yaw_rate = 0.5 * (left + right), (right - left) / self._wheels.track_m
        self._imu.add(
            stamp,
            0.5 * (self._speed + speed),
            0.5 * (self._yaw_rate + yaw_rate),
            (speed - self._speed) / _STEP_S,
            (yaw_rate - self._yaw_rate) / _STEP_S,
        )
        mean_speed, turn = 0.5 * (self._speed + speed), 0.5 * (self._yaw_rate + yaw_rate) * _STEP_S
        x, y, yaw = self.pose
        heading = yaw + 0.5 * turn
        self._poses.append(
            PlanarPose(
                x + mean_speed * _STEP_S * math.cos(heading),
                y + mean_speed * _STEP_S * math.sin(heading),
                yaw + turn,
            )
        )
        self._speed, self._yaw_rate = speed, yaw_rate


class _Imu:
    """Means of the motion over periods of 5 ms, with white noise and biases that walk at random."""

    def __init__(
        self,
        base_from_imu: Transform,
        noise: ImuNoise,
        gyro_bias: ArrayLike,
        accel_bias: ArrayLike,
        seed: int,
    ) -> None:
        self._x, self._y, _ = base_from_imu.translation.tolist()
        self._imu_from_base = base_from_imu.matrix[:3, :3].T
        self._noise = noise
        self._biases = np.array([gyro_bias, accel_bias], dtype=np.float64)
        self._random = np.random.default_rng(seed)
        self._readings: deque[ImuReading] = deque(maxlen=_HISTORY_NS // _IMU_NS)
        self.skip()

    def skip(self) -> None:
        """Begin a new period."""
        self._count = 0
        self._turned = self._ahead = self._left = 0.0

    def unread(self) -> list[ImuReading]:
        """The readings since the last call."""
        readings = list(self._readings)
        self._readings.clear()
        return readings

    def add(self, stamp: int, speed: float, yaw_rate: float, acceleration: float, turning: float) -> None:
        """A step of the motion of the base until ``stamp`` [ns]; accelerations in [m/s^2] and [rad/s^2]."""
        self._count += 1
        self._turned += yaw_rate
        self._ahead += acceleration - yaw_rate**2 * self._x - turning * self._y
        self._left += speed * yaw_rate + turning * self._x - yaw_rate**2 * self._y
        if self._count * _STEP_NS == _IMU_NS:
            self._readings.append(self._read(stamp - _IMU_NS // 2))
            self.skip()

    def _read(self, middle: int) -> ImuReading:
        dt_s = 1e-9 * _IMU_NS
        motion = (
            np.array([(0.0, 0.0, self._turned), (self._ahead, self._left, _GRAVITY * self._count)])
            / self._count
        )
        noise = self._noise
        walk = np.array([[noise.gyro_bias], [noise.accel_bias]]) * math.sqrt(dt_s)
        white = np.array([[noise.gyro], [noise.accel]]) / math.sqrt(dt_s)
        self._biases += walk * self._random.standard_normal((2, 3))
        gyro, accel = (
            motion @ self._imu_from_base.T + self._biases + white * self._random.standard_normal((2, 3))
        )
        return ImuReading(middle, gyro, accel)


class _Setpoint(Protocol):
    """What ``zstate.driving.Setpoint`` has in the mode velocity."""

    @property
    def velocities(self) -> Floats: ...


class SimulatedWheels:
    """The ``zstate.driving.Driver`` of the wheels of ``rover``, in the mode velocity.

    ``joint_names`` are the left and the right wheel. Until it is first enabled or stopped the rover has the
    rates that ``idle(stamp)`` returns; by default it stands still.
    """

    modes: frozenset[Literal["position", "velocity", "effort"]] = frozenset({"velocity"})

    def __init__(
        self,
        rover: SimulatedRover,
        joint_names: Sequence[str],
        idle: Callable[[int], WheelRates] | None = None,
    ) -> None:
        left, right = joint_names
        self.joint_names = left, right
        self._rover = rover
        self._idle = idle
        self._is_enabled = False

    def open(self) -> None:
        """Does nothing."""

    def enable(self, on: bool) -> None:
        """Switch the motors on, or off."""
        self._is_enabled = on
        self.stop("hold" if on else "relax")

    def read(self, stamp: int) -> JointReading:
        """The wheels at the last step before ``stamp`` [ns]."""
        if self._idle is not None:
            self._rover.drive(self._idle(stamp))
        return self._rover.joints(stamp)

    def write(self, setpoint: _Setpoint) -> None:
        """The rates of both wheels. Raises InvalidInput while they are off."""
        if not self._is_enabled:
            raise InvalidInput("setpoints are written to joints that are enabled; call enable(True) first")
        left, right = setpoint.velocities.tolist()
        self._rover.drive((left, right))

    def stop(self, how: Literal["hold", "relax"]) -> None:
        """Let the wheels come to rest."""
        self._idle = None
        self._rover.drive((0.0, 0.0))

    def close(self) -> None:
        """Switch the motors off."""
        self.enable(False)


def tracking_twist(goal: SquareDriveState, pose: PlanarPose) -> tuple[float, float]:
    """The speed [m/s] and the yaw rate [rad/s] with which a base at ``pose`` approaches the moving ``goal``.

    The controller of Kanayama et al. ("A stable tracking control method for an autonomous mobile robot",
    ICRA 1990).
    """
    x, y, yaw = pose
    cosine, sine = math.cos(yaw), math.sin(yaw)
    along = cosine * (goal.x - x) + sine * (goal.y - y)
    across = cosine * (goal.y - y) - sine * (goal.x - x)
    turn = math.remainder(goal.yaw - yaw, math.tau)
    speed = goal.speed * math.cos(turn) + _ALONG * along
    yaw_rate = goal.yaw_rate + goal.speed * (_ACROSS * across + _HEADING * math.sin(turn))
    return speed, yaw_rate
