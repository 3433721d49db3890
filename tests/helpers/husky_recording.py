"""The drive of a real Husky, from its rest to its end, as an MCAP recording of the robot ``husky``.

    PYTHONPATH=tests python -m helpers.husky_recording husky.mcap

It has what the drivers of the robot sent, as far as tests/odometry/data has it:

- the mount of the IMU on ``base_link``, and no model;
- ``imu/imu``. Of its orientation only the yaw of the base is known: roll and pitch are those of a level base;
- ``velocity/wheels``, the speed and the yaw rate of the wheels;
- ``odometry/driver``, the integral of these, as the driver has it, with covariances of zeros;
- ``fix/gps``, without heights, and the same fixes as a reference: ``pose/gps``, east and north of the first.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from helpers.recording_builder import RecordingBuilder, pose
from helpers.recordings import (
    COMPASS_SIGMA,
    HUSKY_DATUM,
    HUSKY_REST_S,
    VELOCITY_VARIANCE,
    Recording,
    driver_path,
    load,
)

from zstate import Transform
from zstate.odometry.messages import Fix, Imu, Odometry, Pose, SensorMessage, Velocity
from zstate.wire.messages import order_digest, to_block

ROBOT = "husky"
_NO_YAW = math.pi**2
"""The variance of a yaw that a receiver does not measure [rad^2]."""


def write_husky(path: Path) -> None:
    """Write the recording to ``path``."""
    recording = load(ROBOT)
    measured = [*_imu(recording), *_wheels(recording), *_driver(recording), *_gps(recording)]
    measured = [one for one in measured if one[1].stamp >= recording.stamp(HUSKY_REST_S)]
    measured.sort(key=lambda one: one[1].stamp)
    with RecordingBuilder(path) as builder:
        mount = {(recording.mount.target, recording.mount.source): recording.mount.pose7.tolist()}
        builder.statics(ROBOT, measured[0][1].stamp, mount, writer="mounts")
        for name, message in measured:
            builder.encoder.write_message(ROBOT, message, message.stamp, name)


def _imu(recording: Recording) -> Iterator[tuple[str, SensorMessage]]:
    known = _triangle(COMPASS_SIGMA**2 * np.eye(3))
    for number, (row, yaw) in enumerate(zip(recording.imu, recording.compass[:, 1].tolist(), strict=True)):
        level = Transform.from_rpy("earth", "base_link", (0.0, 0.0, 0.0), (0.0, 0.0, yaw))
        turned = to_block((level @ recording.mount).pose7[3:])
        rates = to_block(row[1:4]), to_block(row[4:7])
        yield (
            "imu",
            Imu(recording.stamp(row[0]), number, 2, "imu_link", *rates, turned, orientation_covariance=known),
        )


def _wheels(recording: Recording) -> Iterator[tuple[str, SensorMessage]]:
    known = _triangle(np.diag([VELOCITY_VARIANCE] * 3 + [0.0] * 3))  # that of the yaw rate is not recorded
    for number, (t, speed, rate) in enumerate(recording.wheels.tolist()):
        moving = to_block([speed, 0.0, 0.0]), to_block([0.0, 0.0, rate])
        yield "wheels", Velocity(recording.stamp(t), number, 3, "base_link", *moving, known)


def _driver(recording: Recording) -> Iterator[tuple[str, SensorMessage]]:
    edges, zeros = (("wheel_odom", "base_link"),), _triangle(np.zeros((6, 6)))
    for number, ((t, x, y, yaw), (_, speed, rate)) in enumerate(
        zip(driver_path(recording).tolist(), recording.wheels.tolist(), strict=True)
    ):
        head = recording.stamp(t), number, 4, order_digest(edges)
        twist = to_block([speed, 0.0, 0.0, 0.0, 0.0, rate])
        yield "driver", Odometry(*head, to_block(pose(x, y, yaw=yaw)), edges, zeros, twist, zeros)


def _gps(recording: Recording) -> Iterator[tuple[str, SensorMessage]]:
    for number, (t, x, y, variance) in enumerate(recording.gps.tolist()):
        latitude, longitude, _ = HUSKY_DATUM.geodetic((x, y, 0.0))
        known = _triangle(variance * np.eye(3))
        where = recording.stamp(t), number, 5, "base_link"
        yield "gps", Fix(*where, latitude, longitude, covariance=known, covariance_type=2)
        plane = _triangle(np.diag([variance] * 3 + [_NO_YAW] * 3))
        yield "gps", Pose(recording.stamp(t), number, 6, "map", "", to_block(pose(x, y)), plane)


def _triangle(covariance: np.ndarray) -> bytes:
    return to_block(covariance[np.triu_indices(len(covariance))])


if __name__ == "__main__":
    write_husky(Path(sys.argv[1]))
