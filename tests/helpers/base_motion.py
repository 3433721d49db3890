"""A body that moves through space without end, and what ideal and noisy sensors on it measure."""

import math
from dataclasses import dataclass, field

import numpy as np

from zstate import Transform
from zstate.buffer.buffer import TransformBuffer
from zstate.odometry import ImuNoise
from zstate.odometry.invariant_filter import GRAVITY, Floats

NOISE = ImuNoise(gyro=1e-3, accel=2e-2, gyro_bias=2e-5, accel_bias=1e-3, gyro_scale=0.0, gyro_bias_shift=0.0)
START = 1_000_000_000_000
IMU_HZ, WHEEL_HZ = 200, 50


def stamp_at(t: float) -> int:
    return START + round(t * 1e9)


@dataclass
class Motion:
    """Sums of sines for x y z [m] and roll pitch yaw [rad], drawn from ``seed``; ``tilt`` is their amplitude.

    The speed grows from zero within the first ``rest_s`` + 1 seconds: the time runs slower there.
    """

    seed: int
    tilt: float = 0.4
    rest_s: float = 1.0
    sines: Floats = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng(self.seed)
        self.sines = random.uniform((0.5, 0.3, 0.0), (1.5, 0.9, math.tau), (6, 3))
        self.sines[2, 0] *= 0.3
        self.sines[3:5, 0] *= self.tilt
        self.sines[5] *= 1.5, 0.5, 1.0

    def _warped(self, t: Floats) -> Floats:
        """The time of the sines: zero until ``rest_s``, then with a velocity that rises smoothly to 1."""
        u = np.clip(t - self.rest_s, 0.0, 1.0)
        # The integral of 10 u^3 - 15 u^4 + 6 u^5, whose end is 1/2.
        ramp = 2.5 * u**4 - 3.0 * u**5 + u**6
        return ramp + np.maximum(t - self.rest_s - 1.0, 0.0)

    def coordinates(self, t: Floats) -> Floats:
        """x y z roll pitch yaw from those at the start, roll and pitch level: (T, 6)."""
        size, rate, phase = self.sines.T
        s = self._warped(np.asarray(t))[:, None]
        return size * (np.sin(rate * s + phase) - np.sin(phase))

    def rotation(self, t: Floats) -> Floats:
        """world_from_base: (T, 3, 3)."""
        angles = self.coordinates(t)[:, 3:].T
        (sr, sp, sy), (cr, cp, cy) = np.sin(angles), np.cos(angles)
        rows = (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
        return np.moveaxis(np.array(rows), 2, 0)

    def truth(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        """world_from_base, velocity and position in the world."""
        h = 1e-4
        velocity = (self.coordinates(t + h) - self.coordinates(t - h))[:, :3] / (2 * h)
        return self.rotation(t), velocity, self.coordinates(t)[:, :3]

    def rates(self, t: Floats) -> Floats:
        """The angular velocity in the axes of the base: (T, 3)."""
        h = 1e-4
        turn = (self.rotation(t + h) - self.rotation(t - h)) / (2 * h)
        skew = np.swapaxes(self.rotation(t), 1, 2) @ turn
        return np.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), axis=1)

    def imu(self, t: Floats, base_from_imu: Transform) -> tuple[Floats, Floats]:
        """Rate and specific force of an ideal IMU in its axes, (T, 3) each."""
        mount = base_from_imu.matrix
        h = 1e-3
        points = [self.coordinates(u)[:, :3] + self.rotation(u) @ mount[:3, 3] for u in (t - h, t, t + h)]
        acceleration = (points[0] - 2 * points[1] + points[2]) / (h * h)
        force = np.einsum("tji,tj->ti", self.rotation(t), acceleration - GRAVITY)
        return self.rates(t) @ mount[:3, :3], force @ mount[:3, :3]

    def velocity(self, t: Floats) -> Floats:
        """The velocity of the base in its own axes: (T, 3)."""
        rotation, velocity, _ = self.truth(t)
        return np.einsum("tji,tj->ti", rotation, velocity)


@dataclass
class NoisyImu:
    """The samples of an IMU with ``noise`` on a ``motion``, with biases drawn from the same generator."""

    motion: Motion
    base_from_imu: Transform
    seconds: float
    random: np.random.Generator
    noise: ImuNoise = NOISE
    bias_sigmas: tuple[float, float] = (0.01, 0.05)

    def samples(self) -> tuple[Floats, Floats, Floats]:
        """Times [s], rates and forces."""
        t = np.arange(0.0, self.seconds, 1.0 / IMU_HZ)
        gyro, accel = self.motion.imu(t, self.base_from_imu)
        measured: list[Floats] = []
        for ideal, white, walk, first in (
            (gyro, self.noise.gyro, self.noise.gyro_bias, self.bias_sigmas[0]),
            (accel, self.noise.accel, self.noise.accel_bias, self.bias_sigmas[1]),
        ):
            steps = self.random.normal(0.0, walk / math.sqrt(IMU_HZ), ideal.shape)
            bias = self.random.normal(0.0, first, 3) + np.cumsum(steps, axis=0)
            measured.append(ideal + bias + self.random.normal(0.0, white * math.sqrt(IMU_HZ), ideal.shape))
        return t, measured[0], measured[1]


@dataclass
class RoughDrive:
    """A drive on the floor with all that recordings have and data sheets have not, from its ``seed``.

    It begins in motion. The IMU is on its side, at about 50 Hz, with jitter, gaps, vibration, a bias of the
    gyro and scales that are wrong by 1 %. Wheels have encoders of 1000 steps at 10 Hz, a radius and a track
    that are wrong by 2 %, and slip in turns. A compass is wrong by up to 35 degrees, which change.
    """

    seed: int
    seconds: float
    radius: float = 0.1
    track: float = 0.5
    step_s: float = 0.01

    def __post_init__(self) -> None:
        random, count = np.random.default_rng(self.seed), round(self.seconds / self.step_s)
        legs = math.ceil(self.seconds / 8.0)
        part = np.arange(count) * legs // count
        smooth = np.ones(100) / 100.0
        speeds, rates = random.uniform(0.4, 1.0, legs), random.uniform(-0.8, 0.8, legs)
        standing = random.random(legs) < 0.25
        standing[0] = False
        self.t = np.arange(count) * self.step_s
        speed, rate = (
            np.convolve(np.pad(values[part] * ~standing[part], (50, 49), mode="edge"), smooth, "valid")
            for values in (speeds, rates)
        )
        self.yaw = np.cumsum(rate) * self.step_s
        velocity = speed[:, None] * np.stack((np.cos(self.yaw), np.sin(self.yaw)), axis=1)
        self.position = np.cumsum(velocity, axis=0) * self.step_s
        self.mount = Transform.from_rpy(
            "base_link", "imu_link", (0.0, 0.0, 0.2), (math.pi / 2, 0.0, math.pi / 2)
        )
        chosen = np.flatnonzero(random.random(count // 2) > 0.02) * 2
        force = np.stack((np.gradient(speed, self.step_s), speed * rate, np.full(count, 9.80)), axis=1)
        force += 0.5 * speed[:, None] * np.sin(np.outer(self.t, (145.0, 199.0, 259.0)))
        turn = np.stack((0.0 * rate, 0.0 * rate, rate), axis=1)
        self.gyro, self.accel = (
            (ideal @ self.mount.matrix[:3, :3])[chosen] * (1.0 + random.normal(0.0, 0.01, 3))
            + random.normal(0.0, bias, 3)
            + random.normal(0.0, white * math.sqrt(50.0), (len(chosen), 3))
            for ideal, bias, white in ((turn, 0.01, NOISE.gyro), (force, 0.05, NOISE.accel))
        )
        self.imu_times = np.sort(self.t[chosen] + random.normal(0.0, 0.002, len(chosen)) + 0.01)
        slip, (radius, track) = 1.0 + 0.03 * np.abs(rate), 1.0 + random.normal(0.0, 0.02, 2)
        across = 0.5 * self.track * track * rate
        angles = np.cumsum([speed * slip - across, speed * slip + across], axis=1).T * self.step_s
        tick = math.tau / 1000
        self.wheels = np.floor(angles / (self.radius * radius) / tick)[::10] * tick
        hard_iron = math.radians(35.0) * np.sin(self.yaw + 0.02 * self.t + random.uniform(0.0, math.tau))
        self.compass = (self.yaw + 1.0 + hard_iron)[::10]

    def dead_reckoned(self) -> Floats:
        """The end by wheel speed and gyro, as they are: (2,)."""
        yaw = np.cumsum((self.gyro @ self.mount.matrix[:3, :3].T)[:, 2] * np.gradient(self.imu_times))
        distances = np.diff(self.wheels.mean(axis=1)) * self.radius
        yaw = np.interp(self.t[10::10] - 0.05, self.imu_times, yaw)
        return np.array((distances @ np.cos(yaw), distances @ np.sin(yaw)))


def mounted(base_from_imu: Transform) -> TransformBuffer:
    """A buffer with the mount of an IMU."""
    buffer = TransformBuffer()
    buffer.insert_static(base_from_imu)
    return buffer


def tilted_mount() -> Transform:
    return Transform.from_rpy("base_link", "imu_link", (0.2, -0.1, 0.3), (math.pi, 0.4, 1.2))
