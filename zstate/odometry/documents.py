"""Messages of sensors and of odometry as documents, which `zstate echo` prints."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from zstate.odometry.messages import (
    Fix,
    Imu,
    MagneticField,
    MapDatum,
    Odometry,
    Pose,
    Pressure,
    Velocity,
)
from zstate.wire.keys import full_name
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import from_block


def imu_document(message: Imu, robot: str) -> dict[str, Any]:
    """A reading of an IMU of ``robot``: stamp [ns], gyro [rad/s], accel [m/s^2], and sigmas if known."""
    document = _head(message, robot)
    document |= {"gyro": _list(message.gyro), "accel": _list(message.accel)}
    if message.orientation is not None:
        document["orientation"] = _list(message.orientation)
    triangles = message.gyro_covariance, message.accel_covariance, message.orientation_covariance
    return document | _sigmas(zip(("gyro", "accel", "orientation"), triangles, strict=True))


def velocity_document(message: Velocity, robot: str) -> dict[str, Any]:
    """A velocity of a frame of ``robot``: stamp [ns], linear [m/s], angular [rad/s], and sigmas if known."""
    document = {**_head(message, robot), "linear": _list(message.linear)}
    if message.angular is not None:
        document["angular"] = _list(message.angular)
    return document | _sigmas([("velocity", message.covariance)])


def pose_document(message: Pose, robot: str) -> dict[str, Any]:
    """A measured pose of ``robot``: stamp [ns], frames, pose [m], and sigmas [m, rad] if known.

    Without a child it is that of the robot's base.
    """
    pose = _list(message.pose)
    document: dict[str, Any] = {"stamp": message.stamp, "seq": message.seq}
    document["parent"] = full_name(robot, message.parent)
    if message.child:
        document["child"] = full_name(robot, message.child)
    document |= {"translation": pose[:3], "rotation": pose[3:]}
    return document | _sigmas([("pose", message.covariance)])


_STATUS = {-2: "unknown", -1: "no fix", 0: "fix", 1: "fix with SBAS", 2: "fix with GBAS"}


def fix_document(message: Fix, robot: str) -> dict[str, Any]:
    """A fix of ``robot``: stamp [ns], status, degrees, altitude and sigmas [m]; NaN is not known."""
    numbers = {
        name: np.nan if value is None else value
        for name, value in (
            ("latitude", message.latitude),
            ("longitude", message.longitude),
            ("altitude", message.altitude),
        )
    }
    sigmas = [np.nan] * 3
    if message.covariance is not None:
        sigmas = np.sqrt(np.diag(covariance_matrix(message.covariance))).tolist()
    document = {**_head(message, robot), "status": _STATUS[message.status], **numbers}
    return document | dict(zip(("sigma_east", "sigma_north", "sigma_up"), sigmas, strict=True))


def pressure_document(message: Pressure, robot: str) -> dict[str, Any]:
    """A pressure at a frame of ``robot``: stamp [ns], pressure [Pa], and its sigma if known."""
    document = {**_head(message, robot), "pressure": message.pressure}
    return document if message.variance is None else document | {"sigma": math.sqrt(message.variance)}


def datum_document(message: MapDatum, robot: str) -> dict[str, Any]:
    """The datum of a map of ``robot``: stamp of its announcement [ns], frame, degrees, altitude [m]."""
    place = ("latitude", "longitude", "altitude")
    return {**_head(message, robot), **{name: getattr(message, name) for name in place}}


def magnetic_field_document(message: MagneticField, robot: str) -> dict[str, Any]:
    """A magnetic field at a sensor of ``robot``: stamp [ns], field [T], and sigmas if known."""
    document = {**_head(message, robot), "field": _list(message.field)}
    return document | _sigmas([("field", message.covariance)])


def odometry_document(message: Odometry, robot: str) -> dict[str, Any]:
    """Odometry of ``robot``: stamp [ns], frames, pose [m], velocities [m/s, rad/s], and sigmas if known."""
    ((parent, child),) = message.edges or (("", ""),)
    pose, twist = _list(message.poses), _list(message.twist)
    document = {
        "stamp": message.stamp,
        "seq": message.seq,
        "parent": full_name(robot, parent),
        "child": full_name(robot, child),
        "translation": pose[:3],
        "rotation": pose[3:],
        "linear": twist[:3],
        "angular": twist[3:],
    }
    return document | _sigmas([("pose", message.covariances), ("twist", message.twist_covariance)])


def _head(message: Imu | Velocity | Fix | MagneticField | Pressure | MapDatum, robot: str) -> dict[str, Any]:
    return {"stamp": message.stamp, "seq": message.seq, "frame": full_name(robot, message.frame)}


def _list(block: bytes) -> list[float]:
    return from_block(block).tolist()


def _sigmas(covariances: Iterable[tuple[str, bytes | None]]) -> dict[str, list[float]]:
    """The standard deviations of each known covariance, in the units of its numbers."""
    return {
        f"{name}_sigma": np.sqrt(np.diag(covariance_matrix(triangle))).tolist()
        for name, triangle in covariances
        if triangle is not None
    }
