"""The summary of a recording, compared with its contents."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.recording_builder import MS, RecordingBuilder
from helpers.recording_files import START, S, joint_states, write_run

from zstate.recording.errors import RecordingError
from zstate.recording.info import read_info, recorded_robots
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import to_block


def test_info_has_the_facts_of_the_writer(tmp_path: Path):
    path = tmp_path / "run.mcap"
    write_run(path, joint_states(101))
    info = read_info(path)
    assert (info.path, info.files, info.size) == (path, (path,), path.stat().st_size)
    assert (info.formats, info.profiles, info.compressions) == (("mcap",), ("ros2",), ("zstd",))
    assert info.bytes_per_s == info.size / 1.0
    assert info.libraries[0].startswith("zstate ")
    assert (info.first, info.last, info.duration_s) == (START, START + S, 1.0)
    assert {c.topic: (c.type_name, c.count) for c in info.channels} == {
        "/robot_description": ("std_msgs/msg/String", 1),
        "/joint_states": ("sensor_msgs/msg/JointState", 101),
    }
    assert (info.message_count, info.robots, info.skipped) == (102, ("panda",), ())
    assert (info.complete, info.losses) == (True, ())


def test_info_covers_all_files_of_a_split_recording(tmp_path: Path):
    write_run(tmp_path / "run.mcap", joint_states(500), max_seconds=2.0)
    info = read_info(tmp_path / "run.mcap")
    assert [file.name for file in info.files] == ["run.mcap", "run_1.mcap", "run_2.mcap"]
    assert info.size == sum(file.stat().st_size for file in tmp_path.iterdir())
    assert info.message_count == 500 + 3
    assert info.duration_s == 4.99


def test_info_of_a_truncated_recording_is_incomplete(tmp_path: Path):
    path = tmp_path / "run.mcap"
    write_run(path, joint_states(100))
    path.write_bytes(path.read_bytes()[:5000])
    info = read_info(path)
    assert not info.complete
    (loss,) = info.losses
    assert loss.startswith("run.mcap: ")
    assert "cut off" in loss


def test_recording_of_one_instant_has_no_growth(tmp_path: Path):
    write_run(tmp_path / "run.mcap", [])
    assert read_info(tmp_path / "run.mcap").bytes_per_s is None


def test_file_that_is_not_a_recording_is_refused(tmp_path: Path):
    with pytest.raises(RecordingError):
        read_info(tmp_path / "nothing.mcap")


def test_drivers_of_a_robot_are_listed_by_their_names(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm", {5: "wrist.py@host pid 7"}) as builder:
        builder.describe("arm")
        for n in range(11):
            builder.part(
                "arm", START + n * 10 * MS, {"shoulder": 0.0}, "lower", session=4, log_time=START + n * S
            )
        builder.part("arm", START, {"elbow": 0.0}, "upper", session=5)
    (robot,) = recorded_robots(read_info(tmp_path / "r.mcap"))
    streams = {one.writer: one for one in robot.streams if one.stream == "partial_joint_states"}
    assert {writer: one.count for writer, one in streams.items()} == {
        "lower": 11,
        "upper, wrist.py@host pid 7": 1,
    }
    assert (streams["lower"].topic, streams["lower"].rate_hz) == ("/joint_states", 1.0)


def test_sensors_are_listed_by_their_names_with_rate_and_rays(tmp_path: Path):
    geometry = (-2.0, 0.5, 1000, 0, 0.125, 8.0)
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        for n in range(11):
            stamp = START + n * 100 * MS
            for sensor, count in (("front", 7), ("rear", 3)):
                scan = LaserScan(stamp, n, 1, "laser", *geometry, to_float32_block([1.0] * count))
                builder.encoder.write_message("arm", scan, stamp, sensor)
        cells = b"\0" * 6
        grid = OccupancyGrid(1, START, "map", 0.5, 3, 2, to_block([0, 0, 0, 0, 0, 0, 1]), cells)
        builder.encoder.write_message("arm", grid, START, "floor")
    (robot,) = recorded_robots(read_info(tmp_path / "r.mcap"))
    found = {one.writer: (one.topic, one.count, one.rate_hz, one.rays) for one in robot.streams}
    assert found == {
        "front": ("/front", 11, 10.0, 7),
        "rear": ("/rear", 11, 10.0, 3),
        "floor": ("/floor", 1, None, None),
    }
