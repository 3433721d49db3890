"""IMUs, velocities, poses, fixes, magnetic fields, pressures and odometry as ROS 2 messages.

ROS has matrices where zstate has upper triangles or None. A covariance of zeros is not known
(sensor_msgs/Imu), nor is a variance of zero (sensor_msgs/FluidPressure), and so is what a first number of -1
precedes: an IMU without orientation, or one that measures no angular velocities or no accelerations. An
angular velocity that was not measured is NaN here, and so are the altitude and the position that a fix does
not have.
"""

from __future__ import annotations

import struct
from math import isfinite, isnan, nan

import numpy as np

from zstate.errors import InvalidInput, MessageError
from zstate.odometry.messages import Fix, Imu, MagneticField, Odometry, Pose, Pressure, Velocity
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import from_block, order_digest, to_block
from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.streams import RosStream
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import (
    FLUID_PRESSURE,
    IMU,
    MAGNETIC_FIELD,
    NAV_SAT_FIX,
    ODOMETRY,
    POSE_WITH_COVARIANCE,
    TWIST_WITH_COVARIANCE,
)

_IDENTITY = to_block([0.0, 0.0, 0.0, 1.0])
_ABSENT = to_block([-1.0, *[0.0] * 8])
"""The covariance of what is not measured."""
_NOT_MEASURED = to_block([np.nan] * 3)
_NO_QUATERNION = bytes(4 * 8)
_SYMMETRY = 1e-6


def encode_imu(imu: Imu, names: FrameNames) -> bytes:
    """The sensor_msgs/Imu of a reading. Raises InvalidInput if CDR cannot represent it."""
    writer = CdrWriter()
    writer.stamp(imu.stamp)
    writer.text(names.to_ros(imu.frame))
    if imu.orientation is None:
        writer.numbers(_IDENTITY + _ABSENT)
    else:
        writer.numbers(imu.orientation + _matrix(imu.orientation_covariance, 3))
    writer.numbers(imu.gyro + _matrix(imu.gyro_covariance, 3))
    writer.numbers(imu.accel + _matrix(imu.accel_covariance, 3))
    return writer.payload()


def decode_imu(payload: bytes, session: int, seq: int, names: FrameNames) -> Imu:
    """The reading in a sensor_msgs/Imu.

    Raises MessageError with the reason "truncated", "malformed", or "not measured" for a device without a
    gyroscope or an accelerometer.
    """
    reader = CdrReader(payload, IMU.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    orientation, turn_covariance = reader.numbers(4), reader.numbers(9)
    gyro, gyro_covariance = reader.numbers(3), reader.numbers(9)
    accel, accel_covariance = reader.numbers(3), reader.numbers(9)
    for what, covariance in (("angular velocities", gyro_covariance), ("accelerations", accel_covariance)):
        if _is_absent(covariance):
            text = f"a {IMU.name} of {frame!r} without {what}: the first number of their covariance is -1"
            raise MessageError(text, reason="not measured")
    has_orientation = not _is_absent(turn_covariance) and orientation != _NO_QUATERNION
    try:
        return Imu(
            stamp,
            seq,
            session,
            frame,
            gyro,
            accel,
            orientation if has_orientation else None,
            _triangle(gyro_covariance, 3),
            _triangle(accel_covariance, 3),
            _triangle(turn_covariance, 3) if has_orientation else None,
        )
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def encode_velocity(velocity: Velocity, names: FrameNames) -> bytes:
    """The geometry_msgs/TwistWithCovarianceStamped of a velocity; raises as ``encode_imu``."""
    writer = CdrWriter()
    writer.stamp(velocity.stamp)
    writer.text(names.to_ros(velocity.frame))
    if velocity.angular is not None:
        writer.numbers(velocity.linear + velocity.angular + _matrix(velocity.covariance, 6))
    else:
        matrix = np.full((6, 6), np.nan)
        matrix[:3, :3] = from_block(_matrix(velocity.covariance, 3)).reshape(3, 3)
        writer.numbers(velocity.linear + _NOT_MEASURED + to_block(matrix))
    return writer.payload()


def decode_velocity(payload: bytes, session: int, seq: int, names: FrameNames) -> Velocity:
    """The velocity in a TwistWithCovarianceStamped.

    Raises MessageError with the reason "truncated" or "malformed".
    """
    reader = CdrReader(payload, TWIST_WITH_COVARIANCE.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    linear, angular, covariance = reader.numbers(3), reader.numbers(3), reader.numbers(36)
    size = 6
    if np.isnan(from_block(angular)).all():
        angular, size = None, 3
        covariance = to_block(from_block(covariance).reshape(6, 6)[:3, :3])
    try:
        return Velocity(stamp, seq, session, frame, linear, angular, _triangle(covariance, size))
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def encode_pose(pose: Pose, names: FrameNames) -> bytes:
    """The geometry_msgs/PoseWithCovarianceStamped of a pose, which has no child; raises as ``encode_imu``."""
    writer = CdrWriter()
    writer.stamp(pose.stamp)
    writer.text(names.to_ros(pose.parent))
    writer.numbers(pose.pose + _matrix(pose.covariance, 6))
    return writer.payload()


def decode_pose(payload: bytes, session: int, seq: int, names: FrameNames) -> Pose:
    """The pose of the robot's base in a PoseWithCovarianceStamped; raises as ``decode_velocity``."""
    reader = CdrReader(payload, POSE_WITH_COVARIANCE.name)
    stamp, parent = reader.stamp(), names.to_zstate(reader.text())
    pose, covariance = reader.numbers(7), reader.numbers(36)
    try:
        return Pose(stamp, seq, session, parent, "", pose, _triangle(covariance, 6))
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def encode_fix(fix: Fix, names: FrameNames) -> bytes:
    """The sensor_msgs/NavSatFix of a fix; raises as ``encode_imu``."""
    position = (fix.latitude, fix.longitude, fix.altitude)
    writer = CdrWriter()
    writer.stamp(fix.stamp)
    writer.text(names.to_ros(fix.frame))
    writer.numbers(struct.pack("<b", fix.status), 1)
    writer.numbers(struct.pack("<H", fix.service), 2)
    writer.numbers(to_block([nan if number is None else number for number in position]))
    writer.numbers(_matrix(fix.covariance, 3))
    writer.numbers(struct.pack("<B", fix.covariance_type), 1)
    return writer.payload()


def decode_fix(payload: bytes, session: int, seq: int, names: FrameNames) -> Fix:
    """The fix in a sensor_msgs/NavSatFix; raises as ``decode_velocity``.

    Its covariance is not known as well if a driver has put NaN into it, whatever its type says.
    """
    reader = CdrReader(payload, NAV_SAT_FIX.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    (status,), (service,) = (
        struct.unpack("<b", reader.numbers(1, 1)),
        struct.unpack("<H", reader.numbers(1, 2)),
    )
    latitude, longitude, altitude = from_block(reader.numbers(3)).tolist()
    covariance, (covariance_type,) = reader.numbers(9), reader.numbers(1, 1)
    head = (stamp, seq, session, frame)
    try:
        if not (isfinite(latitude) and isfinite(longitude)):
            return Fix(*head, None, None, None, status, service)
        is_known = covariance_type != 0 and not np.isnan(from_block(covariance)).any()
        triangle = _triangle(covariance, 3) if is_known else None
        position = latitude, longitude, None if isnan(altitude) else altitude
        return Fix(*head, *position, status, service, triangle, 0 if triangle is None else covariance_type)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def encode_pressure(pressure: Pressure, names: FrameNames) -> bytes:
    """The sensor_msgs/FluidPressure of a reading; raises as ``encode_imu``."""
    writer = CdrWriter()
    writer.stamp(pressure.stamp)
    writer.text(names.to_ros(pressure.frame))
    writer.numbers(to_block([pressure.pressure, pressure.variance or 0.0]))
    return writer.payload()


def decode_pressure(payload: bytes, session: int, seq: int, names: FrameNames) -> Pressure:
    """The reading in a sensor_msgs/FluidPressure; raises as ``decode_velocity``.

    Its variance is not known as well if a driver has put NaN into it.
    """
    reader = CdrReader(payload, FLUID_PRESSURE.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    pressure, variance = from_block(reader.numbers(2)).tolist()
    known = None if variance == 0.0 or isnan(variance) else variance
    try:
        return Pressure(stamp, seq, session, frame, pressure, known)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def encode_magnetic_field(field: MagneticField, names: FrameNames) -> bytes:
    """The sensor_msgs/MagneticField of a field; raises as ``encode_imu``."""
    writer = CdrWriter()
    writer.stamp(field.stamp)
    writer.text(names.to_ros(field.frame))
    writer.numbers(field.field + _matrix(field.covariance, 3))
    return writer.payload()


def decode_magnetic_field(payload: bytes, session: int, seq: int, names: FrameNames) -> MagneticField:
    """The field in a sensor_msgs/MagneticField; raises as ``decode_velocity``.

    One without an axis, which is NaN there, is malformed.
    """
    reader = CdrReader(payload, MAGNETIC_FIELD.name)
    stamp, frame = reader.stamp(), names.to_zstate(reader.text())
    field, covariance = reader.numbers(3), reader.numbers(9)
    try:
        return MagneticField(stamp, seq, session, frame, field, _triangle(covariance, 3))
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def encode_odometry(odometry: Odometry, names: FrameNames) -> bytes:
    """The nav_msgs/Odometry of a sample; raises as ``encode_imu``."""
    assert odometry.edges is not None
    ((parent, child),) = names.edges_to_ros(odometry.edges)
    writer = CdrWriter()
    writer.stamp(odometry.stamp)
    writer.text(parent)
    writer.text(child)
    writer.numbers(odometry.poses + _matrix(odometry.covariances, 6))
    writer.numbers(odometry.twist + _matrix(odometry.twist_covariance, 6))
    return writer.payload()


def decode_odometry(payload: bytes, session: int, seq: int, names: FrameNames) -> Odometry:
    """The sample in a nav_msgs/Odometry; raises as ``decode_velocity``."""
    reader = CdrReader(payload, ODOMETRY.name)
    stamp, edges = reader.stamp(), names.edges_to_zstate(((reader.text(), reader.text()),))
    pose, covariance = reader.numbers(7), reader.numbers(36)
    twist, twist_covariance = reader.numbers(6), reader.numbers(36)
    head = (stamp, seq, session, order_digest(edges))
    try:
        covariances = _triangle(covariance, 6), _triangle(twist_covariance, 6)
        return Odometry(*head, pose, edges, covariances[0], twist, covariances[1])
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def _is_absent(covariance: bytes) -> bool:
    return from_block(covariance)[0] == -1.0


def _matrix(triangle: bytes | None, size: int) -> bytes:
    """The matrix of a covariance, row by row; zeros if it is not known."""
    return bytes(8 * size * size) if triangle is None else to_block(covariance_matrix(triangle))


def _triangle(block: bytes, size: int) -> bytes | None:
    """The upper triangle of a covariance, None for zeros. Raises InvalidInput unless it is symmetric."""
    matrix = from_block(block).reshape(size, size)
    if not matrix.any():
        return None
    is_finite = bool(np.isfinite(matrix).all())
    if not is_finite or np.abs(matrix - matrix.T).max() > _SYMMETRY * np.abs(matrix).max():
        raise InvalidInput(f"a covariance is symmetric and finite; got {matrix.tolist()}")
    return to_block(matrix[np.triu_indices(size)])


_QOS = Qos(depth=10)
IMU_STREAM = RosStream(IMU, _QOS, encode=encode_imu, decode=decode_imu, is_named=True, is_of_sensor=True)
VELOCITY_STREAM = RosStream(
    TWIST_WITH_COVARIANCE,
    _QOS,
    encode=encode_velocity,
    decode=decode_velocity,
    is_named=True,
    is_of_sensor=True,
)
POSE_STREAM = RosStream(
    POSE_WITH_COVARIANCE,
    _QOS,
    encode=encode_pose,
    decode=decode_pose,
    uncarried="child",
    is_named=True,
    is_of_sensor=True,
)
FIX_STREAM = RosStream(
    NAV_SAT_FIX, _QOS, encode=encode_fix, decode=decode_fix, is_named=True, is_of_sensor=True
)
PRESSURE_STREAM = RosStream(
    FLUID_PRESSURE, _QOS, encode=encode_pressure, decode=decode_pressure, is_named=True, is_of_sensor=True
)
MAGNETIC_FIELD_STREAM = RosStream(
    MAGNETIC_FIELD,
    _QOS,
    encode=encode_magnetic_field,
    decode=decode_magnetic_field,
    is_named=True,
    is_of_sensor=True,
)
ODOMETRY_STREAM = RosStream(
    ODOMETRY, _QOS, encode=encode_odometry, decode=decode_odometry, is_named=True, is_of_sensor=True
)
