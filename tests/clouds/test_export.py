"""Clouds in recordings: read by rosbags, exported point by point, and as PLY that trimesh reads."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.cli_runner import failure, run_cli
from helpers.recording_builder import RecordingBuilder, pose
from rosbags.highlevel import AnyReader

from zstate import Recording
from zstate.clouds.cloud import Cloud, cloud_from_message, cloud_to_message
from zstate.clouds.messages import PointCloud
from zstate.errors import InvalidInput
from zstate.recording.errors import RecordingError
from zstate.recording.stream_export import export_points, export_stream

START = 1_700_000_000_000_000_000
POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("rgb", "<f4"), ("normal", "<f4", (2,))]
)


def points(number: int) -> np.ndarray:
    """Three points of cloud ``number``, one of them NaN."""
    made = np.zeros(3, POINT)
    made["x"], made["y"], made["z"] = [number, 1, np.nan], [2, 3, np.nan], [4, 5, np.nan]
    made["t"] = [0, 1000, 2000]
    made["rgb"] = np.array([0x00FF8001, 0x00010203, 0], "u4").view("f4")
    made["normal"] = [[1, 2], [3, 4], [5, 6]]
    return made


def write(path: Path, compression: Any = "") -> None:
    """Two clouds of r1's sensor "front", of a robot alone in the file."""
    with RecordingBuilder(path, "r1") as builder:
        for number in range(2):
            stamp = START + number * 10**8
            message = cloud_to_message(Cloud(stamp, "lidar", points(number)), False, compression)
            builder.encoder.write_message("r1", message, stamp, "front")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    write(tmp_path / "run.mcap")
    return tmp_path / "run.mcap"


@pytest.mark.parametrize("compression", ["", "lz4", "zstd"])
def test_rosbags_reads_the_points_of_a_recorded_cloud_compressed_or_not(tmp_path: Path, compression: str):
    write(tmp_path / "run.mcap", compression)
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        ((connection, _, data), _) = reader.messages()
        theirs = reader.deserialize(data, connection.msgtype)
    assert (connection.topic, theirs.header.frame_id, theirs.width) == ("/front", "lidar", 3)
    assert theirs.data.tobytes() == points(0).tobytes()


def test_a_recording_returns_the_clouds_that_were_written(run: Path):
    with Recording(run) as recording:
        (first, second) = recording.measurements("cloud")
    for number, decoded in enumerate((first, second)):
        assert isinstance(decoded.message, PointCloud)
        assert cloud_from_message(decoded.message, "r1").points.tobytes() == points(number).tobytes()
        assert decoded.writer.edge_writer == "front"


def test_a_table_has_a_row_for_each_point_at_its_own_instant(run: Path):
    assert run_cli("export", str(run), "--stream", "cloud").stdout.startswith("exported 6 rows of cloud into")
    with run.with_suffix(".cloud.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        *("stamp", "robot", "writer", "cloud", "x", "y", "z", "t"),
        *("red", "green", "blue", "normal.0", "normal.1"),
    ]
    assert [int(row["stamp"]) - START for row in rows] == [0, 1000, 2000, 10**8, 10**8 + 1000, 10**8 + 2000]
    assert [int(row["cloud"]) - START for row in rows] == [0] * 3 + [10**8] * 3
    assert [(row["robot"], row["writer"], row["x"]) for row in rows[3:5]] == [("r1", "front", "1.0")] * 2
    assert [rows[0][name] for name in ("red", "green", "blue", "normal.1")] == ["255", "128", "1", "2.0"]
    assert rows[2]["x"] == "nan"


def test_parquet_has_the_types_of_the_fields(run: Path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pip install 'zstate[export]'")
    assert run_cli("export", str(run), "--stream", "cloud", "--parquet").code == 0
    table = parquet.read_table(run.with_suffix(".cloud.parquet"))
    types = {field.name: str(field.type) for field in table.schema}
    assert (types["stamp"], types["x"], types["t"], types["red"]) == ("int64", "float", "uint32", "uint8")
    assert table["y"].to_numpy()[:2].tolist() == [2.0, 3.0]


def test_ply_files_are_read_by_trimesh_with_positions_and_colours(run: Path):
    trimesh = pytest.importorskip("trimesh", reason="pip install 'zstate[view]'")
    assert run_cli("export", str(run), "--stream", "cloud", "--ply").stdout.startswith(
        "exported 2 files of cloud"
    )
    folder = run.with_suffix(".cloud.ply")
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == [f"r1.front.{START}.ply", f"r1.front.{START + 10**8}.ply"]
    read = trimesh.load(files[1])
    assert read.vertices[:2].tolist() == [[1.0, 2.0, 4.0], [1.0, 3.0, 5.0]]
    assert read.colors[:2, :3].tolist() == [[255, 128, 1], [1, 2, 3]]
    assert b"property uint t\n" in files[1].read_bytes()  # of stamps of 64 bits PLY has no type


def test_points_are_placed_in_a_frame_each_at_its_own_instant(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with RecordingBuilder(path, "r1") as builder:
        for number in range(2):
            stamp = START + number * 10**8
            message = cloud_to_message(Cloud(stamp, "lidar", points(number)), False)
            builder.encoder.write_message("r1", message, stamp, "front")
        for moved in (0, 2):  # 1 m in 1000 ns; after that its pose is not known
            builder.edges("r1", START + moved * 1000, {("map", "lidar"): pose(float(moved))})
    output = run_cli("export", str(path), "--stream", "cloud", "--frame", "map").stdout
    assert "exported 3 rows of cloud" in " ".join(output.split())
    assert "1 message left out (no pose)" in " ".join(output.split())
    with path.with_suffix(".cloud.csv").open() as file:
        rows = [tuple(float(row[name]) for name in "xyz") for row in csv.DictReader(file)]
    assert rows[:2] == [(0.0, 2.0, 4.0), (2.0, 3.0, 5.0)]
    assert np.isnan(rows[2]).all()
    with Recording(path) as recording:
        assert export_points(recording, "cloud", tmp_path / "points", frame="map") == (1, {"no pose": 1})
    elsewhere = ("--output", str(tmp_path / "hall.csv"), "--frame", "hall")
    assert "hall" in failure("export", str(path), "--stream", "cloud", *elsewhere)
    assert not (tmp_path / "hall.csv").exists()
    assert "--frame places points" in failure("export", str(path), "--csv", "--frame", "map", code=2)


def test_an_existing_folder_is_kept_unless_it_may_be_overwritten(run: Path):
    folder = run.with_suffix(".cloud.ply")
    folder.mkdir()
    assert "exists; choose another name, or pass --overwrite" in failure(
        "export", str(run), "--stream", "cloud", "--ply"
    )
    with Recording(run) as recording:
        with pytest.raises(RecordingError, match="exists"):
            export_points(recording, "cloud", folder)
        assert export_points(recording, "cloud", folder, overwrite=True) == (2, {})


def test_clouds_of_other_fields_do_not_fit_into_one_table(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with RecordingBuilder(path, "r1") as builder:
        for sensor, kind in (("front", POINT), ("rear", POINT[["x", "y", "z"]])):
            message = cloud_to_message(Cloud(START, "lidar", np.zeros(2, kind)), True)
            builder.encoder.write_message("r1", message, START, sensor)
    with Recording(path) as recording:
        with pytest.raises(InvalidInput, match="and later stamp, robot, writer, cloud, x, y, z, and"):
            export_stream(recording, "cloud", tmp_path / "run.csv", "csv")
        assert export_points(recording, "cloud", tmp_path / "points") == (2, {})


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--ply",), "--ply writes points: name their stream"),
        (("--ply", "--stream", "imu"), "the messages of 'imu' are no points"),
        (("--stream", "cloud"), "no message of 'cloud' can be used: there is none"),
    ],
)
def test_what_has_no_points_is_not_exported(tmp_path: Path, arguments: tuple[str, ...], text: str):
    with RecordingBuilder(tmp_path / "run.mcap", "arm") as builder:
        builder.describe("arm")
    ended = run_cli("export", str(tmp_path / "run.mcap"), *arguments)
    assert ended.code in (1, 2)
    assert text in ended.stderr.replace("\n", " ")
    assert not list(tmp_path.glob("*.csv"))
