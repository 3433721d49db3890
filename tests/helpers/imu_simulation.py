"""A simulated body with an IMU in 3D: truth, samples with noise and walking biases, and a filter that starts
off.

Rate and specific force are constant in each step of the body, so that the truth is exact.
"""

from dataclasses import dataclass, field

import numpy as np
from helpers.filter_states import log_so3

from zstate.odometry import invariant_filter as iekf
from zstate.odometry.invariant_filter import FilterState, Floats, ImuNoise
from zstate.odometry.rotations import rotation_exp

NOISE = ImuNoise(gyro=2e-3, accel=2e-2, gyro_bias=1e-4, accel_bias=1e-3)

START_SIGMAS = np.repeat([0.1, 0.3, 0.5, 0.01, 0.1], 3)
"""Of rotation, velocity, position and biases of the first estimate, as in ``plain_covariance``."""


@dataclass
class SimulatedBody:
    """The truth of one run, from its seed. A ``pitch_rate`` [rad/s] replaces the random turns."""

    seed: int
    dt_s: float
    pitch_rate: float = 0.0
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.rotation = np.eye(3) if self.pitch_rate else rotation_exp(self.rng.normal(size=3) * 0.5)
        self.velocity, self.position = self.rng.normal(size=3), self.rng.normal(size=3) * 5.0
        self.gyro_bias, self.accel_bias = self.rng.normal(size=3) * 0.02, self.rng.normal(size=3) * 0.2
        self._phases = self.rng.uniform(0.0, 2.0 * np.pi, size=(2, 3))
        self._speeds = self.rng.uniform(1.0, 6.0, size=(2, 3))
        self._time = 0.0
        self.rate = np.zeros(3)

    def first_estimate(self) -> FilterState:
        """An estimate whose errors are drawn with START_SIGMAS."""
        errors = self.rng.normal(size=15) * START_SIGMAS
        return iekf.initial_state(
            rotation=rotation_exp(-errors[:3]) @ self.rotation,
            velocity=self.velocity - errors[3:6],
            position=self.position - errors[6:9],
            gyro_bias=self.gyro_bias - errors[9:12],
            accel_bias=self.accel_bias - errors[12:15],
            covariance=np.diag(START_SIGMAS**2),
        )

    def step(self) -> tuple[Floats, Floats]:
        """Moves the body by ``dt_s``, and returns the sample of its gyro and accelerometer."""
        dt = self.dt_s
        self.rate = np.sin(self._speeds[0] * self._time + self._phases[0])
        if self.pitch_rate:
            self.rate = np.array([0.0, self.pitch_rate, 0.0])
        pull = 2.0 * np.sin(self._speeds[1] * self._time + self._phases[1]) - iekf.GRAVITY
        force = self.rotation.T @ pull
        sample = (
            self.rate + self.gyro_bias + self.rng.normal(size=3) * NOISE.gyro / np.sqrt(dt),
            force + self.accel_bias + self.rng.normal(size=3) * NOISE.accel / np.sqrt(dt),
        )
        # Eight midpoint steps, to 1e-7 m/s: the truth does not use the filter's own integrals.
        fine = dt / 8
        half_turn = rotation_exp(self.rate * (0.5 * fine))
        for _ in range(8):
            middle = self.rotation @ half_turn
            pulled = middle @ force + iekf.GRAVITY
            self.position = self.position + (self.velocity + 0.5 * pulled * fine) * fine
            self.velocity = self.velocity + pulled * fine
            self.rotation = middle @ half_turn
        self._time += dt
        self.gyro_bias = self.gyro_bias + self.rng.normal(size=3) * NOISE.gyro_bias * np.sqrt(dt)
        self.accel_bias = self.accel_bias + self.rng.normal(size=3) * NOISE.accel_bias * np.sqrt(dt)
        return sample

    def nees(self, state: FilterState) -> Floats:
        """Normalised squared errors of rotation, velocity and position, of three degrees each: (3,)."""
        covariance = iekf.plain_covariance(state)
        errors = (
            log_so3(self.rotation @ state.rotation.T),
            self.velocity - state.velocity,
            self.position - state.position,
        )
        blocks = (slice(3 * i, 3 * i + 3) for i in range(3))
        return np.array(
            [
                error @ np.linalg.solve(covariance[block, block], error)
                for error, block in zip(errors, blocks, strict=True)
            ]
        )


def mean_band(runs: int, freedom: int) -> tuple[float, float]:
    """Where the mean of ``runs`` squared errors lies in 95 % of all cases.

    The quantiles of the chi-square distribution are those of Wilson and Hilferty (1931), to 0.1 % at 300
    degrees.
    """
    n = runs * freedom
    low, high = (n * (1.0 - 2.0 / (9 * n) + z * np.sqrt(2.0 / (9 * n))) ** 3 / runs for z in (-1.96, 1.96))
    return float(low), float(high)
