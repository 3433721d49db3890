"""Clouds: views of their fields, and the instants of their points in the spellings of the drivers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.clouds import Cloud
from zstate.clouds.cloud import cloud_from_message, cloud_to_message
from zstate.clouds.messages import CLOUD_POINTS, PointCloud, PointField
from zstate.errors import InvalidInput
from zstate.wire.native import decode, encode, encoding_of

STAMP = 1_700_000_000_000_000_000
MS = 1_000_000
SECONDS = STAMP // 10**9
SWEEP = np.array([0.0, 0.03, 0.0625, 0.1])
"""[s]"""


def cloud(count: int = 4, stamp: int = STAMP, **fields: Any) -> Cloud:
    """A cloud of the points 0 0 0, 1 10 100, 2 20 200, ... with more ``fields``."""
    columns = {**{name: np.arange(count, dtype=np.float32) * 10**i for i, name in enumerate("xyz")}, **fields}
    points = np.zeros(count, [(name, np.asarray(values).dtype) for name, values in columns.items()])
    for name, values in columns.items():
        points[name] = values
    return Cloud(stamp, "lidar", points)


def offsets(one: Cloud) -> list[float]:
    """The times of the points since the stamp [ms]."""
    assert one.stamps is not None
    return ((one.stamps - STAMP) / MS).tolist()


@pytest.mark.parametrize(
    ("name", "times"),
    [
        ("t", (SWEEP * 1e9).astype(np.uint32)),  # Ouster
        ("offset_time", (SWEEP * 1e9).astype(np.uint32)),  # Livox
        ("time", SWEEP.astype(np.float32)),  # Velodyne
        ("timestamp", SECONDS + SWEEP),  # RoboSense, Hesai
        ("timestamp", STAMP + SWEEP * 1e9),  # Livox
        ("timestamp", STAMP / 1e3 + SWEEP * 1e6),
        ("time", (SWEEP * 1e6).astype(np.float32)),
        ("time", (SWEEP * 1e6).astype(np.uint32)),
        ("time", (SWEEP * 1e9).astype(np.uint32)),
        ("time", (SWEEP * 1e3).astype(np.float64)),
        ("timestamp", SWEEP * 1e9),
    ],
)
def test_times_of_points_are_found_by_name_and_their_unit_by_their_size(name: str, times: np.ndarray):
    # The spacing of float64 is 238 ns in s, and 256 ns in ns, since 1970.
    assert offsets(cloud(**{name: times})) == pytest.approx([0.0, 30.0, 62.5, 100.0], abs=1e-3)


@pytest.mark.parametrize("name", ["t", "offset_time"])
@given(st.integers(0, 2**32 - 1))
def test_nanoseconds_of_drivers_are_exact_whatever_their_size(name: str, last: int):
    one = cloud(**{name: np.array([0, last // 2, last, 0], dtype=np.uint32)})
    assert one.stamps is not None
    assert one.end_stamp == STAMP + last


def test_times_before_a_stamp_of_the_last_packet_are_negative():
    assert offsets(cloud(time=(SWEEP - 0.1).astype(np.float32))) == pytest.approx(
        [-100.0, -70.0, -37.5, 0.0], abs=1e-3
    )
    assert cloud(time=(SWEEP - 0.1).astype(np.float32)).end_stamp == STAMP


def test_one_packet_or_one_point_keeps_its_unit():
    assert offsets(cloud(1, time=np.array([0.05], dtype=np.float32))) == pytest.approx([50.0], abs=1e-3)
    assert offsets(cloud(1, timestamp=np.array([SECONDS + 0.05]))) == pytest.approx([50.0], abs=1e-3)
    assert offsets(cloud(2, time=np.array([0.09, 0.1], dtype=np.float32))) == pytest.approx([90.0, 100.0])


def test_times_of_a_clock_that_starts_with_the_sensor_are_instants():
    stamps = cloud(timestamp=5000.0 + SWEEP).stamps
    assert stamps is not None
    assert stamps.tolist() == pytest.approx(
        [5_000_000_000_000 + ms * MS for ms in (0, 30, 62.5, 100)], abs=1000
    )


def test_a_point_without_a_time_has_that_of_the_cloud():
    times = SWEEP.astype(np.float32)
    times[1] = np.nan
    assert offsets(cloud(time=times)) == pytest.approx([0.0, 0.0, 62.5, 100.0], abs=1e-3)
    assert offsets(cloud(time=np.full(4, np.nan))) == [0.0] * 4


def test_times_that_are_no_stamps_of_64_bits_are_refused():
    with pytest.raises(InvalidInput, match="64-bit"):
        _ = cloud(timestamp=np.full(4, 1e300)).stamps


def test_a_cloud_without_times_is_rigid():
    one = cloud()
    assert one.is_rigid
    assert one.stamps is None
    assert one.end_stamp == STAMP
    assert not cloud(t=np.zeros(4, np.uint32)).is_rigid


def test_an_empty_cloud_has_no_points_and_ends_at_its_stamp():
    one = cloud(0, t=np.zeros(0, np.uint32))
    assert (len(one), one.xyz.shape, one.end_stamp) == (0, (0, 3), STAMP)


def message(
    fields: list[tuple[str, int, int, int]], step: int, rows: list[bytes], **changed: Any
) -> PointCloud:
    layout: dict[str, Any] = {
        **{"stamp": STAMP, "seq": 0, "session": 1, "frame": "lidar"},
        **{"height": len(rows), "width": len(rows[0]) // step},
        "fields": tuple(PointField(*field) for field in fields),
        **{"is_bigendian": False, "point_step": step, "row_step": len(rows[0])},
        **{"data": b"".join(rows), "is_dense": True},
    }
    return PointCloud(**{**layout, **changed})


def test_points_of_a_message_are_views_of_its_bytes_also_if_they_are_not_aligned():
    # Livox and RoboSense: x y z intensity, two bytes, and a float64 at byte 18 of 26.
    dtype = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "tag", "line", "timestamp"],
            "formats": ["<f4"] * 4 + ["u1", "u1", "<f8"],
            "offsets": [0, 4, 8, 12, 16, 17, 18],
            "itemsize": 26,
        }
    )
    points = np.zeros(5, dtype)
    points["x"], points["timestamp"] = np.arange(5), STAMP + np.arange(5) * 1e6
    numbers = {"f": 7, "u": 2}
    fields = [
        (name, dtype.fields[name][1], 8 if dtype[name] == np.float64 else numbers[dtype[name].kind], 1)
        for name in dtype.names
    ]
    one = message(fields, 26, [points.tobytes()])
    read = cloud_from_message(one, "r1")
    data = np.frombuffer(one.data, np.uint8)
    assert np.shares_memory(read.points, data)
    assert np.shares_memory(read.xyz, data)
    assert read.xyz[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert not read.xyz.flags.writeable
    assert read.frame == "r1/lidar"
    assert read.stamps is not None
    np.testing.assert_allclose(read.stamps - STAMP, np.arange(5) * MS, atol=256)


def test_rows_with_padding_and_big_endian_numbers_are_read():
    rows = [
        np.array([[1, 2, 3], [4, 5, 6]], ">f4").tobytes() + b"pad!",
        np.full(6, 7, ">f4").tobytes() + b"pad!",
    ]
    fields = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]
    read = cloud_from_message(message(fields, 12, rows, is_bigendian=True, width=2), "r1")
    assert read.points.shape == (2, 2)
    assert read.xyz.tolist() == [[1, 2, 3], [4, 5, 6], [7, 7, 7], [7, 7, 7]]


def test_coordinates_of_other_types_become_floats_that_hold_them():
    one = np.zeros(2, [(name, "i2") for name in "xyz"])
    assert Cloud(0, "a", one).xyz.dtype == np.float32
    assert Cloud(0, "a", one.astype([(name, "i4") for name in "xyz"])).xyz.dtype == np.float64


@pytest.mark.parametrize(("kind", "name"), [("u4", "rgb"), ("f4", "rgb"), ("u4", "rgba")])
def test_colours_are_unpacked_from_float_and_integer(kind: str, name: str):
    packed = np.array([0x00FF8001, 0xFF010203, 0, 0], "u4").view(kind)
    colours = cloud(**{name: packed}).rgb
    assert colours is not None
    assert colours[:2].tolist() == [[255, 128, 1], [1, 2, 3]]


def test_intensity_and_ring_are_columns_or_none():
    one = cloud(intensity=np.arange(4.0), ring=np.arange(4, dtype=np.uint16))
    assert one.intensity is not None
    assert one.ring is not None
    assert (one.intensity.tolist(), one.ring.tolist()) == ([0, 1, 2, 3], [0, 1, 2, 3])
    assert (cloud().intensity, cloud().ring, cloud().rgb) == (None, None, None)


def test_nan_is_no_point_whatever_the_writer_claims():
    one = cloud(x=np.array([0.0, np.nan, np.inf, 3.0], np.float32))
    assert one.valid.tolist() == [True, False, False, True]


def test_a_cloud_goes_through_its_message_unchanged():
    one = cloud(4, ring=np.arange(4, dtype=np.uint16), curvature=np.arange(4.0))
    organised = Cloud(STAMP, "lidar", one.points.reshape(2, 2))
    for given_cloud in (one, organised):
        sent = cloud_to_message(given_cloud, is_dense=True)
        read = cloud_from_message(decode(encode(sent), encoding_of(PointCloud), PointCloud), "r1")
        assert read.points.shape == given_cloud.points.shape
        assert (read.points == given_cloud.points).all()
        assert (read.stamp, read.is_dense) == (STAMP, True)


@pytest.mark.parametrize(
    ("points", "text"),
    [
        (np.zeros((3, 3)), "a structured array with fields x, y and z"),
        (np.zeros(3, [("x", "f4"), ("y", "f4")]), "these have x, y"),
        (np.zeros((1, 1, 1), [(name, "f4") for name in "xyz"]), r"\(N,\) or \(height, width\)"),
    ],
)
def test_arrays_that_are_no_cloud_are_refused(points: np.ndarray, text: str):
    with pytest.raises(InvalidInput, match=text):
        Cloud(0, "lidar", points)


@pytest.mark.parametrize("kind", ["i8", "c8", "?", "U3"])
def test_fields_that_pointcloud2_does_not_have_are_refused(kind: str):
    with pytest.raises(InvalidInput, match="the field 'extra' of the points has the type"):
        cloud_to_message(cloud(extra=np.zeros(4, kind)), is_dense=True)


def test_more_points_than_a_cloud_may_have_are_refused_with_the_limit_before_a_copy():
    many = np.broadcast_to(np.zeros(1, [(name, "u1") for name in "xyz"]), (10**8,))
    with pytest.raises(InvalidInput, match=f"100000000 points of 3 bytes, where {CLOUD_POINTS} points"):
        cloud_to_message(Cloud(0, "lidar", many), is_dense=True)
    fields = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)]
    with pytest.raises(InvalidInput, match=f"where {CLOUD_POINTS} points"):
        message(fields, 12, [bytes(12)], width=10**8)
