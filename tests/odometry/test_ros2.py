"""IMUs, velocities, fixes, magnetic fields and odometry as ROS 2 messages, against those of rosbags."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.manual_cdr import STORE, rosbags_cdr, rosbags_time
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic
from numpy.typing import NDArray

from zstate.errors import InvalidInput, MessageError
from zstate.odometry.messages import (
    MAX_RATE,
    MAX_SPEED,
    Fix,
    Imu,
    MagneticField,
    Odometry,
    Pose,
    Pressure,
    Velocity,
)
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import Message, from_block, order_digest, to_block
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.options import Ros2Options
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

STAMP = 1_700_000_000_123_456_789
PLAIN, PREFIXED = FrameNames(Ros2Options(), "r1"), FrameNames(Ros2Options(frame_prefix="r1/"), "r1")
HEAD = (STAMP, 5, 77)
POSE, TWIST = [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
EDGE = (("odom", "base"),)


def symmetric(size: int, first: float = 1.0) -> NDArray[np.float64]:
    """A matrix whose numbers all differ but for the symmetry."""
    matrix = np.zeros((size, size))
    upper = np.triu_indices(size)
    matrix[upper] = matrix.T[upper] = first + np.arange(len(upper[0]))
    return matrix


def triangle(matrix: NDArray[np.float64]) -> bytes:
    return to_block(matrix[np.triu_indices(len(matrix))])


def header(frame: str) -> object:
    return STORE.types["std_msgs/msg/Header"](rosbags_time(STAMP), frame)


def vector(kind: str, numbers: Any) -> object:
    return STORE.types[f"geometry_msgs/msg/{kind}"](*map(float, numbers))


def rosbags_imu(orientation: Any, covariances: Any, frame: str = "imu", **options: bool) -> bytes:
    turn, gyro, accel = (np.array(one, dtype=float).ravel() for one in covariances)
    gyro_vector, accel_vector = vector("Vector3", [1, 2, 3]), vector("Vector3", [4, 5, 6])
    fields = (vector("Quaternion", orientation), turn, gyro_vector, gyro, accel_vector, accel)
    return rosbags_cdr(IMU.name, header(frame), *fields, **options)


def rosbags_twist(numbers: Any, covariance: Any) -> object:
    twist = STORE.types["geometry_msgs/msg/Twist"](
        vector("Vector3", numbers[:3]), vector("Vector3", numbers[3:])
    )
    matrix = np.array(covariance, dtype=float).ravel()
    return STORE.types["geometry_msgs/msg/TwistWithCovariance"](twist, matrix)


def rosbags_velocity(numbers: Any, covariance: Any, frame: str = "base", **options: bool) -> bytes:
    return rosbags_cdr(
        TWIST_WITH_COVARIANCE.name, header(frame), rosbags_twist(numbers, covariance), **options
    )


def rosbags_pose_part(covariance: Any, rotation: Any = POSE[3:]) -> object:
    pose = STORE.types["geometry_msgs/msg/Pose"](vector("Point", POSE[:3]), vector("Quaternion", rotation))
    matrix = np.array(covariance, dtype=float).ravel()
    return STORE.types["geometry_msgs/msg/PoseWithCovariance"](pose, matrix)


def rosbags_pose(covariance: Any, rotation: Any = POSE[3:], frame: str = "map") -> bytes:
    return rosbags_cdr(POSE_WITH_COVARIANCE.name, header(frame), rosbags_pose_part(covariance, rotation))


def rosbags_fix(
    position: Any,
    covariance: Any,
    kind: int = 3,
    status: int = 0,
    service: int = 0,
    **options: bool,
) -> bytes:
    state = STORE.types["sensor_msgs/msg/NavSatStatus"](status, service)
    matrix = np.array(covariance, dtype=float).ravel()
    fields = (header("gps"), state, *map(float, position), matrix, kind)
    return rosbags_cdr(NAV_SAT_FIX.name, *fields, **options)


def rosbags_pressure(pressure: float, variance: float, **options: bool) -> bytes:
    return rosbags_cdr(FLUID_PRESSURE.name, header("barometer"), pressure, variance, **options)


def rosbags_magnetic_field(field: Any, covariance: Any, **options: bool) -> bytes:
    matrix = np.array(covariance, dtype=float).ravel()
    return rosbags_cdr(MAGNETIC_FIELD.name, header("mast"), vector("Vector3", field), matrix, **options)


def rosbags_odometry(
    pose_covariance: Any, twist_covariance: Any, parent: str = "odom", **options: bool
) -> bytes:
    parts = rosbags_pose_part(pose_covariance), rosbags_twist(TWIST, twist_covariance)
    return rosbags_cdr(ODOMETRY.name, header(parent), "base", *parts, **options)


def encoded(message: Message, names: FrameNames = PLAIN) -> bytes:
    return RosStreamEncoder(names, SampleLayout()).encode(message)


def decoded(stream: Any, payload: bytes, names: FrameNames = PLAIN) -> Any:
    (message,) = RosDecoder().messages(stream, payload, 77, 5, names)
    return message


def imu(**changed: Any) -> Imu:
    return Imu(
        *HEAD, **{"frame": "imu", "gyro": to_block([1, 2, 3]), "accel": to_block([4, 5, 6]), **changed}
    )


NONE, ABSENT = np.zeros((3, 3)), [-1.0, *[0.0] * 8]
NAN3 = [np.nan] * 3
LINEAR_ONLY = np.full((6, 6), np.nan)
LINEAR_ONLY[:3, :3] = symmetric(3)
PLACE = (47.5, -8.25, 450.0)
FIELD = (21.5e-6, -1.25e-6, -43.75e-6)
ODOMETRY_HEAD = (*HEAD, order_digest(EDGE), to_block(POSE), EDGE)

CASES = [
    ("imu", imu(), rosbags_imu([0, 0, 0, 1], [ABSENT, NONE, NONE])),
    (
        "imu",
        imu(
            orientation=to_block(POSE[3:]),
            orientation_covariance=triangle(symmetric(3, 20)),
            gyro_covariance=triangle(symmetric(3)),
            accel_covariance=triangle(symmetric(3, 10)),
        ),
        rosbags_imu(POSE[3:], [symmetric(3, 20), symmetric(3), symmetric(3, 10)]),
    ),
    ("imu", imu(orientation=to_block([0, 0, 0, 1])), rosbags_imu([0, 0, 0, 1], [NONE] * 3)),
    (
        "velocity",
        Velocity(*HEAD, "base", to_block(TWIST[:3]), to_block(TWIST[3:]), triangle(symmetric(6))),
        rosbags_velocity(TWIST, symmetric(6)),
    ),
    (
        "velocity",
        Velocity(*HEAD, "base", to_block(TWIST[:3]), None, triangle(symmetric(3))),
        rosbags_velocity([*TWIST[:3], *NAN3], LINEAR_ONLY),
    ),
    (
        "odometry",
        Odometry(*ODOMETRY_HEAD, triangle(symmetric(6)), to_block(TWIST), triangle(symmetric(6, 50))),
        rosbags_odometry(symmetric(6), symmetric(6, 50)),
    ),
    (
        "pose",
        Pose(*HEAD, "map", "", to_block(POSE), triangle(symmetric(6))),
        rosbags_pose(symmetric(6)),
    ),
    ("pose", Pose(*HEAD, "map", "", to_block(POSE)), rosbags_pose(np.zeros((6, 6)))),
    ("fix", Fix(*HEAD, "gps", *PLACE), rosbags_fix(PLACE, NONE, 0)),
    *(
        (
            "fix",
            Fix(*HEAD, "gps", *PLACE, 2, 0x8009, triangle(symmetric(3)), kind),
            rosbags_fix(PLACE, symmetric(3), kind, 2, 0x8009),
        )
        for kind in (1, 2, 3)
    ),
    # without an altitude, without a fix, and without a position
    (
        "fix",
        Fix(*HEAD, "gps", *PLACE[:2], None, 0, 1, triangle(symmetric(3)), 1),
        rosbags_fix([*PLACE[:2], np.nan], symmetric(3), 1, 0, 1),
    ),
    ("fix", Fix(*HEAD, "gps", *PLACE, -1, 1), rosbags_fix(PLACE, NONE, 0, -1, 1)),
    ("fix", Fix(*HEAD, "gps", None, None, status=-1), rosbags_fix(NAN3, NONE, 0, -1)),
    ("fix", Fix(*HEAD, "gps", None, None, status=-2), rosbags_fix(NAN3, NONE, 0, -2)),
    ("pressure", Pressure(*HEAD, "barometer", 101325.0, 2.25), rosbags_pressure(101325.0, 2.25)),
    ("pressure", Pressure(*HEAD, "barometer", 95000.5), rosbags_pressure(95000.5, 0.0)),
    (
        "magnetic_field",
        MagneticField(*HEAD, "mast", to_block(FIELD)),
        rosbags_magnetic_field(FIELD, NONE),
    ),
    (
        "magnetic_field",
        MagneticField(*HEAD, "mast", to_block(FIELD), triangle(1e-14 * symmetric(3))),
        rosbags_magnetic_field(FIELD, 1e-14 * symmetric(3)),
    ),
    (
        "odometry",
        Odometry(*ODOMETRY_HEAD, None, to_block(TWIST), None),
        rosbags_odometry(np.zeros((6, 6)), np.zeros((6, 6))),
    ),
]


@pytest.mark.parametrize(("stream", "message", "theirs"), CASES)
def test_a_measurement_has_the_bytes_of_rosbags(stream: Any, message: Message, theirs: bytes):
    assert encoded(message) == theirs
    assert [decoded(stream, payload) for payload in (theirs, theirs + b"\x07\0\0")] == [message] * 2


def test_messages_of_big_endian_machines_are_read_too():
    covariances = symmetric(6), symmetric(6, 50)
    turned = rosbags_odometry(*covariances, little_endian=False)
    assert decoded("odometry", turned) == decoded("odometry", rosbags_odometry(*covariances))
    fix = PLACE, symmetric(3), 3, -1, 0x8009
    assert decoded("fix", rosbags_fix(*fix, little_endian=False)) == decoded("fix", rosbags_fix(*fix))
    turned = rosbags_pressure(101325.0, 2.25, little_endian=False)
    assert decoded("pressure", turned) == Pressure(*HEAD, "barometer", 101325.0, 2.25)
    field = FIELD, 1e-14 * symmetric(3)
    turned = rosbags_magnetic_field(*field, little_endian=False)
    assert decoded("magnetic_field", turned) == decoded("magnetic_field", rosbags_magnetic_field(*field))


def test_mcap_ros2_support_decodes_measurements():
    theirs = generate_dynamic(IMU.name, IMU.definition)[IMU.name](encoded(imu()))
    assert (theirs.header.frame_id, theirs.angular_velocity.z, theirs.linear_acceleration.x) == (
        "imu",
        3.0,
        4.0,
    )
    assert list(theirs.orientation_covariance) == ABSENT
    decode = generate_dynamic(ODOMETRY.name, ODOMETRY.definition)[ODOMETRY.name]
    theirs = decode(encoded(CASES[5][1]))
    assert (theirs.header.frame_id, theirs.child_frame_id) == ("odom", "base")
    assert (theirs.pose.pose.orientation.w, theirs.twist.twist.angular.x) == (0.8, 0.4)
    assert list(theirs.twist.covariance) == symmetric(6, 50).ravel().tolist()
    fix = Fix(*HEAD, "gps", *PLACE, -1, 9, triangle(symmetric(3)), 2)
    theirs = generate_dynamic(NAV_SAT_FIX.name, NAV_SAT_FIX.definition)[NAV_SAT_FIX.name](encoded(fix))
    assert (theirs.status.status, theirs.status.service, theirs.longitude) == (-1, 9, -8.25)
    assert list(theirs.position_covariance) == symmetric(3).ravel().tolist()
    assert theirs.position_covariance_type == 2
    field = MagneticField(*HEAD, "mast", to_block(FIELD), triangle(symmetric(3)))
    kind = generate_dynamic(MAGNETIC_FIELD.name, MAGNETIC_FIELD.definition)[MAGNETIC_FIELD.name]
    theirs = kind(encoded(field))
    assert (theirs.header.frame_id, theirs.magnetic_field.z) == ("mast", FIELD[2])
    assert list(theirs.magnetic_field_covariance) == symmetric(3).ravel().tolist()


def test_orientation_of_zeros_is_none():
    # what an uninitialised geometry_msgs/Quaternion of ROS 1 has; it is no rotation
    reading = decoded("imu", rosbags_imu([0, 0, 0, 0], [symmetric(3), NONE, NONE]))
    assert reading.orientation is reading.orientation_covariance is None


NAN_DIAGONAL = np.diag(NAN3)


@pytest.mark.parametrize(
    ("covariance", "kind"), [(symmetric(3), 0), (NONE, 3), (NAN_DIAGONAL, 3), (np.diag([1, 1, np.nan]), 2)]
)
def test_covariance_of_a_fix_of_type_0_of_zeros_or_with_nan_is_not_known(covariance: Any, kind: int):
    fix = decoded("fix", rosbags_fix(PLACE, covariance, kind))
    assert (fix.latitude, fix.covariance, fix.covariance_type) == (PLACE[0], None, 0)


def test_variance_of_a_pressure_that_is_nan_is_not_known():
    assert decoded("pressure", rosbags_pressure(9e4, np.nan)) == Pressure(*HEAD, "barometer", 9e4)


def test_nothing_but_status_and_service_is_taken_from_a_fix_without_a_position():
    for position in ([np.nan, 8.0, 450.0], [47.0, np.inf, 450.0]):
        fix = decoded("fix", rosbags_fix(position, -symmetric(3), 3, -1, 9))
        assert fix == Fix(*HEAD, "gps", None, None, status=-1, service=9)


@pytest.mark.parametrize(
    ("stream", "payload", "reason", "text"),
    [
        (
            "imu",
            rosbags_imu([0, 0, 0, 1], [NONE, ABSENT, NONE]),
            "not measured",
            "without angular velocities",
        ),
        ("imu", rosbags_imu([0, 0, 0, 1], [NONE, NONE, ABSENT]), "not measured", "without accelerations"),
        ("imu", rosbags_imu([0, 0, 0, 2], [NONE] * 3), "malformed", "length 1, not 2"),
        ("imu", rosbags_imu([0, 0, 0, 1], [NONE] * 3, ""), "malformed", "1 to 1024 characters"),
        ("imu", rosbags_imu([0, 0, 0, 1], [NONE] * 3)[:-1], "truncated", "more are expected"),
        ("velocity", rosbags_velocity(TWIST, np.triu(symmetric(6))), "malformed", "symmetric"),
        ("velocity", rosbags_velocity(TWIST, -symmetric(6)), "malformed", "variances .* not negative"),
        ("velocity", rosbags_velocity(TWIST, LINEAR_ONLY), "malformed", "symmetric and finite"),
        ("velocity", rosbags_velocity([*NAN3, *NAN3], LINEAR_ONLY), "malformed", "finite numbers"),
        ("pose", rosbags_pose(symmetric(6), [0, 0, 0, 0]), "malformed", "length 1, not 0"),
        ("pose", rosbags_pose(-symmetric(6)), "malformed", "variances of a pose are not negative"),
        ("fix", rosbags_fix(NAN3, NONE, 0), "malformed", "a fix of status 0 .* the status is -1"),
        ("fix", rosbags_fix([91.0, 8.0, 0.0], NONE, 0), "malformed", "latitudes are within 90"),
        ("fix", rosbags_fix([47.0, 8.0, np.inf], NONE, 0), "malformed", "an altitude of finite"),
        ("fix", rosbags_fix(PLACE, NONE, 0, 3), "malformed", "status of a fix .* got 3"),
        ("fix", rosbags_fix(PLACE, symmetric(3), 4), "malformed", "type of a covariance .* got 4"),
        ("fix", rosbags_fix(PLACE, np.triu(symmetric(3))), "malformed", "symmetric and finite"),
        ("fix", rosbags_fix(PLACE, -symmetric(3)), "malformed", "variances of a fix are not negative"),
        ("fix", rosbags_fix(PLACE, NONE, 0)[:-1], "truncated", "1 more are expected"),
        ("pressure", rosbags_pressure(0.0, 0.0), "malformed", "above zero and at most 1e[+]09 Pa; got 0.0"),
        ("pressure", rosbags_pressure(np.nan, 0.0), "malformed", "got nan"),
        ("pressure", rosbags_pressure(9e4, -1.0), "malformed", "the variance of a pressure is 0 or more"),
        ("pressure", rosbags_pressure(9e4, 0.0)[:-1], "truncated", "more are expected"),
        (
            *("magnetic_field", rosbags_magnetic_field([21.5, -1.25, -43.75], NONE), "malformed"),
            "fields are in tesla, at most 1; got 21.5, -1.25, -43.75, which may be microtesla",
        ),
        ("magnetic_field", rosbags_magnetic_field([2e-5, 0, np.nan], NONE), "malformed", "finite numbers"),
        (
            *("magnetic_field", rosbags_magnetic_field(FIELD, -symmetric(3)), "malformed"),
            "variances of a magnetic field are not negative",
        ),
        ("magnetic_field", rosbags_magnetic_field(FIELD, NONE)[:-1], "truncated", "72 more are expected"),
        ("odometry", rosbags_odometry(symmetric(6) * np.inf, symmetric(6)), "malformed", "finite"),
    ],
)
def test_what_cannot_be_used_is_refused_with_a_reason(stream: Any, payload: bytes, reason: str, text: str):
    with pytest.raises(MessageError, match=text) as caught:
        decoded(stream, payload)
    assert caught.value.reason == reason


@pytest.mark.parametrize("case", CASES[::3])
def test_a_message_without_a_stamp_is_refused(case: tuple[Any, Message, bytes]):
    stream, message, theirs = case
    with pytest.raises(InvalidInput, match="the stamp is 0"):
        encoded(type(message)(*(0, *list(_fields(message))[1:])))
    with pytest.raises(MessageError) as caught:
        decoded(stream, theirs[:4] + bytes(8) + theirs[12:])
    assert caught.value.reason == "no stamp"


def _fields(message: Message) -> list[Any]:
    return [getattr(message, name) for name in message.__struct_fields__]


def test_a_reading_without_a_frame_is_malformed_with_a_prefix_as_well():
    with pytest.raises(MessageError, match="1 to 1024 characters"):
        decoded("imu", rosbags_imu([0, 0, 0, 1], [NONE] * 3, ""), PREFIXED)


def test_frames_have_the_prefix_of_their_robot():
    assert encoded(imu(), PREFIXED) == rosbags_imu([0, 0, 0, 1], [ABSENT, NONE, NONE], "r1/imu")
    payload = rosbags_odometry(symmetric(6), symmetric(6), "r1/odom")
    sample = decoded("odometry", payload, PREFIXED)
    assert sample.edges == (("odom", "ros/base"),)  # the child has no prefix, so it is no frame of r1


def vectors(limit: float) -> st.SearchStrategy[list[float]]:
    return st.lists(st.floats(-limit, limit), min_size=3, max_size=3)


@given(vectors(MAX_SPEED), st.none() | vectors(MAX_RATE), st.booleans())
def test_a_velocity_is_the_same_after_ros(
    linear: list[float], angular: list[float] | None, has_covariance: bool
):
    covariance = triangle(symmetric(6 if angular else 3)) if has_covariance else None
    turn = None if angular is None else to_block(angular)
    velocity = Velocity(*HEAD, "base", to_block(linear), turn, covariance)
    assert decoded("velocity", encoded(velocity)) == velocity


@given(
    st.none() | st.tuples(st.floats(-90, 90), st.floats(-180, 180), st.none() | st.floats(-1e8, 1e8)),
    st.sampled_from([-2, -1, 0, 1, 2]),
    st.integers(0, 65535),
    st.integers(0, 3),
)
def test_a_fix_is_the_same_after_ros(position: Any, status: int, service: int, kind: int):
    if position is None:
        status, kind = min(status, -1), 0
    covariance = triangle(symmetric(3)) if kind else None
    fix = Fix(*HEAD, "gps", *(position or [None] * 3), status, service, covariance, kind)
    assert decoded("fix", encoded(fix)) == fix


@given(
    st.binary(max_size=400),
    st.sampled_from(["imu", "velocity", "pose", "fix", "magnetic_field", "pressure", "odometry"]),
    st.booleans(),
)
def test_arbitrary_bytes_raise_only_message_error(data: bytes, stream: Any, has_header: bool):
    payload = b"\x00\x01\x00\x00" + data if has_header else data
    try:
        message = decoded(stream, payload)
    except MessageError as error:
        assert error.reason
    else:
        assert np.isfinite(from_block(getattr(message, "twist", bytes(8)))).all()
