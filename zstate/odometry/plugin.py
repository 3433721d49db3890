"""What odometry brings: the streams of its sensors, and of its result; and commands."""

from zstate.plugins import Command, Plugin
from zstate.streams import Stream

_MESSAGES = "zstate.odometry.messages"

IMU = Stream(
    "imu",
    f"{_MESSAGES}:Imu",
    summary="angular velocity and acceleration of a sensor",
    named=True,
    start="start the program of the sensor, with its zstate.odometry.ImuPublisher",
    ros="zstate.odometry.ros2:IMU_STREAM",
    document="zstate.odometry.documents:imu_document",
)
VELOCITY = Stream(
    "velocity",
    f"{_MESSAGES}:Velocity",
    summary="measured velocity of a frame",
    named=True,
    start="start the program of the sensor, with its zstate.odometry.VelocityPublisher",
    ros="zstate.odometry.ros2:VELOCITY_STREAM",
    document="zstate.odometry.documents:velocity_document",
)
POSE = Stream(
    "pose",
    f"{_MESSAGES}:Pose",
    summary="measured pose of a frame",
    named=True,
    start="start the program of the sensor, with its zstate.odometry.PosePublisher",
    ros="zstate.odometry.ros2:POSE_STREAM",
    document="zstate.odometry.documents:pose_document",
)
FIX = Stream(
    "fix",
    f"{_MESSAGES}:Fix",
    summary="position of a satellite receiver's antenna on the Earth",
    named=True,
    start="start the program of the receiver, with its zstate.odometry.FixPublisher",
    ros="zstate.odometry.ros2:FIX_STREAM",
    document="zstate.odometry.documents:fix_document",
)
PRESSURE = Stream(
    "pressure",
    f"{_MESSAGES}:Pressure",
    summary="pressure at a barometer",
    named=True,
    start="start the program of the barometer, with its zstate.odometry.PressurePublisher",
    ros="zstate.odometry.ros2:PRESSURE_STREAM",
    document="zstate.odometry.documents:pressure_document",
)
DATUM = Stream(
    "datum",
    f"{_MESSAGES}:MapDatum",
    summary="the place on the Earth of the origin of a map",
    named=True,
    latched=True,
    start="start one: `zstate odometry {robot} --fix SENSOR`",
    document="zstate.odometry.documents:datum_document",
)
MAGNETIC_FIELD = Stream(
    "magnetic_field",
    f"{_MESSAGES}:MagneticField",
    summary="magnetic field at a sensor",
    named=True,
    start="start the program of the sensor, with its zstate.odometry.MagneticFieldPublisher",
    ros="zstate.odometry.ros2:MAGNETIC_FIELD_STREAM",
    document="zstate.odometry.documents:magnetic_field_document",
)
ODOMETRY = Stream(
    "odometry",
    f"{_MESSAGES}:Odometry",
    summary="pose and velocity of a base, with covariances",
    group="edges",
    named=True,
    start="start one: `zstate odometry {robot} --imu SENSOR`",
    ros="zstate.odometry.ros2:ODOMETRY_STREAM",
    document="zstate.odometry.documents:odometry_document",
)

PLUGIN = Plugin(
    "odometry",
    streams=(IMU, VELOCITY, POSE, FIX, MAGNETIC_FIELD, PRESSURE, DATUM, ODOMETRY),
    commands={
        "odometry": Command(
            "zstate.odometry.cli.odometry:odometry_command",
            "Write",
            "Publish where the base of a robot is, from its IMU and its wheels.",
        ),
    },
    synonyms={
        "ekf_node": "odometry",
        "navsat_transform": "odometry",
        "robot_localization": "odometry",
    },
    checks="zstate.odometry.cli.checks:DatumChecks",
)
