"""Poses of Arrow batches, and SQL: the same answers however the rows are cut."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest
from archive.test_archive import DAY, MIDNIGHT, tour
from helpers.recording_builder import MS, S

from zstate import Archive, Recording
from zstate.archive import import_recording, poses
from zstate.errors import InvalidInput, UnknownFrame

NAMES = [f"world.tip.{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Archive:
    folder = tmp_path_factory.mktemp("archive")
    tour(folder / "r.mcap", MIDNIGHT - 2 * S, MIDNIGHT + 2 * S)
    import_recording(str(folder / "a"), folder / "r.mcap")
    return Archive(str(folder / "a"))


@pytest.fixture(scope="module")
def expected(archive: Archive) -> np.ndarray:
    with Recording(Path(archive.url).parent / "r.mcap", "arm") as recording:
        stamps = recording.joint_states().stamps
        return recording.lookup_many("world", "tip", stamps)[0]


def rows_of(archive: Archive) -> pa.Table:
    history = archive.joint_states("arm", 0, 2**62)
    robots = pa.array(["arm"] * len(history)).dictionary_encode()
    return pa.table({"robot": robots, "stamp": history.stamps, "n": np.arange(len(history))})


def matrix(table: pa.Table) -> np.ndarray:
    return np.stack([table.column(name).to_numpy() for name in NAMES], axis=1)


@pytest.mark.parametrize("size", [1, 7, 64, 1000])
def test_poses_do_not_depend_on_how_rows_are_cut(archive: Archive, expected: np.ndarray, size: int):
    function = pickle.loads(pickle.dumps(poses("world", "tip", archive=archive.url)))
    rows = rows_of(archive)
    batches = rows.combine_chunks().to_batches(size)
    found = pa.Table.from_batches([function(batch) for batch in batches])
    assert found.column("n").to_pylist() == list(range(len(rows)))
    assert np.isfinite(expected).any()
    assert np.array_equal(matrix(found), expected, equal_nan=True)


def test_poses_do_not_depend_on_the_order_of_rows(archive: Archive, expected: np.ndarray):
    function = poses("world", "tip", archive=archive.url)
    order = np.random.default_rng(3).permutation(len(expected))
    found = [function(rows_of(archive).take(part)) for part in np.array_split(order, 5)]
    assert np.array_equal(matrix(pa.concat_tables(found)), expected[order], equal_nan=True)


def test_batches_without_robots_and_unknown_frames_are_named(archive: Archive):
    with pytest.raises(InvalidInput, match="the batch has stamp"):
        poses("world", "tip", archive=archive.url)(pa.table({"stamp": [MIDNIGHT]}))
    with pytest.raises(UnknownFrame, match="nowhere"):
        poses("world", "nowhere", archive=archive.url)(rows_of(archive))


def test_sql_has_views_and_poses(archive: Archive, expected: np.ndarray):
    with archive.duckdb() as connection:
        counts = connection.sql(
            "SELECT robot, date, sum(rows) FROM files WHERE stream = 'joint_states' GROUP BY ALL ORDER BY ALL"
        ).fetchall()
        assert counts == [("arm", "2023-11-14", 100), ("arm", "2023-11-15", 100)]
        assert connection.sql("SELECT count(*) FROM joint_states WHERE date = '2023-11-15'").fetchall() == [
            (100,)
        ]
        assert connection.sql("SELECT child, z FROM frames WHERE kind = 'static'").fetchall() == [
            ("arm/tip", 0.1)
        ]
        assert connection.sql("SELECT epoch_ns(min(time)) FROM joint_states").fetchall() == [
            (MIDNIGHT - 2 * S,)
        ]
        found = connection.sql(
            "SELECT pose.* FROM (SELECT stamp, zstate_pose(robot, 'world', 'tip', stamp) AS pose "
            "FROM joint_states) ORDER BY stamp"
        ).fetchall()
    known = [None not in row for row in found]
    assert known == np.isfinite(expected[:, 0]).tolist()
    assert np.array_equal(np.array([row for row in found if None not in row]), expected[known])


def test_other_programs_read_the_files_without_zstate(archive: Archive):
    history = archive.joint_states("arm", 0, 2**62)
    pattern = f"{archive.url}/stream=joint_states/**/*.parquet"
    with_polars = pl.read_parquet(pattern, hive_partitioning=True).sort("stamp")
    assert with_polars["stamp"].to_list() == history.stamps.tolist()
    with_pandas = pd.read_parquet(f"{archive.url}/stream=joint_states").sort_values("stamp")
    for table in (with_polars, with_pandas):
        assert set(table["robot"]) == {"arm"}
        for column, name in enumerate(history.coordinates):
            assert np.array_equal(table[f"position.{name}"].to_numpy(), history.positions[:, column])
    edges = pl.read_parquet(f"{archive.url}/stream=transforms/**/*.parquet", hive_partitioning=True)
    assert set(edges["child"]) == {"arm/world", "arm/odom"}
    assert edges["stamp"].min() >= MIDNIGHT - 2 * S - 60 * MS
    assert edges["stamp"].max() < MIDNIGHT + DAY
