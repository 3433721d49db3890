"""Messages of the sensors of a moving base, and of its odometry, on the native wire."""

from __future__ import annotations

from typing import TypeVar

import msgspec

from zstate.errors import InvalidInput
from zstate.message import StampedMessage
from zstate.wire.keys import full_name
from zstate.wire.messages import (
    WriterTransforms,
    check_covariance,
    check_frame,
    check_limit,
    check_quaternion,
    finite_numbers,
)


class Odometry(WriterTransforms, frozen=True, array_like=True, gc=False):
    """The pose and the velocity of a base, the child of the one edge: nav_msgs/Odometry.

    ``twist`` is a block of six numbers in the axes of the child: the velocity of its origin relative to the
    parent [m/s], and its angular velocity [rad/s]. ``twist_covariance`` is the upper triangle of their
    covariance, a block of 21 numbers, None if it is not known; ``covariances`` that of the pose.
    """

    twist: bytes = b""
    twist_covariance: bytes | None = None

    def __post_init__(self) -> None:
        if self.edges is None or len(self.edges) != 1:
            raise InvalidInput(f"odometry has one edge, from its frame to the base; got {self.edges}")
        super().__post_init__()
        finite_numbers("a twist", self.twist, 6)
        check_covariance("a twist", self.twist_covariance, 6)


MAX_RATE, MAX_ACCELERATION = 1e3, 1e5
"""[rad/s] and [m/s^2]: more in any axis is no reading of a sensor, but a fault of memory or of units."""

MAX_SPEED, MAX_DISTANCE = 1e4, 1e8
"""[m/s] and [m], likewise: above the speed of satellites, and twice the circumference of the Earth."""


class Imu(StampedMessage, frozen=True, array_like=True, gc=False):
    """One reading of an inertial measurement unit, in the axes of ``frame``, which is named as in edges.

    ``gyro`` [rad/s] and ``accel`` [m/s^2] are blocks of x y z. The accelerometer measures specific force:
    at rest +9.81 along the axis that points up. ``orientation``, None for a device that has none, is a block
    of the quaternion x y z w of ``frame`` in axes that the device defines. Each covariance is a block of six
    numbers, the upper triangle row by row, or None if it is not known; that of the orientation is in rad^2.
    """

    frame: str
    gyro: bytes
    accel: bytes
    orientation: bytes | None = None
    gyro_covariance: bytes | None = None
    accel_covariance: bytes | None = None
    orientation_covariance: bytes | None = None

    def __post_init__(self) -> None:
        check_frame(self.frame)
        check_limit("angular velocities", finite_numbers("angular velocities", self.gyro, 3), MAX_RATE)
        check_limit("accelerations", finite_numbers("accelerations", self.accel, 3), MAX_ACCELERATION)
        check_covariance("angular velocities", self.gyro_covariance, 3)
        check_covariance("accelerations", self.accel_covariance, 3)
        check_covariance("an orientation", self.orientation_covariance, 3)
        if self.orientation is not None:
            check_quaternion(finite_numbers("an orientation", self.orientation, 4))
        elif self.orientation_covariance is not None:
            raise InvalidInput("the covariance of an orientation needs an orientation")


class Velocity(StampedMessage, frozen=True, array_like=True, gc=False):
    """A measured velocity of ``frame`` relative to the world, in its own axes.

    ``linear`` [m/s], of its origin, and ``angular`` [rad/s] are blocks of x y z; ``angular`` is None if it
    was not measured. ``covariance`` is a block of the upper triangle row by row: 6 numbers of ``linear``, or
    21 of both; None if it is not known. ``frame`` is named as in edges.
    """

    frame: str
    linear: bytes
    angular: bytes | None = None
    covariance: bytes | None = None

    def __post_init__(self) -> None:
        check_frame(self.frame)
        check_limit("velocities", finite_numbers("velocities", self.linear, 3), MAX_SPEED)
        if self.angular is not None:
            check_limit("angular velocities", finite_numbers("angular velocities", self.angular, 3), MAX_RATE)
        check_covariance("velocities", self.covariance, 3 if self.angular is None else 6)


class Pose(StampedMessage, frozen=True, array_like=True, gc=False):
    """A measured pose of ``child`` in ``parent``, which are named as in edges; it is no edge of the tree.

    ``child`` is empty for the base of the robot, which ROS does not name. ``pose`` is a block of
    ``parent_from_child``: x y z [m], qx qy qz qw. ``covariance`` is a block of the upper triangle, 21 numbers
    as in WriterTransforms, or None if it is not known.
    """

    parent: str
    child: str
    pose: bytes
    covariance: bytes | None = None

    def __post_init__(self) -> None:
        check_frame(self.parent)
        if self.child:
            check_frame(self.child)
        numbers = finite_numbers("a pose", self.pose, 7)
        check_limit("positions", numbers[:3], MAX_DISTANCE)
        check_quaternion(numbers[3:])
        check_covariance("a pose", self.covariance, 6)


_Measurement = TypeVar("_Measurement", bound="Imu | Velocity | Pose")


def with_full_names(message: _Measurement, robot: str) -> _Measurement:
    """The same message of ``robot`` with the full names of its frames. Raises InvalidInput."""
    if isinstance(message, Pose):
        parent, child = full_name(robot, message.parent), message.child and full_name(robot, message.child)
        return msgspec.structs.replace(message, parent=parent, child=child)
    return msgspec.structs.replace(message, frame=full_name(robot, message.frame))
