"""Odometry of a quadruped of example-robot-data that trots, from its joint states and its IMU."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.base_motion import IMU_HZ, NOISE, Motion, NoisyImu, mounted, stamp_at

from zstate import Transform, load_model
from zstate.model.kinematics import Kinematics
from zstate.odometry.cli.settings_file import LegSettings, OdometrySettings
from zstate.odometry.invariant_filter import Floats
from zstate.odometry.messages import Imu
from zstate.odometry.node import add_imu, add_joints
from zstate.sources import JointReading
from zstate.wire.messages import to_block

pytestmark = pytest.mark.robots

ENCODER = 0.002
SWING_S, LIFT_M = 0.25, 0.05
SECONDS = 8.0


ROBOT, IMU = "go2", "imu"
FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
STANCE = (0.0, 0.8, -1.6)
"""The joints of each leg [rad]."""


class Trot:
    """A base in ``motion`` on feet that stand still in turn: those of one diagonal swing for 0.25 s.

    A foot that swings lands where it is below its hip in the middle of its stance.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.model = load_model(ROBOT)
        self.kinematics = Kinematics(self.model)
        self.positions = np.tile(STANCE, 4)
        self.nominal, _ = self.kinematics.origins(FEET, self.positions)
        self._begin = math.ceil(motion.rest_s / (2 * SWING_S)) * 2 * SWING_S

    def _landing(self, foot: int, t: float) -> Floats:
        """Where a foot below its hip at ``t`` is on the ground, in the world."""
        times = np.array([max(t, 0.0)])
        point = self.motion.rotation(times)[0] @ self.nominal[foot] + self.motion.coordinates(times)[0, :3]
        point[2] = self.nominal[foot, 2]
        return point

    def foot(self, foot: int, t: float) -> Floats:
        """A foot in the world: standing, or on its way to its next place."""
        is_second = foot in {1, 2}
        cycle, phase = divmod(t - self._begin - SWING_S * is_second, 2 * SWING_S)
        if cycle < 0:
            return self._landing(foot, 0.0)
        swing_end = self._begin + SWING_S * is_second + cycle * 2 * SWING_S + SWING_S
        after = self._landing(foot, swing_end + 0.5 * SWING_S)
        if phase >= SWING_S:
            return after
        before = self._landing(foot, swing_end - 1.5 * SWING_S) if cycle else self._landing(foot, 0.0)
        u = phase / SWING_S
        point = before + (after - before) * (0.5 - 0.5 * math.cos(math.pi * u))
        point[2] += LIFT_M * math.sin(math.pi * u)
        return point

    def in_base(self, t: float) -> Floats:
        """The feet in the base: (4, 3)."""
        times = np.array([t])
        rotation, base = self.motion.rotation(times)[0], self.motion.coordinates(times)[0, :3]
        return np.array([(self.foot(foot, t) - base) @ rotation for foot in range(4)])

    def joints(self, t: float) -> tuple[Floats, Floats]:
        """Positions [rad] and velocities [rad/s] of all joints at ``t``, by Newton's iteration."""
        h = 1e-5
        before, wanted, after = (self.in_base(instant).reshape(-1) for instant in (t - h, t, t + h))
        for _ in range(20):
            points, jacobians = self.kinematics.origins(FEET, self.positions)
            error, inverse = wanted - points.reshape(-1), np.linalg.inv(jacobians.reshape(12, 12))
            if np.abs(error).max() < 1e-9:
                return self.positions, inverse @ (after - before) / (2 * h)
            self.positions += inverse @ error
        raise AssertionError(f"a foot is out of reach at {t} s")


def motion_of_a_trot() -> Motion:
    """Up to 0.8 m/s, with turns; heave of 1 cm, roll and pitch of 2 degrees."""
    motion = Motion(4, tilt=0.03, rest_s=2.0)
    motion.sines[2, 0] = 0.01
    motion.sines[:2, :2] = (1.5, 0.4), (1.0, 0.5)
    motion.sines[5, 0] = 0.6
    return motion


@pytest.mark.long
def test_feet_and_imu_give_the_path_of_a_trot():
    """Truth from the motion alone: Newton's iteration finds the joints, nothing of the estimator is used."""
    motion, random = motion_of_a_trot(), np.random.default_rng(1)
    trot = Trot(motion)
    poses = dict(zip(trot.model.links, trot.kinematics.link_poses(trot.positions), strict=True))
    mount = Transform.from_pose7(f"r1/{trot.model.root}", f"r1/{IMU}", poses[IMU])
    settings = OdometrySettings(imu_noise=NOISE, legs=LegSettings(feet=FEET))
    base = settings.estimator("r1", trot.model.root, IMU, mounted(mount), trot.model)

    times, gyro, accel = NoisyImu(motion, mount, SECONDS, random).samples()
    for number, t in enumerate(times.tolist()):
        add_imu(base, Imu(stamp_at(t), 0, 0, IMU, to_block(gyro[number]), to_block(accel[number])))
        if number % 2:  # 100 Hz
            positions, velocities = trot.joints(t)
            measured = positions + random.normal(0.0, ENCODER, 12)
            add_joints(base, trot.model, JointReading(measured, velocities, stamp=stamp_at(t)))

    end = np.array([SECONDS - 1.0 / IMU_HZ])
    _, _, position = motion.truth(end)
    state = base.state()
    errors = np.append(
        state.odom_from_base.translation - position[0],
        state.odom_from_base.rpy[2] - motion.coordinates(end)[0, 5],
    )
    way = np.linalg.norm(np.diff(motion.coordinates(times)[:, :2], axis=0), axis=1).sum()
    assert way > 2.5
    assert np.abs(errors[:3]).max() < 0.02 * way
    assert abs(errors[3]) < math.radians(6.0)  # a bias of up to 0.01 rad/s for 6 s, less what feet show
    covariance = state.covariance.pose[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])]
    assert errors @ np.linalg.solve(covariance, errors) < 18.47  # 99.9 % of chi-square with 4 degrees
    feet = next(source for source in base.health() if source.name == "feet")
    assert feet.rejected <= 0.05 * feet.accepted
    assert not feet.sentence
