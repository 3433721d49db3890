"""An archive on an object store, and on a cluster: the same answers as in one process."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from archive.test_archive import MIDNIGHT, assert_same_lookups, tour
from archive.test_batches import matrix
from helpers.recording_builder import MS, S

from zstate import Archive, Recording
from zstate.archive import compact, import_recording
from zstate.archive.upkeep import check, expire, forget

HELPERS = Path(__file__).parents[1] / "helpers"
pytestmark = [pytest.mark.cluster, pytest.mark.soak]


def python() -> str:
    return os.environ["ZSTATE_CLUSTER_PYTHON"]


@pytest.fixture
def bucket(monkeypatch) -> Iterator[str]:
    """The URL of an archive in a bucket that nothing else has."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([python(), str(HELPERS / "object_store.py")], text=True, **pipes) as server:
        address = next(line.strip() for line in server.stdout if line.startswith("127"))
        yield f"s3://fleet/year?endpoint_override={quote(f'http://{address}', safe='')}"
        server.kill()


def test_an_archive_on_an_object_store_answers_as_the_recording(tmp_path: Path, bucket: str):
    tour(tmp_path / "r.mcap", MIDNIGHT - S, MIDNIGHT + S)
    assert Archive(bucket).robots() == ()
    assert not import_recording(bucket, tmp_path / "r.mcap").is_known
    assert import_recording(bucket, tmp_path / "r.mcap").is_known
    archive = Archive(bucket)
    with Recording(tmp_path / "r.mcap", "arm") as recording:
        assert_same_lookups(archive, recording, np.arange(MIDNIGHT - S, MIDNIGHT + S, 9 * MS))
    assert list(check(bucket)) == []
    with archive.duckdb() as connection:
        assert connection.sql("SELECT count(*) FROM joint_states").fetchall() == [(100,)]
    tour(tmp_path / "later.mcap", MIDNIGHT + S, MIDNIGHT + 2 * S)
    import_recording(bucket, tmp_path / "later.mcap")
    stamps = np.arange(MIDNIGHT - S, MIDNIGHT + 2 * S, 9 * MS)
    expected, valid = archive.lookup_many("map", "tip", stamps, robot="arm")
    assert compact(bucket).files > 8
    found, is_found = archive.lookup_many("map", "tip", stamps, robot="arm")
    assert np.array_equal(found, expected, equal_nan=True)
    assert np.array_equal(is_found, valid)
    assert import_recording(bucket, tmp_path / "later.mcap").is_known
    assert list(check(bucket)) == []
    with Archive(bucket).duckdb() as connection:
        query = "SELECT date, count(*), count(DISTINCT stamp) FROM joint_states GROUP BY ALL ORDER BY ALL"
        rows = [(str(day), *counts) for day, *counts in connection.sql(query).fetchall()]
        assert rows == [("2023-11-14", 50, 50), ("2023-11-15", 100, 100)]
    expire(bucket, "2023-11-15")
    assert len(Archive(bucket).joint_states("arm", 0, 2**62)) == 100
    forget(bucket, "arm")
    assert Archive(bucket).robots() == ()


@pytest.mark.timeout(600)
def test_ray_gives_the_poses_of_one_process_though_a_worker_is_killed(tmp_path: Path):
    tour(tmp_path / "r.mcap", MIDNIGHT - 5 * S, MIDNIGHT + 5 * S)
    url, output = str(tmp_path / "a"), str(tmp_path / "poses.parquet")
    import_recording(url, tmp_path / "r.mcap")
    command = [python(), str(HELPERS / "ray_poses.py"), url, "world", "tip", output]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "2 nodes, one worker killed" in ended.stdout
    assert_same_poses(url, pq.read_table(output))


@pytest.mark.timeout(600)
def test_dask_gives_the_poses_of_one_process_from_processes_of_its_own(tmp_path: Path):
    tour(tmp_path / "r.mcap", MIDNIGHT - 5 * S, MIDNIGHT + 5 * S)
    url, output = str(tmp_path / "a"), str(tmp_path / "poses.parquet")
    import_recording(url, tmp_path / "r.mcap")
    command = [python(), str(HELPERS / "dask_poses.py"), url, "world", "tip", output]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "2 partitions, in other processes" in ended.stdout  # one for each date
    assert_same_poses(url, pq.read_table(output))


def assert_same_poses(url: str, table: pa.Table) -> None:
    """The poses of all rows of the archive, as it looks them up."""
    stamps = table.column("stamp").to_numpy()
    assert stamps.tolist() == list(range(MIDNIGHT - 5 * S, MIDNIGHT + 5 * S, 20 * MS))
    expected, valid = Archive(url).lookup_many("world", "tip", stamps, robot="arm")
    assert valid.sum() > 400
    assert np.array_equal(matrix(table), expected, equal_nan=True)
