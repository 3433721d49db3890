"""CloudPublisher, read back from the network by a CloudListener without a target."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.processes import repeated, until
from helpers.tokens import current_tokens

from zstate.clock import ManualClock
from zstate.clouds import Cloud, CloudListener, CloudPublisher, PlacedCloud
from zstate.errors import InvalidInput, SecondWriter
from zstate.wire.keys import WRITER_TOKEN

XYZ = np.array([[1.0, 2.0, 3.0], [np.nan, np.nan, np.nan], [-1.0, 0.5, 0.25]])
TIMED = np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4"), ("ring", "u2"), ("time", "f4")])
WIRES = ["native", "ros2", "ros2dds"]


def received(sessions: Any, wire: str, *args: Any, **options: Any) -> PlacedCloud:
    """Publishes until a cloud arrives: none is kept for late readers, and congestion drops some."""
    writer, reader = sessions
    published = {name: options.pop(name) for name in ("stamp", "times") if name in options}
    with (
        CloudListener(reader, "r1", sensor="cloud" if wire == "ros2dds" else "*", wire=wire) as clouds,
        CloudPublisher(writer, "r1", "cloud", wire, frame="lidar", **options) as publisher,
        repeated(lambda: publisher.publish(*args, **published), every_s=0.05),
    ):
        return next(iter(clouds))


@pytest.mark.parametrize("wire", WIRES)
def test_points_arrive_as_they_were_published(sessions, wire: str):
    placed = received(sessions, wire, XYZ, stamp=5)
    assert np.array_equal(placed.xyz, XYZ.astype(np.float32), equal_nan=True)
    assert placed.valid.tolist() == [True, False, True]
    assert (placed.stamp, placed.target, placed.sensor) == (5, "r1/lidar", "cloud")
    assert placed.is_rigid
    assert not placed.cloud.is_dense


@pytest.mark.parametrize("wire", WIRES)
def test_a_topic_of_any_name_is_read_by_its_name_and_no_other(sessions, wire: str):
    writer, reader = sessions
    with (
        CloudListener(reader, "r1", sensor="velodyne_points", wire=wire) as clouds,
        CloudPublisher(writer, "r1", "velodyne_points", wire, frame="lidar") as publisher,
        CloudPublisher(writer, "r1", "cloud", wire, frame="lidar") as other,
        repeated(lambda: (other.publish(XYZ), publisher.publish(XYZ)), every_s=0.05),
    ):
        assert {next(iter(clouds)).sensor for _ in range(3)} == {"velodyne_points"}


@pytest.mark.parametrize("wire", WIRES)
def test_a_structured_array_keeps_its_fields_and_its_times(sessions, wire: str):
    points = np.zeros(4, TIMED)
    points["ring"], points["time"] = range(4), [0.0, 0.025, 0.0625, 0.1]
    cloud = received(sessions, wire, points, stamp=10**9).cloud
    assert cloud.points.tobytes() == points.tobytes()
    assert cloud.stamps is not None
    assert cloud.stamps.tolist() == pytest.approx([10**9, 1_025_000_000, 1_062_500_000, 1_100_000_000], abs=5)


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_compressed_points_arrive_unchanged_or_within_half_of_the_resolution(sessions, compression: str):
    exact = received(sessions, "native", XYZ, stamp=5, compression=compression)
    assert np.array_equal(exact.xyz, XYZ.astype(np.float32), equal_nan=True)
    rounded = received(sessions, "native", XYZ * 1.2345, stamp=5, compression=compression, resolution=0.01)
    assert np.nanmax(abs(rounded.xyz - XYZ * 1.2345)) <= 0.005 + 1e-6  # and the rounding to float32
    assert np.isnan(rounded.xyz[1]).all()


def test_times_become_a_field_and_the_first_is_the_stamp(sessions):
    times = np.array([1_000_000_700, 1_000_000_000, 1_100_000_000])
    cloud = received(sessions, "native", XYZ, times=times).cloud
    assert cloud.stamp == 1_000_000_000
    assert cloud.stamps is not None
    assert cloud.stamps.tolist() == times.tolist()


def test_an_organised_cloud_keeps_its_shape(sessions):
    grid = np.arange(24.0).reshape(2, 4, 3)
    placed = received(sessions, "native", grid, times=np.arange(8).reshape(2, 4))
    assert placed.cloud.points.shape == (2, 4)
    assert np.array_equal(placed.xyz, grid.reshape(-1, 3))
    assert placed.cloud.is_dense


def test_a_cloud_without_a_stamp_is_of_now(sessions):
    assert received(sessions, "native", XYZ, clock=ManualClock(123)).stamp == 123


def test_run_publishes_the_clouds_of_a_source_with_their_stamps(sessions):
    writer, reader = sessions

    class Lidar:
        frame = "lidar"

        def read(self, stamp: int) -> Cloud:
            return Cloud(777, self.frame, np.zeros(2, TIMED))

    with (
        CloudListener(reader, "r1") as clouds,
        CloudPublisher(writer, "r1", "front", frame="lidar") as publisher,
    ):
        until(lambda: publisher.run(Lidar(), 50.0, seconds=0.1) and len(clouds))
        assert next(iter(clouds)).stamp == 777
        lidar = Lidar()
        lidar.frame = "camera"
        with pytest.raises(InvalidInput, match="'r1/lidar'; its source returned a Cloud in 'r1/camera'"):
            publisher.run(lidar, 50.0, seconds=0.1)


@pytest.mark.parametrize(
    ("points", "options", "text"),
    [
        (np.zeros((3, 2)), {}, r"\(N, 3\) or \(height, width, 3\)"),
        (np.zeros(3), {}, r"\(N, 3\) or \(height, width, 3\)"),
        (np.zeros((3, 3), complex), {}, "got complex128"),
        (np.broadcast_to(0.0, (10**8, 3)), {}, "100000000 points of 12 bytes, where 4000000 points"),
        (np.broadcast_to(np.zeros((), TIMED), 10**8), {}, "100000000 points of 18 bytes"),
        (np.zeros((3, 3)), {"times": [1, 2]}, r"have times of the shape \(2,\)"),
        (np.zeros((3, 3)), {"times": [0.1, 0.2, 0.3]}, "nanoseconds"),
        (np.zeros((2, 3)), {"times": [1, 2], "stamp": 2}, "from its stamp on"),
        (np.zeros((2, 3)), {"times": [1, 2 + 2**32]}, "from its stamp on"),
        (np.zeros(2, TIMED), {"times": [1, 2]}, "in the field 'time'"),
    ],
)
def test_points_that_are_no_cloud_are_refused_and_counted(sessions, points: Any, options: Any, text: str):
    with CloudPublisher(sessions[0], "r1", "front") as publisher:
        with pytest.raises(InvalidInput, match=text):
            publisher.publish(points, **options)
        assert (publisher.stats.sent, publisher.stats.refused) == (0, 1)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"compression": "gzip"}, "None, 'lz4' or 'zstd'"),
        ({"resolution": 0.01}, "with compression=None"),
        ({"compression": "lz4", "resolution": 0.0}, "positive and finite"),
        ({"compression": "lz4", "resolution": float("nan")}, "positive and finite"),
        ({"frame": ""}, "a frame name is empty"),
    ],
)
def test_wrong_options_are_refused_at_once(sessions, options: Any, text: str):
    with pytest.raises(InvalidInput, match=text):
        CloudPublisher(sessions[0], "r1", "front", **options)


def test_one_sensor_has_one_writer(sessions):
    with CloudPublisher(sessions[0], "r1", "front"):
        until(lambda: current_tokens(sessions[1], WRITER_TOKEN.expression("r1"), 1.0))
        with pytest.raises(SecondWriter, match="already writes cloud"):
            CloudPublisher(sessions[1], "r1", "front")
