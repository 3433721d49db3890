from collections.abc import Callable
from hashlib import blake2b
from typing import Any

import numpy as np
import pytest

from zstate.driving.messages import DriverState, JointTrajectory, with_short_texts
from zstate.errors import InvalidInput, MessageError
from zstate.odometry.messages import (
    Fix,
    Imu,
    MagneticField,
    MapDatum,
    Odometry,
    Pose,
    Pressure,
    Velocity,
    with_full_names,
)
from zstate.scans.messages import LaserScan, OccupancyGrid, cells_of
from zstate.stream_registry import stream_named
from zstate.wire.measurements import covariance_matrix, from_float32_block, to_float32_block
from zstate.wire.messages import (
    JointState,
    Message,
    StaticTransforms,
    TransformSample,
    WriterTransforms,
    edge_of,
    from_block,
    order_digest,
    poses_from_block,
    to_block,
)
from zstate.wire.native import decode, encode, encoding_of

EDGES = (("base", "arm"), ("arm", "hand"))


def test_block_is_little_endian_float64_for_any_array():
    # 1.0 is sign 0, exponent 1023, fraction 0: 3f f0 00 .. read from the high end
    assert to_block([1, -2]) == bytes.fromhex("000000000000f03f 00000000000000c0")
    big_endian = np.array([1.0, -2.0], dtype=">f8")
    every_other = np.array([1.0, 9.0, -2.0], dtype="f4")[::2]
    assert to_block(big_endian) == to_block(every_other) == to_block([1, -2])


def test_numbers_read_from_a_block_share_its_memory_and_cannot_be_written():
    block = to_block([0.1, np.nan, -np.inf])
    numbers = from_block(block)
    assert numbers.dtype == np.float64
    np.testing.assert_array_equal(numbers, [0.1, np.nan, -np.inf])
    with pytest.raises(ValueError, match="read-only"):
        numbers[0] = 1.0


def test_poses_are_rows_of_seven_even_without_poses():
    poses = np.arange(14.0).reshape(2, 7)
    np.testing.assert_array_equal(poses_from_block(to_block(poses)), poses)
    assert poses_from_block(b"").shape == (0, 7)


def test_the_order_digest_is_blake2b_of_the_names_as_a_messagepack_array():
    # MessagePack: fixarray of 2 = 92; fixstr of 1 byte = a1
    assert order_digest(["a", "b"]) == blake2b(b"\x92\xa1a\xa1b", digest_size=8).digest()
    assert order_digest([("a", "b")]) == blake2b(b"\x91\x92\xa1a\xa1b", digest_size=8).digest()


def test_orders_that_look_alike_have_different_digests():
    orders = [["a", "b"], ["b", "a"], ["ab"], ["a", "b", ""], [], ["a\0b"], [("a", "b")]]
    assert len({order_digest(order) for order in orders}) == len(orders)


def test_a_sequence_type_does_not_change_the_digest():
    assert order_digest(["a", "b"]) == order_digest(("a", "b"))
    assert order_digest(list(EDGES)) == order_digest(EDGES)


def test_a_message_cannot_be_made_with_a_block_of_the_wrong_length():
    order = order_digest(EDGES)
    with pytest.raises(InvalidInput, match="multiple of 8 bytes, not 7"):
        JointState(0, 0, 1, order, b"1234567")
    with pytest.raises(InvalidInput, match="multiple of 56 bytes, not 8"):
        TransformSample(0, 0, 1, order, to_block([1.0]))
    with pytest.raises(InvalidInput, match="2 edges need as many poses, not 1"):
        StaticTransforms(1, EDGES, to_block(np.zeros(7)))


def test_names_and_edges_sent_along_must_fit_their_digest_and_their_numbers():
    with pytest.raises(InvalidInput, match="not that of the order"):
        JointState(0, 0, 1, order_digest(["b"]), to_block([1.0]), names=("a",))
    with pytest.raises(InvalidInput, match="not that of the order"):
        TransformSample(0, 0, 1, order_digest(["b"]), to_block(np.zeros((2, 7))), EDGES)
    with pytest.raises(InvalidInput, match="1 names need as many numbers, not 2"):
        JointState(0, 0, 1, order_digest(["a"]), to_block([1.0, 2.0]), names=("a",))


def scan(**changed: Any) -> LaserScan:
    fields: dict[str, Any] = {
        **{"stamp": 5, "seq": 0, "session": 1, "frame": "laser", "angle_min": -1.0, "angle_increment": 0.5},
        **{"ray_ns": 10, "scan_ns": 100, "range_min": 0.1, "range_max": 10.0},
        "ranges": to_float32_block([1.0, 2.0]),
    }
    return LaserScan(**{**fields, **changed})


def grid(**changed: Any) -> OccupancyGrid:
    fields: dict[str, Any] = {
        **{"session": 1, "stamp": 5, "frame": "map", "resolution": 0.1, "width": 3, "height": 2},
        **{"origin": to_block([0, 0, 0, 0, 0, 0, 1]), "cells": np.arange(-1, 5, dtype=np.int8).tobytes()},
    }
    return OccupancyGrid(**{**fields, **changed})


def test_a_block_of_ranges_is_little_endian_float32():
    # 1.0 is sign 0, exponent 127, fraction 0: 3f 80 00 00 read from the high end
    assert to_float32_block([1, -2]) == bytes.fromhex("0000803f 000000c0")
    np.testing.assert_array_equal(from_float32_block(to_float32_block([0.5, np.inf])), [0.5, np.inf])


def test_a_scan_has_at_most_100000_rays():
    ranges = bytes(4 * 100_000)
    largest = scan(ranges=ranges, intensities=ranges, frame="\U0001f916" * 1024)
    assert len(encode(largest)) <= stream_named("scan").max_bytes
    with pytest.raises(InvalidInput, match="100001 rays, where 100000 are allowed"):
        scan(ranges=bytes(4 * 100_000 + 4))


def test_ranges_that_are_no_measurements_are_part_of_a_scan():
    ranges = to_float32_block([-np.inf, np.inf, np.nan, 99.0])
    assert scan(ranges=ranges, intensities=ranges, range_max=np.inf).ranges == ranges
    assert scan(ranges=b"", ray_ns=0, scan_ns=0).ranges == b""


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"frame": ""}, "1 to 1024 characters, not 0"),
        ({"angle_min": np.nan}, "angles of finite numbers .* not nan, 0.5"),
        ({"angle_increment": np.inf}, "not -1.0, inf"),
        ({"range_min": -0.1}, "not -0.1 and 10.0"),
        ({"range_min": 11.0}, "not 11.0 and 10.0"),
        ({"range_min": np.inf, "range_max": np.inf}, "not inf and inf"),
        ({"range_max": np.nan}, "not 0.1 and nan"),
        ({"ranges": b"12345"}, "multiple of 4 bytes, not 5"),
        ({"intensities": b"1234"}, "2 ranges take as many intensities; got 4 bytes, not 8"),
        ({"ray_ns": -1}, "2 rays of -1 ns"),
        ({"scan_ns": -1}, "a scan of -1 ns"),
        ({"scan_ns": 2**63}, "a scan of 9223372036854775808 ns"),
        ({"stamp": 2**63 - 20}, "last ray has 64 bits"),
    ],
)
def test_a_scan_with_impossible_geometry_or_times_cannot_be_made(changed: dict[str, Any], text: str):
    with pytest.raises(InvalidInput, match=text):
        scan(**changed)


def imu(**changed: Any) -> Imu:
    fields: dict[str, Any] = {
        **{"stamp": 5, "seq": 0, "session": 1, "frame": "imu"},
        **{"gyro": to_block([0.1, 0.2, 0.3]), "accel": to_block([0.0, 0.0, 9.81])},
    }
    return Imu(**{**fields, **changed})


def velocity(**changed: Any) -> Velocity:
    fields: dict[str, Any] = {"stamp": 5, "seq": 0, "session": 1, "frame": "base"}
    return Velocity(**{**fields, "linear": to_block([1, 0, 0]), **changed})


def pose(**changed: Any) -> Pose:
    fields: dict[str, Any] = {"stamp": 5, "seq": 0, "session": 1, "parent": "map", "child": "base"}
    return Pose(**{**fields, "pose": to_block([1, 2, 3, 0, 0, 0, 1]), **changed})


def fix(**changed: Any) -> Fix:
    fields: dict[str, Any] = {"stamp": 5, "seq": 0, "session": 1, "frame": "gps"}
    return Fix(**{**fields, "latitude": 47.5, "longitude": 8.25, "altitude": 450.0, **changed})


def pressure(**changed: Any) -> Pressure:
    fields: dict[str, Any] = {"stamp": 5, "seq": 0, "session": 1, "frame": "bmp", "pressure": 101325.0}
    return Pressure(**{**fields, **changed})


def datum(**changed: Any) -> MapDatum:
    fields: dict[str, Any] = {"stamp": 5, "seq": 0, "session": 1, "frame": "map"}
    return MapDatum(**{**fields, "latitude": 47.5, "longitude": 8.25, "altitude": 450.0, **changed})


def magnetic_field(**changed: Any) -> MagneticField:
    fields: dict[str, Any] = {"stamp": 5, "seq": 0, "session": 1, "frame": "mag"}
    return MagneticField(**{**fields, "field": to_block([2e-5, 0, -4e-5]), **changed})


def odometry(**changed: Any) -> Odometry:
    edge = (("odom", "base"),)
    fields: dict[str, Any] = {
        **{"stamp": 5, "seq": 0, "session": 1, "order": order_digest(edge), "edges": edge},
        **{"poses": to_block([1, 2, 3, 0, 0, 0, 1]), "twist": to_block(range(6))},
    }
    return Odometry(**{**fields, **changed})


@pytest.mark.parametrize(
    ("make", "changed", "text"),
    [
        (imu, {"frame": ""}, "1 to 1024 characters, not 0"),
        (imu, {"frame": "/"}, "'/' is no name of a frame"),
        (imu, {"frame": "/imu"}, "slash at its end"),
        (imu, {"frame": "r1/"}, "write 'frame' or 'robot/frame'"),
        (imu, {"frame": "a\nb"}, "control characters"),
        (imu, {"gyro": to_block([1, 2])}, "angular velocities of 3 numbers take 24 bytes, not 16"),
        (imu, {"accel": to_block([0, np.nan, 0])}, "accelerations of finite numbers .* not 0.0, nan"),
        (imu, {"gyro_covariance": to_block(range(5))}, "of 6 numbers take 48 bytes, not 40"),
        # the variances of an upper triangle xx xy xz yy yz zz are the 1st, 4th and 6th
        (imu, {"accel_covariance": to_block([1, 2, 3, 4, 5, -6])}, r"not negative; got \[1.0, 4.0, -6.0\]"),
        (imu, {"orientation": to_block([0, 0, 0, 2])}, "length 1, not 2"),
        (imu, {"orientation_covariance": to_block(range(6))}, "needs an orientation"),
        (velocity, {"linear": b""}, "velocities of 3 numbers take 24 bytes, not 0"),
        (velocity, {"angular": to_block([np.inf, 0, 0])}, "finite numbers"),
        (velocity, {"covariance": to_block(range(21))}, "of 6 numbers take 48 bytes, not 168"),
        (velocity, {"angular": bytes(24), "covariance": bytes(48)}, "of 21 numbers take 168 bytes, not 48"),
        (pose, {"parent": ""}, "1 to 1024 characters, not 0"),
        (pose, {"child": "a" * 1025}, "1 to 1024 characters, not 1025"),
        (pose, {"pose": bytes(56)}, "length 1, not 0"),
        (pose, {"pose": to_block([np.nan, 0, 0, 0, 0, 0, 1])}, "a pose of finite numbers"),
        (pose, {"covariance": to_block([-1.0, *range(20)])}, "variances of a pose are not negative"),
        (fix, {"frame": ""}, "1 to 1024 characters, not 0"),
        (fix, {"latitude": np.nan}, "a latitude and a longitude of finite numbers .* not nan, 8.25"),
        (fix, {"longitude": -np.inf}, "not 47.5, -inf"),
        (fix, {"altitude": np.nan}, "an altitude of finite numbers .* not nan"),
        # 47 degrees 30 minutes as NMEA has them
        (fix, {"latitude": 4730.0}, "got 4730.0 and 8.25: give degrees with decimals, not .* of NMEA"),
        (fix, {"latitude": None}, "a latitude and a longitude; got None and 8.25"),
        (fix, {"longitude": None, "status": -1}, "a latitude and a longitude; got 47.5 and None"),
        (fix, {"latitude": None, "longitude": None}, "a fix of status 0 has .* the status is -1"),
        (fix, {"latitude": None, "longitude": None, "status": -1}, "an altitude .* need a latitude"),
        (pressure, {"frame": ""}, "1 to 1024 characters, not 0"),
        (pressure, {"pressure": 0.0}, r"above zero and at most 1e\+09 Pa; got 0.0"),
        (pressure, {"pressure": np.nan}, "got nan"),
        (pressure, {"pressure": 1.0001e9}, "got 1000100000.0"),
        (pressure, {"variance": -1.0}, r"0 or more \[Pa\^2\]; got -1.0"),
        (pressure, {"variance": np.inf}, "got inf"),
        (datum, {"frame": ""}, "1 to 1024 characters, not 0"),
        (datum, {"latitude": 90.1}, "a latitude of -90 to 90 .*; got 90.1, 8.25, 450.0"),
        (datum, {"longitude": float("nan")}, "got 47.5, nan, 450.0"),
        (datum, {"altitude": 2e7}, "got 47.5, 8.25, 20000000.0"),
        (fix, {"status": 3}, "-1 .no fix.*; got 3"),
        (fix, {"status": -3}, "-1 .no fix.*; got -3"),
        (fix, {"service": -1}, "16 bits, 0 to 65535; got -1"),
        (fix, {"service": 65536}, "16 bits, 0 to 65535; got 65536"),
        (fix, {"covariance": bytes(40), "covariance_type": 3}, "of 6 numbers take 48 bytes, not 40"),
        (fix, {"covariance": to_block([1, 0, 0, -2, 0, 3]), "covariance_type": 3}, "variances of a fix"),
        (fix, {"covariance": bytes(48)}, "got 0 with one"),
        (fix, {"covariance": bytes(48), "covariance_type": 4}, "got 4 with one"),
        (fix, {"covariance_type": 3}, "got 3 without one"),
        (magnetic_field, {"frame": ""}, "1 to 1024 characters, not 0"),
        (magnetic_field, {"field": bytes(16)}, "3 numbers take 24 bytes, not 16"),
        (magnetic_field, {"field": to_block([0, np.nan, 0])}, "a magnetic field of finite numbers"),
        # the field of the Earth in microtesla, and in milligauss
        (magnetic_field, {"field": to_block([21.0, 0, -43.0])}, "tesla, .* -43.0, which may be microtesla"),
        (magnetic_field, {"field": to_block([210.0, 0, -430.0])}, "tesla, .* or milligauss"),
        (magnetic_field, {"covariance": bytes(40)}, "of 6 numbers take 48 bytes, not 40"),
        (magnetic_field, {"covariance": to_block([1, 0, 0, -2, 0, 3])}, "variances of a magnetic field"),
        (odometry, {"edges": None}, "odometry has one edge"),
        (odometry, {"poses": bytes(112)}, "1 edges need as many poses, not 2"),
        (odometry, {"covariances": bytes(168 * 2)}, "21 numbers of covariance each"),
        (odometry, {"twist": b""}, "a twist of 6 numbers take 48 bytes, not 0"),
        (odometry, {"twist_covariance": to_block([-1.0, *range(20)])}, "not negative; got .-1.0, 5.0"),
    ],
)
def test_a_measurement_with_impossible_numbers_cannot_be_made(
    make: Callable[..., Message], changed: dict[str, Any], text: str
):
    with pytest.raises(InvalidInput, match=text):
        make(**changed)


@pytest.mark.parametrize(
    ("make", "field", "most", "others"),
    [
        (imu, "gyro", 1e3, []),
        (imu, "accel", 1e5, []),
        (velocity, "linear", 1e4, []),
        (velocity, "angular", 1e3, []),
        (pose, "pose", 1e8, [0.0, 0.0, 0.0, 1.0]),
    ],
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_number_of_a_measurement_that_no_sensor_has_is_refused(
    make: Callable[..., Message], field: str, most: float, others: list[float], axis: int
):
    for number in (most, -most):
        numbers = np.zeros(3)
        numbers[axis] = number
        assert make(**{field: to_block([*numbers, *others])})
        with pytest.raises(InvalidInput, match="at most"):
            make(**{field: to_block([*(1.000001 * numbers), *others])})


@pytest.mark.parametrize(("field", "most"), [("latitude", 90.0), ("longitude", 180.0), ("altitude", 1e8)])
def test_a_position_on_the_earth_is_within_its_limits(field: str, most: float):
    for number in (most, -most):
        assert getattr(fix(**{field: number}), field) == number
        with pytest.raises(InvalidInput, match=r"within 90 degrees|at most 1e\+08"):
            fix(**{field: np.nextafter(number, 2 * number)})


def test_a_receiver_without_a_fix_is_a_message_with_or_without_a_position():
    for status in (-2, -1):
        assert fix(status=status).latitude == 47.5
        assert fix(status=status, latitude=None, longitude=None, altitude=None).latitude is None


@pytest.mark.parametrize(
    ("length", "is_unit"), [(0.9991, True), (1.0009, True), (0.9989, False), (1.0011, False)]
)
def test_the_length_of_a_quaternion_is_within_a_thousandth_of_1(length: float, is_unit: bool):
    quaternion = [0.6 * length, 0.0, 0.0, 0.8 * length]
    for make, changed in ((imu, {"orientation": quaternion}), (pose, {"pose": [1.0, 2.0, 3.0, *quaternion]})):
        blocks = {name: to_block(numbers) for name, numbers in changed.items()}
        if is_unit:
            assert make(**blocks)
        else:
            with pytest.raises(InvalidInput, match=f"length 1, not {length:g}"):
                make(**blocks)


def test_messages_of_sensors_and_odometry_fit_the_limit_of_their_streams():
    frame, six = "\U0001f916" * 1024, bytes(21 * 8)
    edge = ((frame, frame),)
    largest = odometry(edges=edge, order=order_digest(edge), covariances=six, twist_covariance=six)
    of_sensors = (
        *(imu(frame=frame), fix(frame=frame, covariance=bytes(48), covariance_type=3)),
        magnetic_field(frame=frame, covariance=bytes(48)),
    )
    assert max(len(encode(one)) for one in (*of_sensors, largest)) <= stream_named("odometry").max_bytes


def test_frames_of_a_measurement_get_their_full_names():
    assert with_full_names(imu(), "r1").frame == "r1/imu"
    assert with_full_names(fix(), "r1").frame == "r1/gps"
    assert with_full_names(pressure(), "r1").frame == "r1/bmp"
    assert with_full_names(magnetic_field(), "r1").frame == "r1/mag"
    placed = with_full_names(pose(parent="hall/map"), "r1")
    assert (placed.parent, placed.child) == ("hall/map", "r1/base")
    assert with_full_names(pose(child=""), "r1").child == ""  # of the base


def test_odometry_is_a_sample_of_its_edge():
    sample = odometry(covariances=to_block(range(21)))
    edge = edge_of(sample)
    assert type(edge) is WriterTransforms
    assert (edge.stamp, edge.edges, edge.poses) == (5, (("odom", "base"),), sample.poses)
    assert edge.covariances == sample.covariances


def test_an_upper_triangle_is_a_symmetric_matrix():
    matrix = covariance_matrix(to_block([1, 2, 3, 4, 5, 6]))
    assert matrix.tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]
    assert covariance_matrix(to_block(range(21)))[5].tolist() == [5, 10, 14, 17, 19, 20]


def test_row_0_of_the_cells_is_the_first_width_cells():
    np.testing.assert_array_equal(cells_of(grid()), [[-1, 0, 1], [2, 3, 4]])
    assert cells_of(grid(width=0, cells=b"")).shape == (2, 0)


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"frame": "a" * 1025}, "1 to 1024 characters, not 1025"),
        ({"resolution": 0.0}, "positive and finite .* not 0.0"),
        ({"resolution": np.nan}, "not nan"),
        ({"origin": bytes(48)}, "a pose of 56 bytes, not 48"),
        ({"origin": to_block([np.inf, 0, 0, 0, 0, 0, 1])}, "origin of finite numbers .* not inf, 0.0"),
        ({"width": 4}, "4 x 2 needs as many cells, not 6"),
        ({"width": -3, "height": -2}, "-3 x -2 needs"),
        ({"cells": bytes([0, 0, 0, 0, 0, 101])}, "not 0 to 101"),
        ({"cells": bytes([0, 0, 0, 0, 0, 254])}, "not -2 to 0"),
        ({"width": 16_777_216 + 1, "height": 1, "cells": bytes(16_777_216 + 1)}, "16777216 are allowed"),
    ],
)
def test_a_grid_with_impossible_geometry_or_cells_cannot_be_made(changed: dict[str, Any], text: str):
    with pytest.raises(InvalidInput, match=text):
        grid(**changed)


def test_messages_are_frozen():
    state = JointState(0, 0, 1, order_digest([]), b"")
    with pytest.raises(AttributeError):
        state.stamp = 1  # type: ignore[misc]


@pytest.mark.parametrize("tolerances", [(np.nan, 0.1), (0.1, np.nan), (0.0, 0.1)])
def test_a_motion_without_tolerances_above_zero_is_refused(tolerances: tuple[float, float]):
    with pytest.raises(InvalidInput, match="above zero"):
        JointTrajectory(
            0, 0, 7, ("elbow",), to_block([1.0]), to_block([0.0]), None, None, None, False, *tolerances
        )


def motion_of(count: int) -> JointTrajectory:
    return JointTrajectory(0, 0, 7, ("elbow",), to_block(range(count)), to_block([0.0] * count))


def test_a_motion_has_1_to_10000_points():
    assert motion_of(1)
    assert motion_of(10_000)
    for count in (0, 10_001):
        with pytest.raises(InvalidInput, match=f"a motion has 1 to 10000 points, not {count}"):
            motion_of(count)


@pytest.mark.parametrize("field", ["program", "reason", "commander", "last_refusal"])
def test_a_text_of_a_driver_state_is_cut_after_2000_characters(field: str):
    texts = {"program": "host", "reason": ""}

    def shortened(length: int) -> str:
        state = DriverState(
            0, 5, state="ready", joint_names=("elbow",), ttl=1, **{**texts, field: "x" * length}
        )
        return getattr(with_short_texts(state), field)

    assert shortened(2000) == "x" * 2000
    assert shortened(2001) == "x" * 2000 + "... and 1 more characters"


@pytest.mark.parametrize(("field", "least", "most"), [("rate_hz", 0.0, 1e9), ("progress", 0.0, 1.0)])
def test_numbers_of_a_driver_state_outside_of_their_ranges_are_malformed(
    field: str, least: float, most: float
):
    def received(number: float) -> DriverState:
        state = DriverState(0, 5, "host", "ready", "", ("elbow",), 1, **{field: number})
        return decode(encode(state), encoding_of(DriverState), DriverState)

    assert [getattr(received(number), field) for number in (least, most)] == [least, most]
    for number in (np.nextafter(least, -1.0), np.nextafter(most, np.inf)):
        with pytest.raises(MessageError) as caught:
            received(float(number))
        assert caught.value.reason == "malformed"
