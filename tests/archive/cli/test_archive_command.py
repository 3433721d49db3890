"""zstate archive: recordings are added, listed, checked and removed."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path

import pytest
from archive.test_archive import MIDNIGHT, tour
from helpers.cli_runner import failure, published_robot, run_cli
from helpers.recording_builder import RecordingBuilder, S, swing_positions

from zstate import Archive
from zstate.recording.background_store import run
from zstate.recording.info import read_info
from zstate.recording.stores import opened_path
from zstate.view.data_source import ViewSource


def test_recordings_are_added_once_and_listed_by_robot(tmp_path: Path):
    url = str(tmp_path / "a")
    assert "has no recording" in failure("archive", url)
    for number in range(2):
        start = MIDNIGHT + number * 2 * S
        tour(tmp_path / f"{number}.mcap", start, start + S)
    files = [str(path) for path in sorted(tmp_path.glob("*.mcap"))]
    added = run_cli("archive", url, "--from", *files)
    assert added.code == 0
    assert added.stdout.count("50 joint_states") == 2
    assert "nothing missing" in added.stdout
    assert (
        run_cli("archive", url, "--from", files[0]).stdout.replace("\n", " ").count("in the archive already")
        == 1
    )
    heading, row = run_cli("archive", url).stdout.splitlines()
    assert heading.split() == ["ROBOT", "RECORDINGS", "FROM", "TO", "SAMPLES"]
    assert re.fullmatch(r"arm +2 +2023-11-15 00:00:00 +2023-11-15 00:00:02 +\d+", row)


def test_a_minute_of_the_archive_is_a_recording_for_all_other_commands(tmp_path: Path):
    tour(tmp_path / "r.mcap", MIDNIGHT + 30 * S, MIDNIGHT + 31 * S)
    url, minute = str(tmp_path / "a"), str(tmp_path / "minute.mcap")
    assert run_cli("archive", url, "--from", str(tmp_path / "r.mcap")).code == 0
    written = run_cli("archive", url, "cut", minute, "arm", "--at", "2023-11-15T00:00").stdout
    assert "50 joint_states" in written.replace("\n", " ")
    assert "arm" in run_cli("info", minute).stdout
    assert "exists" in failure("archive", url, "cut", minute, "arm", "--at", "2023-11-15T00:00")
    half = str(tmp_path / "half.mcap")
    stamps = ("--from", "2023-11-15T00:00:30", "--to", str(MIDNIGHT + 30 * S + S // 2))
    assert "26 joint_states" in run_cli("archive", url, "cut", half, "arm", *stamps).stdout.replace("\n", " ")
    assert "--from TIME --to TIME" in failure("archive", url, "cut", half, "arm", code=2)
    assert "no time like" in failure("archive", url, "cut", half, "arm", "--at", "noon", code=2)


def test_commands_take_a_window_of_an_archive_where_they_take_a_file(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tour(tmp_path / "r.mcap", MIDNIGHT + 30 * S, MIDNIGHT + 31 * S)
    assert run_cli("archive", "a", "--from", "r.mcap").code == 0
    minute = ("--at", "2023-11-15T00:00")
    assert run_cli("export", "a", "arm", "--csv", *minute).code == 0
    assert run_cli("export", "r.mcap", "arm", "--csv").code == 0
    assert (tmp_path / "arm.csv").read_text() == (tmp_path / "r.csv").read_text()
    half = ("--from", "2023-11-15T00:00:30", "--to", str(MIDNIGHT + 30 * S + S // 2))
    drawn = run_cli("plot", "arm", "--file", "a", *half).stdout
    assert "wrote arm.png: 2 curves, 26 samples" in drawn
    assert "no robot 'leg'" in failure("export", "a", "leg", "--csv", *minute)
    assert "is an archive: name one robot" in failure("export", "a", "arm", "--csv")
    assert "'r.mcap' is no archive" in failure("plot", "arm", "--file", "r.mcap", *minute)
    assert "need --file" in failure("plot", "arm", *minute, code=2)
    assert "--from TIME --to TIME" in failure("export", "a", "arm", "--csv", *minute, *half, code=2)


def test_a_view_of_an_archive_has_the_robot_of_that_minute(tmp_path: Path):
    tour(tmp_path / "r.mcap", MIDNIGHT + 30 * S, MIDNIGHT + 31 * S)
    url = str(tmp_path / "a")
    assert run_cli("archive", url, "--from", str(tmp_path / "r.mcap")).code == 0
    with (
        opened_path(url, "arm", (MIDNIGHT, MIDNIGHT + 60 * S)) as opened,
        ViewSource.from_recording(opened.path) as source,
    ):
        assert source.robots() == ("arm",)
        assert source.span.newest - source.span.oldest > 0.9 * S
    assert not opened.path.exists()
    assert "are for an archive" in failure("view", "arm", "--robot", "arm", code=2)


def test_a_recording_that_cannot_be_added_is_named_and_the_others_are_in(tmp_path: Path):
    tour(tmp_path / "good.mcap", MIDNIGHT, MIDNIGHT + S)
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    url, bad = str(tmp_path / "a"), str(tmp_path / "bad.mcap")
    said = failure("archive", url, "--from", bad, str(tmp_path / "good.mcap"))
    assert "1 recording not added" in said
    assert run_cli("archive", url).stdout.splitlines()[1].startswith("arm")
    assert "at least one RECORDING" in failure("archive", url, "--from", code=2)


def test_upkeep_names_damaged_files_and_removes_days_and_robots(tmp_path: Path):
    url = str(tmp_path / "a")
    today = int(datetime.now(UTC).timestamp()) * S
    for name, start in (("old", MIDNIGHT), ("new", today - 86_400 * S)):
        with RecordingBuilder(tmp_path / f"{name}.mcap", "arm") as builder:
            builder.describe("arm", at=start)
            for n in range(3):
                builder.joints("arm", start + n, swing_positions(n))
        assert run_cli("archive", url, "--from", str(tmp_path / f"{name}.mcap")).code == 0
    assert "as they were written" in run_cli("archive", url, "check").stdout
    assert "2 files in place of 4" in run_cli("archive", url, "compact", "--before", "1d").stdout
    assert "nothing to merge" in run_cli("archive", url, "compact").stdout
    assert "before 20" in run_cli("archive", url, "expire", "--before", "90d").stdout
    assert run_cli("archive", url).stdout.splitlines()[1].split()[:2] == ["arm", "1"]
    assert "no date like" in failure("archive", url, "expire", "--before", "soon", code=2)
    (file,) = (tmp_path / "a").rglob("stream=joint_states/**/*.parquet")
    file.write_bytes(file.read_bytes()[:-1])
    said = run_cli("archive", url, "check")
    assert said.code == 1
    assert "another digest" in said.stdout.replace("\n", " ")
    assert "of arm" in run_cli("archive", url, "forget", "arm").stdout
    assert "no robot 'arm'" in failure("archive", url, "forget", "arm")


@pytest.mark.long
def test_finished_files_of_a_recording_are_added_before_they_are_deleted(tmp_path: Path):
    url, pattern = str(tmp_path / "a"), str(tmp_path / "rec-%Y%m%d-%H%M%S.mcap")
    with published_robot():
        # A second of this robot has more than 1 kB, so a file is deleted as soon as it is added.
        ended = run_cli(
            *("record", pattern, "--seconds", "1.5", "--split-seconds", "1", "--keep", "1kB"),
            *("--archive", url),
        )
    assert ended.code == 0, ended.stderr
    count = int(re.search(r"added (\d+) files to", ended.stdout.replace("\n", " "))[1])
    assert len(Archive(url).coverage("rrbot")) == count >= 2


@pytest.mark.long
def test_a_recording_goes_on_if_its_files_cannot_be_added_and_they_are_named(tmp_path: Path):
    taken, file = tmp_path / "file", tmp_path / "run.mcap"
    taken.write_text("")
    with published_robot():
        ended = run_cli("record", str(file), "--seconds", "1", "--archive", str(taken))
    assert ended.code == 1
    assert f"nothing lost; added 0 files to {taken}, 1 not" in ended.stdout.replace("\n", " ")
    assert read_info(file).complete
    assert f"'{file}' is not in {taken}: " in ended.stderr
    assert f"1 file of the recording not in {taken}; add them by `zstate archive" in ended.stderr


def test_a_store_takes_a_finished_recording_and_returns_why_it_cannot(tmp_path: Path):
    tour(tmp_path / "r.mcap", MIDNIGHT, MIDNIGHT + S)
    url = str(tmp_path / "a")
    assert run(url) is None
    assert run(url, str(tmp_path / "r.mcap")) is None
    assert Archive(url).robots() == ("arm",)
    assert "cannot be read" in run(url, str(tmp_path / "none.mcap"))
    (tmp_path / "file").write_text("")
    assert "Not a directory" in run(str(tmp_path / "file"), str(tmp_path / "r.mcap"))
