"""Compaction: fewer files, with the same answers, and the same upkeep."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from archive.test_archive import MIDNIGHT, PAIRS, tour
from archive.test_upkeep import fleet
from helpers.processes import DEADLINE_S
from helpers.recording_builder import MS, RecordingBuilder, S, swing_positions

from zstate import Archive
from zstate.archive import compact, import_recording
from zstate.archive.storage import Store
from zstate.archive.upkeep import check, expire, forget
from zstate.odometry.messages import Imu
from zstate.recording.errors import RecordingError
from zstate.wire.messages import to_block

SECONDS = range(-2, 3)
STAMPS = np.arange(MIDNIGHT - 2 * S - 50 * MS, MIDNIGHT + 3 * S + 50 * MS, 7 * MS)


def split_tour(folder: Path) -> str:
    """An archive with a recording for each of five seconds around midnight; its URL."""
    for number in SECONDS:
        tour(folder / f"{number}.mcap", MIDNIGHT + number * S, MIDNIGHT + (number + 1) * S)
        import_recording(str(folder / "a"), folder / f"{number}.mcap")
    return str(folder / "a")


def answers(url: str) -> list[object]:
    """What an archive answers about the arm."""
    archive = Archive(url)
    found: list[object] = [archive.robots(), archive.coverage("arm")]
    for target, source in PAIRS:
        poses, valid = archive.lookup_many(target, source, STAMPS, robot="arm")
        found += [poses.tobytes(), valid.tobytes()]
    for start, end in ((STAMPS[0], STAMPS[-1]), (MIDNIGHT - S, MIDNIGHT + 900 * MS)):
        states = archive.joint_states("arm", int(start), int(end))
        buffer = archive.buffer("arm", int(start), int(end))
        first, last = STAMPS.searchsorted((start, end))
        poses, valid = buffer.lookup_many("map", "tip", STAMPS[first:last])
        found += [states.stamps.tobytes(), states.positions.tobytes(), poses.tobytes(), valid.tobytes()]
    with archive.duckdb() as sql:
        for query in (
            "SELECT * EXCLUDE (robot, date, stream) FROM joint_states ORDER BY stamp",
            "SELECT stamp, parent, child, x, covariance FROM transforms ORDER BY stamp, child",
            "SELECT stream, date, key, sum(rows), min(first), max(last) FROM files GROUP BY ALL ORDER BY ALL",
            "SELECT * FROM writers ORDER BY ALL",
            "SELECT * FROM frames ORDER BY ALL",
        ):
            found.append(repr(sql.sql(query).fetchall()))
    return found


def sample_files(url: str) -> list[Path]:
    return sorted(Path(url).glob("stream=*/*/*/*.parquet"))


def test_a_compacted_archive_has_one_file_for_each_date_and_the_same_answers(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("zstate.archive.ledger._ROWS_PER_GROUP", 2)  # of 15 files, some of an import in two
    url = split_tour(tmp_path)
    expected = answers(url)
    opened = Archive(url)
    assert opened.lookup_many("map", "tip", STAMPS, robot="arm")[1].any()
    before = len(sample_files(url))
    report = compact(url)
    assert not report.problems
    # joint states and two edges, on two dates; writers; the ledger
    assert (before, len(sample_files(url)), report.written) == (15, 6, 8)
    assert not list((tmp_path / "a" / "imports").glob("*")) if (tmp_path / "a" / "imports").exists() else True
    (ledger,) = (tmp_path / "a" / "compacted").iterdir()
    assert pq.read_metadata(ledger).num_row_groups == 8
    assert answers(url) == expected
    assert import_recording(url, tmp_path / "1.mcap").is_known
    assert opened.lookup_many("map", "tip", STAMPS, robot="arm")[0].tobytes() == expected[2]
    assert list(check(url)) == []
    again = compact(url)
    assert (again.files, again.written) == (0, 0)
    for file in sample_files(url):
        stamps = pq.read_table(file, partitioning=None).column("stamp").to_numpy()
        assert (np.diff(stamps) > 0).all()
        assert pq.read_metadata(file).num_row_groups == 1


def test_recordings_that_are_in_the_archive_add_nothing_and_others_do_after_a_compaction(tmp_path: Path):
    url = split_tour(tmp_path)
    whole = answers(url)
    late = tmp_path / "0.mcap"
    other = str(tmp_path / "b")
    for number in SECONDS:
        if number:
            import_recording(other, tmp_path / f"{number}.mcap")
    compact(other)
    assert import_recording(other, tmp_path / "1.mcap").is_known
    assert not import_recording(other, late).is_known  # between two that are in one file
    assert answers(other) == whole
    assert list(check(other)) == []
    compact(other)
    assert answers(other) == whole
    assert len(sample_files(other)) == 6
    assert list(check(other)) == []


def test_only_dates_before_the_given_one_are_merged(tmp_path: Path):
    url = split_tour(tmp_path)
    expected = answers(url)
    compact(url, "2023-11-15")
    folders = [file.parent.name for file in sample_files(url)]
    assert (folders.count("date=2023-11-14"), folders.count("date=2023-11-15")) == (3, 9)
    assert answers(url) == expected


def test_recordings_of_the_same_time_and_of_other_frames_keep_their_files(tmp_path: Path):
    url = str(tmp_path / "a")
    spans = ((0, 1000, 0.1), (800, 2000, 0.1), (2500, 3000, 0.2), (3100, 3500, 0.2))
    for number, (start, end, tip) in enumerate(spans):
        tour(tmp_path / f"{number}.mcap", MIDNIGHT + start * MS, MIDNIGHT + end * MS, tip=tip)
        import_recording(url, tmp_path / f"{number}.mcap")
    archive = Archive(url)
    stamps = np.arange(MIDNIGHT, MIDNIGHT + 4 * S, 7 * MS)
    expected = archive.lookup_many("map", "tip", stamps, robot="arm")
    compact(url)
    found = archive.lookup_many("map", "tip", stamps, robot="arm")
    assert np.array_equal(found[0], expected[0], equal_nan=True)
    assert np.array_equal(found[1], expected[1])
    assert len(list(Path(url).glob("stream=joint_states/*/*/*"))) == 3


def test_messages_of_other_streams_are_those_of_their_recordings(tmp_path: Path):
    url = str(tmp_path / "a")
    for part in range(3):
        with RecordingBuilder(tmp_path / f"{part}.mcap") as builder:
            builder.describe("r1", at=MIDNIGHT + part * S)
            for n in range(20):
                stamp = MIDNIGHT + part * S + (n * 40 + (n % 3) * 50) * MS
                message = Imu(stamp, n, 9, "imu_link", to_block([n, part, 3.0]), to_block([0.0, 0.0, 9.81]))
                builder.encoder.write_message("r1", message, stamp + MS, "front")
        import_recording(url, tmp_path / f"{part}.mcap")
    archive = Archive(url)
    windows = [(0, 2**62), (MIDNIGHT + 700 * MS, MIDNIGHT + 1200 * MS)]
    expected = [list(archive.messages("r1", "imu", *window)) for window in windows]
    assert len(expected[0]) == 60
    compact(url)
    assert len(list(Path(url).glob("stream=imu/*/*/*"))) == 1
    assert [list(archive.messages("r1", "imu", *window)) for window in windows] == expected


@pytest.mark.long
def test_a_compaction_that_is_interrupted_changes_no_answer_and_the_next_one_completes_it(
    tmp_path: Path, monkeypatch
):
    url = split_tour(tmp_path)
    expected = answers(url)
    put, remove = Store.put, Store.remove
    # 6 files of samples, one of writers, the ledger; then the removal of 15 files, 5 tables and 5 records
    for puts, removals in ((0, 99), (5, 99), (6, 99), (7, 99), (99, 0), (99, 5), (99, 9), (99, 9)):
        left_puts, left_removals = iter(range(puts)), iter(range(removals))

        def next_put(store: Store, source: Path, path: str, left: Iterator[int] = left_puts) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt
            put(store, source, path)

        def next_remove(store: Store, paths: list[str], left: Iterator[int] = left_removals) -> None:
            for path in paths:
                if next(left, None) is None:
                    raise KeyboardInterrupt
                remove(store, [path])

        with monkeypatch.context() as patched:
            patched.setattr(Store, "put", next_put)
            patched.setattr(Store, "remove", next_remove)
            with pytest.raises(KeyboardInterrupt):
                compact(url)
        assert answers(url) == expected
        words = ("interrupted", "other files have its rows")
        assert all(any(word in one.problem for word in words) for one in check(url))
    compact(url)
    assert answers(url) == expected
    assert len(sample_files(url)) == 6
    assert list(check(url)) == []


@pytest.mark.long
def test_a_compaction_that_is_killed_changes_no_answer(tmp_path: Path):
    url = split_tour(tmp_path)
    expected = answers(url)
    code = "import sys, zstate.archive; zstate.archive.compact(sys.argv[1])"
    killed = 0
    for tries in range(30):
        process = subprocess.Popen([sys.executable, "-c", code, url])
        try:
            process.wait(0.3 * 1.1**tries)
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(DEADLINE_S)
            killed += 1
        assert answers(url) == expected
    assert killed
    compact(url)
    assert answers(url) == expected
    assert list(check(url)) == []


def test_a_forgotten_robot_and_expired_days_leave_no_byte_in_a_compacted_archive(tmp_path: Path):
    url = fleet(tmp_path, ("r1", "r2"), days=3)
    compact(url)
    forget(url, "r1")
    assert list(check(url)) == []
    assert Archive(url).robots() == ("r2",)
    assert len(Archive(url).joint_states("r2", 0, 2**62)) == 30
    paths = [path for path in Path(url).rglob("*") if path.is_file()]
    assert not [path for path in paths if "r1" in str(path) or b"r1" in path.read_bytes()]
    assert import_recording(url, tmp_path / "0.mcap").is_known
    expire(url, "2023-11-16")
    assert [one.recording for one in Archive(url).coverage("r2")] == ["1.mcap", "2.mcap"]
    with Archive(url).duckdb() as sql:
        assert sql.sql("SELECT count(DISTINCT import) FROM writers").fetchall() == [(2,)]
    assert not import_recording(url, tmp_path / "0.mcap").is_known
    assert Archive(url).robots() == ("r1", "r2")
    compact(url)
    assert len(Archive(url).coverage("r2")) == 3
    expire(url, "2024-01-01")
    assert Archive(url).robots() == ()
    assert not list(Path(url).iterdir())


def test_a_damaged_file_is_not_merged_and_a_merged_one_is_repaired_by_its_recordings(tmp_path: Path):
    url = split_tour(tmp_path)
    expected = answers(url)
    file = next(Path(url).glob("stream=joint_states/*/date=2023-11-15/*"))
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    report = compact(url)
    assert len(report.problems) == 1
    assert len(list(file.parent.iterdir())) == 3
    file.write_bytes(content)
    compact(url)
    assert answers(url) == expected
    (merged,) = file.parent.iterdir()
    content = bytearray(merged.read_bytes())
    content[len(content) // 3] ^= 255
    merged.write_bytes(content)
    ((_, problem),) = check(url)
    assert problem.endswith("remove it, and add '0.mcap', '1.mcap', '2.mcap' again")
    merged.unlink()
    with pytest.raises(RecordingError, match="compacted"):
        Archive(url).joint_states("arm", MIDNIGHT, MIDNIGHT + S)
    for number in SECONDS:
        assert import_recording(url, tmp_path / f"{number}.mcap").is_known == (number < 0)
    assert all("other files have its rows" in one.problem for one in check(url))
    assert answers(url) == expected
    compact(url)
    assert answers(url) == expected
    assert list(check(url)) == []


def test_drivers_of_some_joints_each_are_merged_by_their_joints(tmp_path: Path):
    url = str(tmp_path / "a")
    for part in range(2):
        with RecordingBuilder(tmp_path / f"{part}.mcap", "arm") as builder:
            begin = MIDNIGHT + part * S
            builder.describe("arm", at=begin)
            for n in range(30):
                one, two = swing_positions(n / 50)
                builder.part("arm", begin + n * 20 * MS, {"shoulder": one}, "a", session=5, velocities=[one])
                builder.part("arm", begin + n * 30 * MS, {"elbow": two}, "b", session=6)
        import_recording(url, tmp_path / f"{part}.mcap")
    stamps = np.arange(MIDNIGHT, MIDNIGHT + 2 * S, 7 * MS)
    expected = Archive(url).lookup_many("world", "tool", stamps, robot="arm")
    assert expected[1].any()
    compact(url)
    found = Archive(url).lookup_many("world", "tool", stamps, robot="arm")
    assert np.array_equal(found[0], expected[0], equal_nan=True)
    assert len(list(Path(url).glob("stream=partial_joint_states/*/*/*"))) == 2
    with Archive(url).duckdb() as sql:
        query = (
            'SELECT count(*), count("position.shoulder"), count("position.elbow") FROM partial_joint_states'
        )
        assert sql.sql(query).fetchall() == [(120, 60, 60)]  # files of other columns in one view
