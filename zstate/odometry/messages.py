"""Messages of the sensors of a moving base, and of its odometry, on the native wire."""

from __future__ import annotations

import math
from typing import TypeAlias, TypeVar

import msgspec

from zstate.errors import InvalidInput
from zstate.message import StampedMessage
from zstate.odometry.geodesy import Datum, check_geodetic
from zstate.wire.keys import full_name
from zstate.wire.measurements import (
    check_covariance,
    check_finite,
    check_frame,
    check_limit,
    check_quaternion,
    finite_numbers,
)
from zstate.wire.messages import WriterTransforms, order_digest


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

MAX_PRESSURE = 1e9
"""[Pa], likewise: nine times that at the deepest place of the sea."""

MAX_SPEED, MAX_DISTANCE = 1e4, 1e8
"""[m/s] and [m], likewise: above the speed of satellites, and twice the circumference of the Earth."""

MAX_FIELD = 1.0
"""[T] In any axis, likewise: above that of permanent magnets, and 15,000 times that of the Earth."""


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


class Fix(StampedMessage, frozen=True, array_like=True, gc=False):
    """What a satellite receiver knows of the place of its antenna on the Earth: sensor_msgs/NavSatFix.

    ``frame`` is the antenna, named as in edges. ``latitude`` and ``longitude`` [deg], north and east
    positive, and ``altitude`` [m] above the ellipsoid, not above the sea, are those of WGS84; ``altitude`` is
    None if it is not known. ``status`` is -2 if that is not known, -1 for no fix, 0 for a fix, and 1 or 2 for
    one with augmentation, satellite- or ground-based. Below 0 the position may be None; if it is not, it is
    one that the receiver does not vouch for. ``service`` has a bit for each system in use, as
    sensor_msgs/NavSatStatus has, and is 0 if that is not known.

    ``covariance`` [m^2] is a block of the upper triangle in the axes east, north, up at the antenna, 6
    numbers, or None if it is not known. ``covariance_type`` says where it is from: 1 for an approximation, as
    from the dilution of precision, 2 if only its diagonal is known, 3 for all of it, and 0 if it is None.
    """

    frame: str
    latitude: float | None
    longitude: float | None
    altitude: float | None = None
    status: int = 0
    service: int = 0
    covariance: bytes | None = None
    covariance_type: int = 0

    def __post_init__(self) -> None:
        check_frame(self.frame)
        if self.status not in (-2, -1, 0, 1, 2):
            raise InvalidInput(
                "the status of a fix is -2 (not known), -1 (no fix), 0 (fix), 1 or 2 (with augmentation), as "
                f"in sensor_msgs/NavSatStatus; got {self.status}"
            )
        if not 0 <= self.service < 2**16:
            raise InvalidInput(f"the service of a fix has 16 bits, 0 to 65535; got {self.service}")
        if self.latitude is None or self.longitude is None:
            self._check_unplaced()
        else:
            check_finite("a latitude and a longitude", self.latitude, self.longitude)
            if abs(self.latitude) > 90.0 or abs(self.longitude) > 180.0:
                raise InvalidInput(
                    "latitudes are within 90 degrees and longitudes within 180 of zero; got "
                    f"{self.latitude} and {self.longitude}: give degrees with decimals, not the degrees and "
                    "minutes of NMEA"
                )
        if self.altitude is not None:
            check_finite("an altitude", self.altitude)
            check_limit("altitudes", (self.altitude,), MAX_DISTANCE)
        check_covariance("a fix", self.covariance, 3)
        known = (0,) if self.covariance is None else (1, 2, 3)
        if self.covariance_type not in known:
            raise InvalidInput(
                "the type of a covariance is 1 (approximated), 2 (diagonal known) or 3 (known), and 0 "
                f"without a covariance; got {self.covariance_type} "
                f"{'without' if self.covariance is None else 'with'} one"
            )

    def _check_unplaced(self) -> None:
        """Raise InvalidInput unless nothing but the position is missing, and the status says so."""
        if self.latitude is not None or self.longitude is not None:
            raise InvalidInput(
                f"a position has a latitude and a longitude; got {self.latitude} and {self.longitude}"
            )
        if self.status >= 0:
            raise InvalidInput(
                f"a fix of status {self.status} has a latitude and a longitude; without them the status is "
                "-1 (no fix)"
            )
        if self.altitude is not None or self.covariance is not None:
            raise InvalidInput("an altitude and a covariance need a latitude and a longitude")


class MagneticField(StampedMessage, frozen=True, array_like=True, gc=False):
    """The magnetic field at a sensor, in the axes of ``frame``, which is named as in edges.

    ``field`` [T] is a block of x y z. ``covariance`` [T^2] is a block of the upper triangle, 6 numbers, or
    None if it is not known.
    """

    frame: str
    field: bytes
    covariance: bytes | None = None

    def __post_init__(self) -> None:
        check_frame(self.frame)
        numbers = finite_numbers("a magnetic field", self.field, 3)
        if max(map(abs, numbers)) > MAX_FIELD:
            raise InvalidInput(
                f"magnetic fields are in tesla, at most {MAX_FIELD:g}; got {', '.join(map(str, numbers))}, "
                "which may be microtesla (1e-6 T) or milligauss (1e-7 T): that of the Earth is 2e-5 to 7e-5"
            )
        check_covariance("a magnetic field", self.covariance, 3)


class Pressure(StampedMessage, frozen=True, array_like=True, gc=False):
    """A reading of a barometer, or of another sensor of the pressure of a fluid: sensor_msgs/FluidPressure.

    ``frame`` is the sensor, named as in edges; ``pressure`` [Pa] is absolute. ``variance`` [Pa^2] is None if
    it is not known.
    """

    frame: str
    pressure: float
    variance: float | None = None

    def __post_init__(self) -> None:
        check_frame(self.frame)
        if not 0.0 < self.pressure <= MAX_PRESSURE:
            raise InvalidInput(
                f"an absolute pressure is above zero and at most {MAX_PRESSURE:g} Pa; got {self.pressure}"
            )
        if self.variance is not None and not 0.0 <= self.variance < math.inf:
            raise InvalidInput(f"the variance of a pressure is 0 or more [Pa^2]; got {self.variance}")


class MapDatum(StampedMessage, frozen=True, array_like=True, gc=False):
    """The point of the Earth at the origin of the map ``frame``, named as in edges: x is east, y north, z up.

    ``latitude`` and ``longitude`` [deg] and ``altitude`` [m] above the ellipsoid are those of WGS84.
    """

    frame: str
    latitude: float
    longitude: float
    altitude: float

    def __post_init__(self) -> None:
        check_frame(self.frame)
        check_geodetic(self.latitude, self.longitude, self.altitude)

    @property
    def datum(self) -> Datum:
        """The same, with its methods."""
        return Datum(self.latitude, self.longitude, self.altitude)


SensorMessage: TypeAlias = Imu | Velocity | Pose | Fix | MagneticField | Pressure | Odometry

_Measurement = TypeVar("_Measurement", bound=SensorMessage)


def with_full_names(message: _Measurement, robot: str) -> _Measurement:
    """The same message of ``robot`` with the full names of its frames. Raises InvalidInput."""
    if isinstance(message, Pose):
        parent, child = full_name(robot, message.parent), message.child and full_name(robot, message.child)
        return msgspec.structs.replace(message, parent=parent, child=child)
    if isinstance(message, Odometry):
        assert message.edges is not None
        edges = tuple((full_name(robot, parent), full_name(robot, child)) for parent, child in message.edges)
        return msgspec.structs.replace(message, edges=edges, order=order_digest(edges))
    return msgspec.structs.replace(message, frame=full_name(robot, message.frame))


def earlier(message: _Measurement, delay_ns: int) -> _Measurement:
    """The same message with a stamp that is ``delay_ns`` before its own."""
    return msgspec.structs.replace(message, stamp=message.stamp - delay_ns)


def frame_of(message: SensorMessage) -> str:
    """The frame that was measured; empty for a pose of the base of the robot."""
    if isinstance(message, Odometry):
        assert message.edges is not None
        return message.edges[0][1]
    return message.child if isinstance(message, Pose) else message.frame
