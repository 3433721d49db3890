"""The kinds of sensors that an odometry takes: their streams, and how a message is passed to the estimators.

Live odometry (``node.py``), recordings and the command line know no kind by name: they go through ``KINDS``.
What its noise is and may be is in ``source_noise.py``, and its option is in the command.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from zstate.checks import Floats
from zstate.errors import InvalidInput
from zstate.odometry.estimator import BaseEstimator
from zstate.odometry.magnetism import EarthField, check_strength, earth_field
from zstate.odometry.map_estimator import MapEstimator
from zstate.odometry.messages import Fix, Imu, MagneticField, Odometry, Pose, Pressure, Velocity, earlier
from zstate.odometry.source_noise import (
    POSE_AXES,
    VELOCITY_AXES,
    BarometerNoise,
    FixNoise,
    HeadingNoise,
    MagnetometerNoise,
    PoseNoise,
    RelativeNoise,
    SensorNoise,
    VelocityNoise,
    axis_rows,
)
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.keys import check_writer
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import from_block


class Estimators(NamedTuple):
    """That of the odometry, and what places it in a map, if anything does."""

    odometry: BaseEstimator
    in_map: MapEstimator | None = None


class MeasuredMotion(NamedTuple):
    """What messages show of the motion of a base, each (n,): its yaw or the rate of that, its speed ahead."""

    yaw: Floats | None = None
    """[rad]"""
    yaw_rate: Floats | None = None
    """[rad/s]"""
    speed: Floats | None = None
    """[m/s]"""


@dataclass(frozen=True, eq=False)
class SensorKind:
    """What makes the messages of ``streams`` a source.

    ``name`` is that of its option and of its table of settings, which have the fields of ``noise``. A sensor
    of a kind with several streams is named with that of its own, as "odometry/camera".
    ``add(estimators, sensor, noise, message)`` passes a message on; ``covariance(sensor, noise, message)`` is
    that of its numbers, None if only the estimator knows it. Both raise InvalidInput, with what to do, if
    the noise is not known, and for a message that measures nothing. ``is_enough``: with an IMU and nothing
    else it keeps the place from drifting by metres in seconds. ``text`` tells of a source, by its sensor.

    ``motion(messages, base_from)`` is what they show of the motion of the base; ``base_from(frame)`` is the
    rotation of a frame on it, (3, 3).

    In a first file of settings, ``left_out(messages, odom)`` is why it is not used by default: empty if it
    is, None if the messages are not of this kind. ``variances(message)`` are those that a message states,
    None if it does not, and ``sigmas`` makes settings of their roots; ``usual`` are settings in their place.
    """

    name: str
    streams: tuple[StreamName, ...]
    noise: type[SensorNoise]
    add: Callable[[Estimators, str, Any, Any], None]
    covariance: Callable[[str, Any, Any], Floats | None] | None = None
    is_enough: bool = False
    text: str = "{!r}"
    motion: Callable[[Sequence[Any], Callable[[str], Floats]], MeasuredMotion] | None = None
    left_out: Callable[[Sequence[Any], str], str | None] = lambda messages, odom: ""
    variances: Callable[[Any], Floats | None] = lambda message: None
    sigmas: Callable[[Floats], Mapping[str, Floats]] = lambda sigmas: {"sigma": sigmas}
    usual: Mapping[str, float] = field(default_factory=dict[str, float])


class Sensor(NamedTuple):
    """One sensor of a robot, as it is named in settings, with what is stated of its noise."""

    kind: SensorKind
    name: str
    noise: SensorNoise

    @property
    def stream(self) -> StreamName:
        """That of its messages."""
        return self.kind.streams[0] if len(self.kind.streams) == 1 else self.name.partition("/")[0]

    @property
    def writer(self) -> str:
        """Its name in the stream."""
        return self.name if len(self.kind.streams) == 1 else self.name.partition("/")[2]

    def check(self) -> None:
        """Raise InvalidInput for a name that no sensor of this kind can have."""
        if self.stream not in self.kind.streams:
            names = " or ".join(f"{one}/NAME" for one in self.kind.streams)
            raise InvalidInput(f"a source of {self.kind.name!r} is {names}; got {self.name!r}")
        check_writer(self.writer)

    def __str__(self) -> str:
        return self.kind.text.format(self.name)

    def check_live(self, wire: str) -> None:
        """Raise InvalidInput for what can be a source in a recording and not on ``wire``.

        On the native wire odometry is an edge of the tree. In ROS it is a measurement: its edge is on /tf.
        """
        if self.stream == "odometry" and wire == "native":
            raise InvalidInput(
                f"{self.name} places a frame as this odometry does, and a frame has one place: publish its "
                f"poses by PosePublisher, and name pose/{self.writer}. Recordings and `--wire ros2` take "
                f"{self.name} as it is"
            )

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


def velocity_motion(messages: Sequence[Velocity], base_from: Callable[[str], Floats]) -> MeasuredMotion:
    """Their speed, and the rate of their yaw if all of them measure it."""
    rotation = base_from(messages[0].frame)
    speed = (np.array([from_block(one.linear) for one in messages]) @ rotation.T)[:, 0]
    rates = [from_block(one.angular) for one in messages if one.angular is not None]
    yaw_rate = (np.array(rates) @ rotation.T)[:, 2] if len(rates) == len(messages) else None
    return MeasuredMotion(yaw_rate=yaw_rate, speed=speed)


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


def pose_motion(messages: Sequence[Pose | Odometry], base_from: object) -> MeasuredMotion:
    """Their yaw."""
    blocks = [one.poses if isinstance(one, Odometry) else one.pose for one in messages]
    x, y, z, w = np.array([from_block(block)[3:] for block in blocks]).T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return MeasuredMotion(yaw=np.unwrap(yaw))


def _parents(messages: Sequence[Pose | Odometry]) -> set[str]:
    """The frames in which measured poses are."""
    return {one.parent for one in messages if isinstance(one, Pose)}


def _pose_left_out(messages: Sequence[Pose], odom: str) -> str:
    if (parents := _parents(messages)) == {odom}:
        return ""
    return f"its poses are in {', '.join(sorted(parents))}, not in {odom}; see [relative]"


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
    """Pass the yaw of the orientation of an IMU to the odometry, as a source apart from its rates."""
    sigma = math.sqrt(float(heading_covariance(sensor, noise, message)[0, 0]))
    assert message.orientation is not None
    x, y, z, w = from_block(message.orientation).tolist()
    yaw = math.atan2(2.0 * (x * y + z * w), 1.0 - 2.0 * (y * y + z * z))
    estimators.odometry.heading(
        message.stamp, yaw, sigma, source=f"{sensor} heading", frame=message.frame, gate=noise.gate
    )


def _heading_left_out(messages: Sequence[Imu], odom: str) -> str | None:
    if all(one.orientation is None for one in messages):
        return None
    return "motors and floors turn a compass; see the guide"


def relative_covariance(sensor: str, noise: RelativeNoise, message: Pose | Odometry) -> None:
    """None: that of a displacement is by two poses. Raises InvalidInput for covariances that are needed."""
    known = message.covariances if isinstance(message, Odometry) else message.covariance
    if noise.covariance != "stated" and known is None:
        raise InvalidInput(
            f"poses of {sensor!r} have no covariance that could be {noise.covariance}; leave `covariance` "
            "out, and state sigma [m per square root of a metre] and sigma_deg of its displacements"
        )


def add_relative(estimators: Estimators, sensor: str, noise: RelativeNoise, message: Pose | Odometry) -> None:
    """Pass a pose of another odometry to the odometry, which uses its displacements."""
    base = estimators.odometry
    if isinstance(message, Odometry):
        assert message.edges is not None
        ((world, frame),) = message.edges
        numbers, known = message.poses, message.covariances
    else:
        world, frame, numbers, known = message.parent, message.child, message.pose, message.covariance
    pose = Transform.from_pose7(world, frame or base.base, from_block(numbers))
    covariance = None if known is None else covariance_matrix(known)
    base.relative_pose(message.stamp, pose, covariance, source=sensor, noise=noise)


def _relative_left_out(messages: Sequence[Pose | Odometry], odom: str) -> str | None:
    if all(isinstance(one, Pose) and one.parent == odom for one in messages):
        return None
    return "for another odometry, of which only the motion counts; not for a pose in a map by GPS"


def magnetometer_covariance(sensor: str, noise: MagnetometerNoise, message: MagneticField) -> Floats:
    """That of the yaw by a magnetic field [rad^2], (1, 1).

    Raises InvalidInput for a field in which no compass works, and as ``expected_field``.
    """
    field = noise.calibrated(from_block(message.field))
    check_strength(math.sqrt(field @ field), sensor)
    expected_field(noise, message)
    return np.array([[math.radians(noise.sigma_deg) ** 2]])


def expected_field(noise: MagnetometerNoise, message: MagneticField) -> EarthField | None:
    """The field of the Earth at the place of a magnetometer, if that is stated. Raises as ``earth_field``."""
    return None if noise.place is None else earth_field(*noise.place, message.stamp)


def add_magnetic_field(
    estimators: Estimators, sensor: str, noise: MagnetometerNoise, message: MagneticField
) -> None:
    """Pass one magnetic field to the odometry, whose attitude levels it."""
    estimators.odometry.magnetic_field(
        message.stamp,
        noise.calibrated(from_block(message.field)),
        math.radians(noise.sigma_deg),
        source=f"{sensor} field",
        frame=message.frame,
        expected=expected_field(noise, message),
        gate=noise.gate,
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


def fix_variances(message: Fix) -> Floats | None:
    """Those of x, y and z [m^2] that a fix states; None unless all are above zero."""
    if message.covariance is None:
        return None
    variances = np.diag(covariance_matrix(message.covariance))
    return variances if (variances > 0.0).all() else None


def barometer_covariance(sensor: str, noise: BarometerNoise, message: Pressure) -> Floats:
    """That of the height [m^2], (1, 1), without what weather does: by ``noise``, else of the message.

    Raises InvalidInput as ``velocity_covariance``.
    """
    sigma = noise.height_sigma(message.pressure, message.variance)
    if sigma is None:
        raise InvalidInput(
            f"pressures of {sensor!r} have no variance: state the noise of their heights by `--barometer "
            f"{sensor}:sigma=0.5`, or sigma = 0.5 [m] in [barometer.{sensor}] of the settings"
        )
    return np.array([[sigma**2]])


def add_pressure(estimators: Estimators, sensor: str, noise: BarometerNoise, message: Pressure) -> None:
    """Pass the height by one pressure to the odometry."""
    estimators.odometry.height(
        message.stamp,
        noise.height(message.pressure),
        math.sqrt(float(barometer_covariance(sensor, noise, message)[0, 0])),
        source=sensor,
        frame=message.frame,
        wander=noise.wander,
        correlated_s=noise.correlated_s,
        gate=noise.gate,
    )


def _unknown(covariance: Floats | None) -> str:
    return "no covariance" if covariance is None else "a covariance with variances that are not above zero"


def _variances_by(
    covariance: Callable[[str, Any, Any], Floats], noise: SensorNoise
) -> Callable[[Any], Floats | None]:
    """The variances that a message states: without any, ``covariance`` refuses it with such a ``noise``."""

    def variances(message: Any) -> Floats | None:
        try:
            return np.diag(covariance("", noise, message))
        except InvalidInput:
            return None

    return variances


def _see_the_guide(messages: object, odom: object) -> str:
    return "see the guide"


KINDS = (
    SensorKind(
        "velocity",
        ("velocity",),
        VelocityNoise,
        add_velocity,
        velocity_covariance,
        is_enough=True,
        motion=velocity_motion,
        variances=_variances_by(velocity_covariance, VelocityNoise()),
        usual={"sigma": 0.05},
    ),
    SensorKind(
        "pose",
        ("pose",),
        PoseNoise,
        add_pose,
        pose_covariance,
        is_enough=True,
        motion=pose_motion,
        left_out=_pose_left_out,
        variances=_variances_by(pose_covariance, PoseNoise()),
        sigmas=lambda sigmas: {"sigma": sigmas[:3], "sigma_deg": np.degrees(sigmas[3:])},
        usual={"sigma": 0.02, "sigma_deg": 1.0},
    ),
    SensorKind(
        "relative",
        ("pose", "odometry"),
        RelativeNoise,
        add_relative,
        relative_covariance,
        is_enough=True,
        text="the motion by {!r}",
        motion=pose_motion,
        left_out=_relative_left_out,
    ),
    SensorKind(
        "heading",
        ("imu",),
        HeadingNoise,
        add_heading,
        heading_covariance,
        text="the heading of {!r}",
        left_out=_heading_left_out,
        variances=_variances_by(heading_covariance, HeadingNoise()),
        sigmas=lambda sigmas: {"sigma_deg": np.degrees(sigmas)},
        usual={"sigma_deg": 5.0},
    ),
    SensorKind(
        "magnetometer",
        ("magnetic_field",),
        MagnetometerNoise,
        add_magnetic_field,
        magnetometer_covariance,
        text="the magnetometer {!r}",
        left_out=_see_the_guide,
    ),
    SensorKind(
        "fix",
        ("fix",),
        FixNoise,
        add_fix,
        variances=fix_variances,
        sigmas=lambda sigmas: {"sigma": np.array((sigmas[:2].max(), sigmas[2]))},
        usual={"sigma": 2.5},
    ),
    SensorKind(
        "barometer",
        ("pressure",),
        BarometerNoise,
        add_pressure,
        barometer_covariance,
        left_out=_see_the_guide,
        variances=_variances_by(barometer_covariance, BarometerNoise()),
        usual={"sigma": 0.5},
    ),
)

SENSOR_STREAMS = tuple(dict.fromkeys(("imu", *(stream for kind in KINDS for stream in kind.streams))))
"""Those that an odometry may read."""

_BY_NOISE = {kind.noise: kind for kind in KINDS}


def sensor(name: str, noise: SensorNoise) -> Sensor:
    """The sensor ``name`` of the kind that has such a noise.

    Raises InvalidInput for another noise, and for a name that no sensor of this kind can have.
    """
    if type(noise) not in _BY_NOISE:
        known = ", ".join(kind.__name__ for kind in _BY_NOISE)
        raise InvalidInput(f"the noise of the sensor {name!r} is one of {known}; got {noise!r}")
    found = Sensor(_BY_NOISE[type(noise)], name, noise)
    found.check()
    return found
