"""The kinds of sensors that an odometry takes: their streams, and how a message is passed to the estimators.

Live odometry (``node.py``), recordings and the command line know no kind by name: they go through ``KINDS``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from zstate.checks import Floats
from zstate.errors import InvalidInput
from zstate.odometry.estimator import BaseEstimator
from zstate.odometry.map_estimator import MapEstimator
from zstate.odometry.messages import Fix, Imu, Pose, Velocity, earlier
from zstate.odometry.source_noise import (
    POSE_AXES,
    VELOCITY_AXES,
    FixNoise,
    HeadingNoise,
    PoseNoise,
    SensorNoise,
    VelocityNoise,
    axis_rows,
)
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.messages import covariance_matrix, from_block


class Estimators(NamedTuple):
    """That of the odometry, and what places it in a map, if anything does."""

    odometry: BaseEstimator
    in_map: MapEstimator | None = None


class SensorKind(NamedTuple):
    """What makes the messages of ``stream`` a source.

    ``name`` is that of its option and of its table of settings, which have the fields of ``noise``.
    ``add(estimators, sensor, noise, message)`` passes a message on; ``covariance(sensor, noise, message)`` is
    that of its numbers, None if only the estimator knows it. Both raise InvalidInput, with what to do, if
    the noise is not known, and for a message that measures nothing. ``is_enough``: with an IMU and nothing
    else it keeps the place from drifting by metres in seconds. ``text`` tells of a source, by its sensor.
    """

    name: str
    stream: StreamName
    noise: type[SensorNoise]
    add: Callable[[Estimators, str, Any, Any], None]
    covariance: Callable[[str, Any, Any], Floats] | None = None
    is_enough: bool = False
    text: str = "{!r}"


class Sensor(NamedTuple):
    """One sensor of a robot, by its name in ``stream``, with what is stated of its noise."""

    kind: SensorKind
    name: str
    noise: SensorNoise

    def __str__(self) -> str:
        return self.kind.text.format(self.name)

    def add(self, estimators: Estimators, message: Any) -> None:
        """Pass ``message`` on, with the stamp of the instant that it measures. Raises InvalidInput."""
        if self.noise.delay_ns:
            message = earlier(message, self.noise.delay_ns)
        self.kind.add(estimators, self.name, self.noise, message)

    def covariance(self, message: Any) -> Floats | None:
        """That of the numbers of a message. Raises InvalidInput."""
        return None if self.kind.covariance is None else self.kind.covariance(self.name, self.noise, message)


def add_imu(base: BaseEstimator, message: Imu) -> None:
    """Pass one reading of the IMU to ``base``."""
    base.imu(message.stamp, from_block(message.gyro), from_block(message.accel))


def velocity_covariance(sensor: str, noise: VelocityNoise, message: Velocity) -> Floats:
    """That of the linear velocity [m^2/s^2], (3, 3): by ``noise``, else of the message.

    Raises InvalidInput if neither states it for the axes that are used: a driver that does not know variances
    sends zero or -1.
    """
    if noise.sigmas is not None:
        return np.diag(np.square(noise.sigmas))
    covariance = None if message.covariance is None else covariance_matrix(message.covariance)[:3, :3]
    rows = list(axis_rows("velocity", noise.axes, VELOCITY_AXES))
    if covariance is None or not (np.diag(covariance)[rows] > 0.0).all():
        raise InvalidInput(
            f"velocities of {sensor!r} have {_unknown(covariance)}: state their noise by `--velocity "
            f"{sensor}:sigma=0.05`, or sigma = 0.05 [m/s] in [velocity.{sensor}] of the settings"
        )
    return covariance


def add_velocity(estimators: Estimators, sensor: str, noise: VelocityNoise, message: Velocity) -> None:
    """Pass one measured velocity to the odometry."""
    estimators.odometry.velocity(
        message.stamp,
        from_block(message.linear),
        covariance=velocity_covariance(sensor, noise, message),
        angular=None if message.angular is None else from_block(message.angular),
        frame=message.frame,
        scale=noise.scale,
        source=sensor,
        axes=noise.axes,
        gate=noise.gate,
    )


def pose_covariance(sensor: str, noise: PoseNoise, message: Pose) -> Floats:
    """That of a pose, (6, 6), as of ``Transform.covariance``: by ``noise``, else of the message.

    Raises InvalidInput as ``velocity_covariance``.
    """
    if noise.sigmas is not None:
        return np.diag(np.square(noise.sigmas))
    covariance = None if message.covariance is None else covariance_matrix(message.covariance)
    rows = list(axis_rows("pose", noise.axes, POSE_AXES))
    if covariance is None or not (np.diag(covariance)[rows] > 0.0).all():
        raise InvalidInput(
            f"poses of {sensor!r} have {_unknown(covariance)}: state their noise by `--pose "
            f"{sensor}:sigma=0.02,sigma_deg=1`, or sigma = 0.02 [m] and sigma_deg = 1.0 [degrees] in "
            f"[pose.{sensor}] of the settings"
        )
    return covariance


def add_pose(estimators: Estimators, sensor: str, noise: PoseNoise, message: Pose) -> None:
    """Pass one measured pose to the odometry."""
    base = estimators.odometry
    measured = Transform.from_pose7(message.parent, message.child or base.base, from_block(message.pose))
    base.pose(
        message.stamp,
        measured,
        pose_covariance(sensor, noise, message),
        source=sensor,
        axes=noise.axes,
        gate=noise.gate,
    )


def heading_covariance(sensor: str, noise: HeadingNoise, message: Imu) -> Floats:
    """That of the yaw of an orientation [rad^2], (1, 1): by ``noise``, else of the message.

    Raises InvalidInput for a message without an orientation, and as ``velocity_covariance``.
    """
    if message.orientation is None:
        raise InvalidInput(f"the IMU {sensor!r} sends no orientation, and so no heading")
    if noise.sigma_deg is not None:
        return np.array([[math.radians(noise.sigma_deg) ** 2]])
    known = message.orientation_covariance
    covariance = None if known is None else covariance_matrix(known)
    if covariance is None or not covariance[2, 2] > 0.0:
        raise InvalidInput(
            f"orientations of {sensor!r} have {_unknown(covariance)}: state their noise by `--heading "
            f"{sensor}:sigma_deg=5`, or sigma_deg = 5.0 [degrees] in [heading.{sensor}] of the settings"
        )
    return covariance[2:, 2:]


def add_heading(estimators: Estimators, sensor: str, noise: HeadingNoise, message: Imu) -> None:
    """Pass the yaw of the orientation of an IMU to the odometry, as a source of its own beside its rates."""
    sigma = math.sqrt(float(heading_covariance(sensor, noise, message)[0, 0]))
    assert message.orientation is not None
    x, y, z, w = from_block(message.orientation).tolist()
    yaw = math.atan2(2.0 * (x * y + z * w), 1.0 - 2.0 * (y * y + z * z))
    estimators.odometry.heading(
        message.stamp, yaw, sigma, source=f"{sensor} heading", frame=message.frame, gate=noise.gate
    )


def add_fix(estimators: Estimators, sensor: str, noise: FixNoise, message: Fix) -> None:
    """Pass one fix to what places the odometry in a map. Raises InvalidInput for a message without a fix."""
    latitude, longitude = message.latitude, message.longitude
    if message.status < 0 or latitude is None or longitude is None:
        raise InvalidInput(f"the receiver {sensor!r} has no fix: its status is {message.status}")
    if estimators.in_map is None:
        raise InvalidInput(f"fixes of {sensor!r} need a MapEstimator, which places the odometry in a map")
    estimators.in_map.fix(
        message.stamp,
        latitude,
        longitude,
        message.altitude,
        covariance=None if message.covariance is None else covariance_matrix(message.covariance),
        frame=message.frame,
        source=sensor,
        noise=noise,
    )


def _unknown(covariance: Floats | None) -> str:
    return "no covariance" if covariance is None else "a covariance with variances that are not above zero"


KINDS = (
    SensorKind("velocity", "velocity", VelocityNoise, add_velocity, velocity_covariance, is_enough=True),
    SensorKind("pose", "pose", PoseNoise, add_pose, pose_covariance, is_enough=True),
    SensorKind("heading", "imu", HeadingNoise, add_heading, heading_covariance, text="the heading of {!r}"),
    SensorKind("fix", "fix", FixNoise, add_fix),
)

_BY_NOISE = {kind.noise: kind for kind in KINDS}


def sensor(name: str, noise: SensorNoise) -> Sensor:
    """The sensor ``name`` of the kind that has such a noise."""
    return Sensor(_BY_NOISE[type(noise)], name, noise)
