"""Interrupted imports, damaged files, and removal: each costs only what it is about."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from archive.test_archive import DAY, MIDNIGHT, tour
from helpers.processes import DEADLINE_S
from helpers.recording_builder import MS, RecordingBuilder, S, swing_positions

from zstate import Archive, Recording
from zstate.archive import import_recording
from zstate.archive.storage import Store
from zstate.archive.upkeep import check, expire, forget
from zstate.errors import InvalidInput
from zstate.recording.errors import RecordingError


def files_of(folder: Path) -> dict[str, bytes]:
    """The contents of all files by their paths, without the record, which has the time of the import."""
    files = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.parquet")}
    return {path: content for path, content in files.items() if not path.startswith("imports")}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    tour(tmp_path / "r.mcap", MIDNIGHT - S, MIDNIGHT + S)
    return tmp_path / "r.mcap"


def fleet(folder: Path, robots: tuple[str, ...], days: int) -> str:
    """An archive with one recording of all ``robots`` for each of ``days``; its URL."""
    for day in range(days):
        path = folder / f"{day}.mcap"
        with RecordingBuilder(path) as builder:
            for robot in robots:
                start = MIDNIGHT + day * DAY
                builder.describe(robot, at=start)
                for n in range(10):
                    builder.joints(robot, start + n * 100 * MS, swing_positions(n))
        import_recording(str(folder / "a"), path)
    return str(folder / "a")


def test_a_recording_that_is_added_twice_adds_nothing(tmp_path: Path, recording: Path):
    url = str(tmp_path / "a")
    assert not import_recording(url, recording).is_known
    before = files_of(tmp_path / "a")
    assert import_recording(url, recording).is_known
    assert files_of(tmp_path / "a") == before


def test_an_import_counts_once_it_is_complete_and_a_second_one_completes_it(
    tmp_path: Path, recording: Path, monkeypatch
):
    import_recording(str(tmp_path / "whole"), recording)
    count = len(files_of(tmp_path / "whole")) + 1
    put = Store.put
    for number in (0, 1, count // 2, count - 1):
        url = str(tmp_path / f"a{number}")
        left = iter(range(number))

        def interrupted(store: Store, source: Path, path: str, left: Iterator[int] = left) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt
            put(store, source, path)

        with monkeypatch.context() as patched:
            patched.setattr(Store, "put", interrupted)
            with pytest.raises(KeyboardInterrupt):
                import_recording(url, recording)
        assert Archive(url).robots() == ()
        assert len(files_of(tmp_path / f"a{number}")) == number
        import_recording(url, recording)
        assert files_of(tmp_path / f"a{number}") == files_of(tmp_path / "whole")
        assert list(check(url)) == []


@pytest.mark.long
def test_sql_shows_nothing_of_an_import_that_is_not_complete(tmp_path: Path, recording: Path, monkeypatch):
    url = str(tmp_path / "a")
    import_recording(url, recording)
    queries = [f"SELECT count(*) FROM {name}" for name in ("joint_states", "transforms", "writers", "frames")]
    with Archive(url).duckdb() as connection:
        counts = [connection.sql(query).fetchall() for query in queries]
    tour(tmp_path / "later.mcap", MIDNIGHT + S, MIDNIGHT + 2 * S, tip=0.2)
    put = Store.put

    def interrupted(store: Store, source: Path, path: str) -> None:
        if path.startswith("imports"):
            raise KeyboardInterrupt
        put(store, source, path)

    with monkeypatch.context() as patched:
        patched.setattr(Store, "put", interrupted)
        with pytest.raises(KeyboardInterrupt):
            import_recording(url, tmp_path / "later.mcap")
    with Archive(url).duckdb() as connection:
        assert [connection.sql(query).fetchall() for query in queries] == counts
    import_recording(url, tmp_path / "later.mcap")
    with Archive(url).duckdb() as connection:
        assert connection.sql(queries[0]).fetchall()[0][0] == counts[0][0][0] + 50


def test_an_import_that_is_killed_leaves_the_archive_as_it_was(tmp_path: Path, recording: Path):
    code = "import sys, zstate.archive; zstate.archive.import_recording(*sys.argv[1:])"
    url = tmp_path / "a"
    killed = 0
    for tries in range(20):
        process = subprocess.Popen([sys.executable, "-c", code, str(url), str(recording)])
        try:
            process.wait(0.4 * 1.15**tries)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(DEADLINE_S)
        if Archive(str(url)).robots():
            break  # its record was written: all of it is in
        killed += 1
        problems = [one.problem for one in check(str(url))]
        assert all("interrupted" in problem for problem in problems)
    assert killed
    import_recording(str(url), recording)
    assert list(check(str(url))) == []
    assert Archive(str(url)).lookup_many("world", "tip", [MIDNIGHT], robot="arm")[1].all()


def test_each_file_that_cannot_be_used_is_named_and_costs_only_itself(tmp_path: Path):
    url = fleet(tmp_path, ("r1", "r2"), days=3)
    root = tmp_path / "a"
    damaged, missing = (
        next(root.glob(f"stream=joint_states/robot={robot}/date=2023-11-1{day}/*"))
        for robot, day in (("r1", 5), ("r2", 6))
    )
    content = bytearray(damaged.read_bytes())
    content[len(content) // 4 : len(content) // 2] = bytes(len(content) // 2 - len(content) // 4)
    damaged.write_bytes(content)
    missing.unlink()
    (damaged.parent / "notes.parquet").write_bytes(b"no Parquet at all")
    (root / "readme.txt").write_text("of the operator")
    name = missing.name.partition(".")[0]
    table = pa.table({"stamp": [1]}).replace_schema_metadata({"zstate.archive": "2"})
    pq.write_table(table, missing.with_name(f"{name}.00.parquet"))
    left = root / f".import-{name}"
    left.mkdir()
    (left / "0").write_bytes(b"")
    found = {Path(path).name: problem for path, problem in check(url)}
    assert found.keys() == {
        damaged.name,
        missing.name,
        "notes.parquet",
        "readme.txt",
        f"{name}.00.parquet",
        "0",
    }
    assert "another digest" in found[damaged.name]
    assert "missing" in found[missing.name]
    assert "version 2" in found[f"{name}.00.parquet"]
    assert "interrupted" in found["0"]
    assert "not a file of an archive" in found["notes.parquet"]
    archive = Archive(url)
    for robot, day in (("r1", 1), ("r1", 2), ("r2", 0), ("r2", 2)):
        start = MIDNIGHT + day * DAY
        with Recording(tmp_path / f"{day}.mcap") as recording:
            expected = recording.joint_states(robot).positions
        assert np.array_equal(archive.joint_states(robot, start, start + S).positions, expected)
    start = MIDNIGHT + DAY
    with pytest.raises(RecordingError, match="r2"):
        archive.joint_states("r2", start, start + S)
    with pytest.raises(RecordingError, match="r1"):
        archive.joint_states("r1", MIDNIGHT, MIDNIGHT + S)


def test_a_damaged_file_is_repaired_by_its_recording(tmp_path: Path, recording: Path):
    url = str(tmp_path / "a")
    import_recording(url, recording)
    before = files_of(tmp_path / "a")
    file = next((tmp_path / "a").glob("stream=transforms/*/*/*"))
    file.write_bytes(b"PAR1")
    ((path, problem),) = check(url)
    assert path == str(file.relative_to(tmp_path / "a"))
    assert problem.endswith("remove it, and add 'r.mcap' again")
    file.unlink()
    import_recording(url, recording)
    assert files_of(tmp_path / "a") == before
    assert list(check(url)) == []


def test_a_recording_that_is_not_complete_is_refused(tmp_path: Path, recording: Path):
    content = recording.read_bytes()
    recording.write_bytes(content[: len(content) * 3 // 4])
    with pytest.raises(RecordingError, match="zstate recover"):
        import_recording(str(tmp_path / "a"), recording)
    assert not (tmp_path / "a").exists()


def test_expired_days_are_gone_and_their_recordings_can_be_added_again(tmp_path: Path):
    url = fleet(tmp_path, ("r1", "r2"), days=3)
    removed = expire(url, "2023-11-16")
    assert removed.files >= 2
    assert list(check(url)) == []
    archive = Archive(url)
    assert [one.recording for one in archive.coverage("r1")] == ["1.mcap", "2.mcap"]
    assert not list((tmp_path / "a").glob("**/date=2023-11-15"))
    assert not import_recording(url, tmp_path / "0.mcap").is_known
    assert len(Archive(url).coverage("r2")) == 3
    expire(url, "2024-01-01")
    assert Archive(url).robots() == ()
    assert not list((tmp_path / "a").iterdir())


def test_a_forgotten_robot_leaves_no_byte_and_the_others_stay(tmp_path: Path):
    url = fleet(tmp_path, ("r1", "r2"), days=2)
    forget(url, "r1")
    assert list(check(url)) == []
    archive = Archive(url)
    assert archive.robots() == ("r2",)
    assert len(archive.joint_states("r2", 0, 2**62)) == 20
    paths = [path for path in (tmp_path / "a").rglob("*") if path.is_file()]
    assert paths
    assert not [path for path in paths if "r1" in str(path) or b"r1" in path.read_bytes()]
    with pytest.raises(InvalidInput, match="no robot 'r1'"):
        forget(url, "r1")
