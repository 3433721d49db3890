"""Publishers of the sensors of a moving base, of its odometry, and of the datum of its map."""

from __future__ import annotations

from collections.abc import Sequence
from operator import index
from typing import ClassVar

from numpy.typing import ArrayLike

from zstate.checks import real_numbers
from zstate.clock import Clock, SystemClock, check_stamp
from zstate.covariance import check_covariance
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.net.writer import write_all
from zstate.nodes.measurement_publisher import MeasurementPublisher
from zstate.nodes.robot_writer import RobotWriter
from zstate.nodes.static_publisher import ValuePublisher
from zstate.nodes.transform_publisher import EdgePublisher, covariance_block
from zstate.odometry.geodesy import Datum
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
from zstate.streams import StreamName
from zstate.transform import UPPER_TRIANGLE, Transform
from zstate.wire.keys import check_writer, full_name
from zstate.wire.messages import to_block


class _SensorPublisher(MeasurementPublisher):
    """Base of the publishers of one sensor that measures in the axes of ``frame``."""

    _stream: ClassVar[StreamName]

    def __init__(
        self,
        session: Session,
        robot: str,
        sensor: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        frame: str | None = None,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        sensor = self._stream if sensor is None else sensor
        self.frame = sensor if frame is None else frame
        full_name(robot, self.frame)  # raises here, where the mistake is made
        super().__init__(session, robot, self._stream, sensor, wires=wires, clock=clock, program=program)


class ImuPublisher(_SensorPublisher):
    """Publishes the readings of one inertial measurement unit of a robot.

    ``sensor`` is its name, in ROS its topic; by default that of the stream. Its axes are those of ``frame``,
    by default a frame of the sensor's name; a bare name is the robot's own. ``gyro_covariance``
    [rad^2/s^2] and ``accel_covariance`` [m^2/s^4], (3, 3), are published with each reading if they are given.

    ``wires`` are what it publishes on, "native" (the default), "ros2" with options, or several. ``clock``
    gives the stamps of readings without one; default: the system's. ``program`` is the writer's name for
    others; default: the script's name.

    Under congestion readings are dropped, and joining listeners receive none from the past. On the native
    wire each sensor has one writer: SecondWriter, which names the first one, is raised if another writer
    publishes it, or by ``publish`` if both opened at once, which closes the later one. A context manager;
    safe from any thread.
    """

    _stream = "imu"

    def __init__(
        self,
        session: Session,
        robot: str,
        sensor: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        frame: str | None = None,
        gyro_covariance: ArrayLike | None = None,
        accel_covariance: ArrayLike | None = None,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        self._covariances = (
            _covariance(gyro_covariance, "gyro_covariance", 3),
            _covariance(accel_covariance, "accel_covariance", 3),
        )
        super().__init__(session, robot, sensor, wires, frame=frame, clock=clock, program=program)

    def publish(
        self,
        gyro: ArrayLike,
        accel: ArrayLike,
        stamp: int | None = None,
        *,
        orientation: ArrayLike | None = None,
        orientation_covariance: ArrayLike | None = None,
    ) -> None:
        """Publish one reading at ``stamp`` [ns]; default: now.

        ``gyro`` [rad/s] and ``accel`` [m/s^2], specific force, are x y z. ``orientation`` is the quaternion
        x y z w of the frame in axes that the device defines; ``orientation_covariance`` [rad^2], (3, 3), is
        given if it is known. Raises InvalidInput for numbers that are not finite, for other shapes and for a
        quaternion whose length is not 1; SecondWriter; and Closed. If it raises, nothing was sent.
        """
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            turn = None if orientation is None else _numbers(orientation, "orientation", 4)
            turn_covariance = _covariance(orientation_covariance, "orientation_covariance", 3)
            vectors = _numbers(gyro, "gyro", 3), _numbers(accel, "accel", 3)
            self._send(Imu(stamp, 0, 0, self.frame, *vectors, turn, *self._covariances, turn_covariance))


class VelocityPublisher(_SensorPublisher):
    """Publishes the velocities that one sensor of a robot measures: optical flow, a Doppler log, a leg.

    A velocity is that of ``frame`` relative to the world, in its own axes. ``robot``, ``sensor``,
    ``wires``, ``frame``, ``clock`` and ``program``, writers and threads are those of ``ImuPublisher``.
    """

    _stream = "velocity"

    def publish(
        self,
        linear: ArrayLike,
        angular: ArrayLike | None = None,
        stamp: int | None = None,
        *,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Publish one velocity at ``stamp`` [ns]; default: now.

        ``linear`` [m/s] is that of the frame's origin, x y z; ``angular`` [rad/s] is left out if it is not
        measured. ``covariance`` is (3, 3) of ``linear``, or (6, 6) of both; leave it out if it is not known.
        Raises as ``ImuPublisher.publish``.
        """
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            turn = None if angular is None else _numbers(angular, "angular", 3)
            triangle = _covariance(covariance, "covariance", 3 if angular is None else 6)
            vector = _numbers(linear, "linear", 3)
            self._send(Velocity(stamp, 0, 0, self.frame, vector, turn, triangle))


class PosePublisher(MeasurementPublisher):
    """Publishes the poses that one sensor of a robot measures: motion capture, a marker, a scan matcher.

    They are measurements, no edges: no lookup uses them. In ROS the message names the parent alone, and
    readers take the child for the base of the robot. ``robot``, ``sensor``, ``wires``, ``clock`` and
    ``program``, writers and threads are those of ``ImuPublisher``.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        sensor: str = "pose",
        wires: str | Sequence[str] = ("native",),
        *,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        super().__init__(session, robot, "pose", sensor, wires=wires, clock=clock, program=program)

    def publish(self, parent_from_child: Transform, stamp: int | None = None) -> None:
        """Publish one pose, with its covariance if that is known, at ``stamp`` [ns].

        The default stamp is that of the transform, or now if it has none. Bare frame names are the robot's
        own. Raises as ``ImuPublisher.publish``.
        """
        with self._refusals:
            if stamp is None:
                stamp = self._clock.now() if parent_from_child.stamp is None else parent_from_child.stamp
            stamp = check_stamp(stamp)
            parent, child = parent_from_child.target, parent_from_child.source
            for frame in (parent, child):
                full_name(self.robot, frame)
            pose, covariance = to_block(parent_from_child.pose7), parent_from_child.covariance
            triangle = None if covariance is None else to_block(covariance[UPPER_TRIANGLE])
            self._send(Pose(stamp, 0, 0, parent, child, pose, triangle))


class FixPublisher(_SensorPublisher):
    """Publishes the positions of one satellite receiver (GPS, GNSS) of a robot on the Earth.

    A position is that of the antenna, the origin of ``frame``. ``robot``, ``sensor``, ``wires``, ``frame``,
    ``clock`` and ``program``, writers and threads are those of ``ImuPublisher``.
    """

    _stream = "fix"

    def publish(
        self,
        latitude: float | None,
        longitude: float | None,
        altitude: float | None = None,
        stamp: int | None = None,
        *,
        covariance: ArrayLike | None = None,
        covariance_type: int = 3,
        status: int = 0,
        service: int = 0,
    ) -> None:
        """Publish one fix, or that there is none, at ``stamp`` [ns], the time of the fix; default: now.

        ``latitude`` and ``longitude`` [deg] are those of WGS84, north and east positive, and ``altitude`` [m]
        is above its ellipsoid: add the separation of the geoid to a height above the sea; leave it out if it
        is not known. ``covariance`` [m^2] is (3, 3) in the axes east, north, up; leave it out if it is not
        known. ``covariance_type`` is 1 for an approximation, as from the dilution of precision, 2 if only the
        diagonal is known. ``status`` and ``service`` are those of sensor_msgs/NavSatStatus: status 1 or 2 for
        a fix with satellite- or ground-based augmentation, and ``publish(None, None, status=-1)`` without a
        fix. Raises as ``ImuPublisher.publish``.
        """
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            position = _number(latitude, "latitude"), _number(longitude, "longitude")
            triangle = _covariance(covariance, "covariance", 3)
            self._send(
                Fix(
                    *(stamp, 0, 0, self.frame, *position, _number(altitude, "altitude")),
                    *(index(status), index(service)),
                    *(triangle, 0 if triangle is None else index(covariance_type)),
                )
            )


class PressurePublisher(_SensorPublisher):
    """Publishes the readings of one barometer of a robot.

    ``robot``, ``sensor``, ``wires``, ``frame``, ``clock`` and ``program``, writers and threads are those of
    ``ImuPublisher``.
    """

    _stream = "pressure"

    def publish(self, pressure: float, stamp: int | None = None, *, variance: float | None = None) -> None:
        """Publish one absolute ``pressure`` [Pa] at ``stamp`` [ns]; default: now.

        Leave ``variance`` [Pa^2] out if it is not known. Raises as ``ImuPublisher.publish``.
        """
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            reading = _number(pressure, "pressure")
            if reading is None:
                raise InvalidInput("a pressure is a number [Pa]; got None")
            self._send(Pressure(stamp, 0, 0, self.frame, reading, _number(variance, "variance")))


class DatumPublisher(ValuePublisher):
    """Publishes where on the Earth the origin of a map is, latched: readers that join later receive it too.

    ``frame`` is the map, whose x is east, y north and z up; a bare name is the robot's own. ``writer``
    distinguishes maps of one robot. ``program`` is the writer's name for others, by default the script's
    name. ``close()`` withdraws it. SecondWriter is raised as by ``MapPublisher``.
    ROS has no message for it. A context manager.
    """

    def __init__(
        self, session: Session, robot: str, frame: str = "map", *, writer: str = "map", program: str = ""
    ) -> None:
        full_name(robot, frame)
        self._frame = frame
        self.datum: Datum | None = None
        """The one that was published last."""
        out = RobotWriter(session, robot, ("native",), program)
        out.title = f"the datum publisher {writer!r}"
        super().__init__(out, "datum", check_writer(writer))

    def set(self, datum: Datum) -> None:
        """Publish ``datum`` in place of the last one. Raises Closed."""
        out = self._out
        with out.lock:
            out.check_open()
            place = datum.latitude, datum.longitude, datum.altitude
            message = MapDatum(SystemClock().now(), out.seq, out.session_id, self._frame, *place)
            write_all(self._latched, message)
            out.seq += 1
            self.datum = datum


class MagneticFieldPublisher(_SensorPublisher):
    """Publishes the magnetic fields that one magnetometer of a robot measures, in the axes of ``frame``.

    ``covariance`` [T^2], (3, 3), is published with each of them if it is given. ``robot``, ``sensor``,
    ``wires``, ``frame``, ``clock`` and ``program``, writers and threads are those of ``ImuPublisher``.
    """

    _stream = "magnetic_field"

    def __init__(
        self,
        session: Session,
        robot: str,
        sensor: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        frame: str | None = None,
        covariance: ArrayLike | None = None,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        self._covariance = _covariance(covariance, "covariance", 3)
        super().__init__(session, robot, sensor, wires, frame=frame, clock=clock, program=program)

    def publish(self, field: ArrayLike, stamp: int | None = None) -> None:
        """Publish one field at ``stamp`` [ns]; default: now.

        ``field`` is x y z in tesla: 1 uT is 1e-6 T, and 1 gauss 1e-4 T. Raises as ``ImuPublisher.publish``,
        and InvalidInput for more than 1 T.
        """
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            vector = _numbers(field, "field", 3)
            self._send(MagneticField(stamp, 0, 0, self.frame, vector, self._covariance))


class OdometryPublisher(EdgePublisher):
    """Publishes where the base of a robot is, and how fast it moves: the edge odom -> base_link and a twist.

    Listeners take it as a moving edge. ``robot``, ``wires``, ``clock``, ``program`` and ``cache_s``, frames,
    writers and threads are those of ``TransformPublisher``: on the native wire each edge has one writer, of
    transforms or of odometry. On the ROS wires it is a nav_msgs/Odometry on a topic of the name ``writer``,
    and the edge on /tf.
    """

    _stream = "odometry"
    _numbers = 60

    def __init__(
        self,
        session: Session,
        robot: str,
        writer: str | None = "odometry",
        wires: str | Sequence[str] = ("native",),
        *,
        clock: Clock | None = None,
        program: str = "",
        cache_s: float = 2.0,
    ) -> None:
        super().__init__(session, robot, writer, wires, clock=clock, program=program, cache_s=cache_s)

    def publish(
        self,
        odom_from_base: Transform,
        linear: ArrayLike,
        angular: ArrayLike,
        stamp: int | None = None,
        *,
        twist_covariance: ArrayLike | None = None,
    ) -> None:
        """Publish the pose of the base, with its covariance if known, and its velocity at ``stamp`` [ns].

        ``odom_from_base`` is the pose; its frames are those of the edge. The default stamp is that of the
        transform, or now if it has none. ``linear`` [m/s], the velocity of the base's origin relative to the
        odometry frame, and ``angular`` [rad/s] are x y z in the axes of the base; ``twist_covariance`` is
        (6, 6) of both. Raises as ``TransformPublisher.publish``.
        """
        with self._refusals:
            if stamp is None:
                stamp = self._clock.now() if odom_from_base.stamp is None else odom_from_base.stamp
            stamp = check_stamp(stamp)
            pose, names = to_block(odom_from_base.pose7), ((odom_from_base.target, odom_from_base.source),)
            twist = _numbers(linear, "linear", 3) + _numbers(angular, "angular", 3)
            covariances = covariance_block([odom_from_base])
            spread = _covariance(twist_covariance, "twist_covariance", 6)
            out = self._out
            with out.lock:
                out.check()
                head = (stamp, out.seq, out.session_id, self._order(names))
                out.send(Odometry(*head, pose, names, covariances, twist, spread))


def _numbers(values: ArrayLike, name: str, count: int) -> bytes:
    """The block of ``count`` numbers; the message checks that they are finite."""
    array = real_numbers(values, name)
    if array.shape != (count,):
        raise InvalidInput(
            f"{name} takes {count} numbers, (x, y, z{', w' * (count == 4)}); got shape {array.shape}"
        )
    return to_block(array)


def _number(value: float | None, name: str) -> float | None:
    """One number, None if it is not known."""
    if value is None:
        return None
    array = real_numbers(value, name)
    if array.shape:
        raise InvalidInput(f"{name} is one number; got shape {array.shape}")
    return float(array)


def _covariance(values: ArrayLike | None, name: str, size: int) -> bytes | None:
    """The block of the upper triangle of a covariance (size, size), None if it is not known."""
    return None if values is None else to_block(check_covariance(values, name, size))
