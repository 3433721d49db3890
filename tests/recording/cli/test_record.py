from __future__ import annotations

import re
import shutil
import time
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path

import pytest
from helpers.cli_runner import (
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import mounted_disk, until

from zstate import StatePublisher, connect, load_model
from zstate.clock import MONOTONIC, ManualClock
from zstate.recording.cli import record
from zstate.recording.cli.record import DiskForecast
from zstate.recording.info import read_info
from zstate.recording.reader import RecordingReader
from zstate.recording.recorder import RecorderStats


@pytest.mark.processes
def test_ctrl_c_ends_a_recording_with_a_complete_file_and_a_summary(spawn: Spawn, tmp_path: Path):
    path = tmp_path / "run.mcap"
    with published_robot("left"), published_robot("right"):
        command = started(spawn, "record", str(path))
        lines = [command.line() for _ in range(2)]
        interrupted(command)
    assert re.fullmatch(r"\d s  \d+ messages  \d+\.\d/s  [\d.]+ kB  left, right", lines[1])
    summary = command.line()
    assert summary.startswith("recorded ")
    assert " messages of left, right in " in summary
    assert f"into {path} (" in summary
    assert "; nothing lost" in summary
    assert "recording left: joint_states, robot_description, tf, tf_static" in command.stderr
    info = read_info(path)
    assert (info.complete, set(info.robots)) == (True, {"left", "right"})
    assert info.message_count == int(summary.split()[1])


def test_a_duration_ends_it_and_only_the_chosen_robot_is_recorded(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with published_robot("left"), published_robot("right"):
        ended = run_cli("record", str(path), "left", "--seconds", "1")
    assert ended.code == 0, ended.stderr
    assert read_info(path).robots == ("left",)
    with RecordingReader(path) as reader:
        assert {channel.topic for channel in reader.channels()} == {
            *("/robot_description", "/tf_static", "/joint_states", "/tf"),
        }


def test_record_prints_the_reason_while_it_waits_and_the_start(tmp_path: Path):
    def watch(command: Command) -> None:
        assert command.line().endswith("  no robot yet")
        publisher.enter_context(published_robot("rrbot"))
        until(lambda: command.line().endswith("  rrbot"))

    with ExitStack() as publisher:
        ended = run_watched(watch, "record", str(tmp_path / "run.mcap"), "rrbot")
    waiting, recording = (
        next(number for number, line in enumerate(ended.stderr.splitlines()) if line.startswith(word))
        for word in ("waiting: robot 'rrbot' is not announced", "recording rrbot: ")
    )
    assert waiting < recording


def test_empty_recording_fails_with_the_reason(tmp_path: Path):
    message = failure("record", str(tmp_path / "run.mcap"), "--seconds", "1")
    assert "nothing was recorded: no robot is announced" in message
    assert "nothing was recorded: robot 'r1' is not announced" in failure(
        "record", str(tmp_path / "other.mcap"), "r1", "--seconds", "1"
    )


def test_the_suffix_is_added_and_a_file_that_exists_is_kept_unless_it_may_be_overwritten(tmp_path: Path):
    with published_robot():
        given = ("record", str(tmp_path / "run"), "--seconds", "0.7")
        assert f"recording into '{tmp_path}/run.mcap'" in run_cli(*given).stderr
        before = (tmp_path / "run.mcap").read_bytes()
        message = failure(*given)
        assert "exists; choose another name" in message
        assert "--overwrite" in message
        assert (tmp_path / "run.mcap").read_bytes() == before
        assert run_cli(*given, "--overwrite").code == 0
    assert (tmp_path / "run.mcap").read_bytes() != before


def test_a_recording_is_split_by_time_and_all_files_are_named(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with published_robot():
        ended = run_cli("record", str(path), "--seconds", "2.5", "--split-seconds", "1")
    named = re.search(rf"into (\d+) files, {re.escape(str(path))} to run_(\d+).mcap \(", ended.stdout)
    assert named is not None
    # Three of a second each; a busy machine may end later than after 2.5 s.
    assert len(read_info(path).files) == int(named[1]) == int(named[2]) + 1 >= 3


def test_losses_are_reported(tmp_path: Path):
    with published_robot(streams=("joint_states",)):
        ended = run_cli("record", str(tmp_path / "run.mcap"), "rrbot", "--seconds", "1")
    assert re.search(r"lost \d+ without a description that fits", ended.stdout)


def test_ros_robot_is_recorded_over_its_wire(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with connect() as session, StatePublisher(session, load_model("rrbot"), "r1", wires=("ros2",)):
        ended = run_cli("record", str(path), "--wire", "ros2", "--mode", "peer", "--seconds", "1.5")
    assert ended.code == 0, ended.stderr
    assert {channel.topic for channel in read_info(path).channels} == {"/robot_description", "/tf_static"}
    assert "no wire 'nonsense'" in failure("record", "x", "--wire", "nonsense", code=2)


def test_invalid_limits_and_names_are_refused(tmp_path: Path):
    path = str(tmp_path / "run.mcap")
    for option in ("--seconds", "--split-size", "--split-seconds"):
        for value in ("0", "-1", "nan", "inf"):
            assert option in failure("record", path, option, value, code=2)
    assert "'a/b'" in failure("record", path, "a/b")
    assert "no folder" in failure("record", str(tmp_path / "nowhere" / "run.mcap"))
    assert not list(tmp_path.iterdir())


@pytest.fixture
def short_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is checked every second, not every ten."""
    monkeypatch.setattr(record, "_DISK_WINDOW_NS", 900_000_000)


def test_what_is_lost_is_named_by_its_stream():
    missing = {("r1", "cloud"): 61, ("r1", "image"): 2}
    stats = RecorderStats({("r1", "cloud"): 100}, 9, (Path("run.mcap"),), 22, 41, {}, 0, missing=missing)
    text = "22 dropped here, 41 missed on the way (61 of r1 cloud, 2 of r1 image)"
    assert record._lost(stats) == text


@pytest.mark.parametrize(("part_of_a_day", "is_warned"), [(0.8, True), (1.25, False)])
def test_a_disk_that_is_full_within_a_day_at_the_rate_of_ten_seconds_is_a_single_warning(
    tmp_path: Path, part_of_a_day: float, is_warned: bool
):
    clock, written = ManualClock(0, MONOTONIC), 0
    forecast = DiskForecast(
        lambda: RecorderStats({}, written, (tmp_path / "run.mcap",), 0, 0, {}, 0), None, clock
    )
    written = round(10.0 * shutil.disk_usage(tmp_path).free / (part_of_a_day * 86_400.0))
    clock.set(10_000_000_000 - 1)
    assert forecast.warning() == ""
    clock.set(10_000_000_000)
    assert ("is full in" in forecast.warning()) == is_warned
    written *= 2
    clock.set(20_000_000_000)
    assert not is_warned or forecast.warning() == ""


@pytest.mark.disk
@pytest.mark.usefixtures("short_window")
def test_disk_that_fills_within_a_day_is_a_single_warning(tmp_path: Path):
    # 100 samples a second need at least 100 bytes each; in a day that is 800 MB.
    with published_robot(), mounted_disk(tmp_path / "disk", "64m") as disk:
        log = run_cli("record", str(disk / "run.mcap"), "--seconds", "4").stderr  # three checks
        assert log.count(f"the disk of '{disk}/run.mcap' is full in ") == 1
        assert "or bound recordings with --keep and --split-size" in log


@pytest.mark.disk
@pytest.mark.usefixtures("short_window")
def test_disk_that_recordings_cannot_fill_is_no_warning(tmp_path: Path):
    with published_robot(), mounted_disk(tmp_path / "disk", "64m") as disk:
        file = str(disk / "%Y%m%d-%H%M%S.mcap")
        ended = run_cli("record", file, "--split-size", "1", "--keep", "20MB", "--seconds", "3")
        assert ended.code == 0, ended.stderr
        assert "is full" not in ended.stderr


def test_start_times_replace_directives_and_a_second_start_makes_a_second_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    with published_robot():
        before = datetime.now().replace(microsecond=0)
        first = run_cli("record", "--seconds", "1.2")
        contents = {path: path.read_bytes() for path in tmp_path.iterdir()}
        assert run_cli("record", "--seconds", "1.2").code == 0
        after = datetime.now()
    one, two = sorted(path.name for path in tmp_path.iterdir())
    assert [path.name for path in contents] == [one]
    assert (tmp_path / one).read_bytes() == contents[Path(tmp_path / one)]
    starts = [datetime.strptime(name, "rec-%Y%m%d-%H%M%S.mcap") for name in (one, two)]
    assert before <= starts[0] < starts[1] <= after
    assert f"recording into '{one}'" in first.stderr


def test_files_of_a_split_recording_have_the_time_of_its_start(tmp_path: Path):
    pattern = str(tmp_path / "%%-%Y-%j.mcap")
    with published_robot():
        today = datetime.now()
        ended = run_cli("record", pattern, "--seconds", "1.5", "--split-seconds", "1")
    assert ended.code == 0, ended.stderr
    first = f"%-{today:%Y-%j}"
    assert {path.name for path in tmp_path.iterdir()} == {f"{first}.mcap", f"{first}_1.mcap"}


def test_name_of_a_start_that_exists_is_refused_with_a_better_pattern(tmp_path: Path):
    (tmp_path / f"{datetime.now():%Y}.mcap").write_text("mine")
    message = failure("record", str(tmp_path / "%Y.mcap"))
    assert "exists; choose another name" in message
    assert "each start has a file of its own if FILE has the seconds" in message
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_unknown_directives_are_refused(tmp_path: Path):
    message = failure("record", str(tmp_path / "rec-%B.mcap"), code=2)
    assert "FILE: the file name 'rec-%B.mcap' has '%B'; write %Y" in message


def test_keep_deletes_the_oldest_recordings_at_the_start_and_after_each_split(tmp_path: Path):
    old = tmp_path / "rec-20200101-000000.mcap"
    notes = tmp_path / "rec-20200102-000000.mcap"
    other = tmp_path / "run.mcap"
    with published_robot():
        for path in (old, other):
            assert run_cli("record", str(path), "--seconds", "1").code == 0
        notes.write_text("not a recording")
        # A second of this robot has more than 1 kB, so only the file being written stays.
        ended = run_cli(
            *("record", str(tmp_path / "rec-%Y%m%d-%H%M%S.mcap"), "--seconds", "3.5"),
            *("--split-seconds", "1", "--keep", "1kB"),
        )
    assert ended.code == 0, ended.stderr
    (last,) = set(tmp_path.iterdir()) - {notes, other}
    assert last.name.endswith("_3.mcap")
    assert read_info(last).complete
    log = ended.stderr
    assert f"deleted '{old}' (" in log
    assert log.count("deleted ") == log.count(": --keep 1kB") == 4
    assert "; deleted 4 files (" in ended.stdout


def test_keep_deletes_by_age(tmp_path: Path):
    pattern = str(tmp_path / "rec-%Y%m%d-%H%M%S.mcap")
    with published_robot():
        assert run_cli("record", pattern, "--seconds", "1").code == 0
        (first,) = tmp_path.iterdir()
        ended = run_cli("record", pattern, "--seconds", "1", "--keep", "1h")
        assert first.exists()
        assert "--keep deletes recordings at this start only" in ended.stderr
        written = first.stat().st_mtime
        ended = run_cli("record", pattern, "--seconds", "1", "--keep", f"{time.time() - written:.3f}s")
    assert not first.exists()
    assert "; deleted 1 file (" in ended.stdout


def test_keep_is_refused_where_it_cannot_work(tmp_path: Path):
    pattern = str(tmp_path / "rec-%Y%m%d.mcap")
    assert "put the time into it, such as rec-%Y" in failure(
        "record", str(tmp_path / "run"), "--keep", "7d", code=2
    )
    by_size = failure("record", pattern, "--keep", "50MB", "--split-size", "60", code=2)
    assert "--keep 50MB is less than one file of --split-size 60 MB" in by_size
    by_time = failure("record", pattern, "--keep", "1min", "--split-seconds", "90", code=2)
    assert "--keep 1min is less than one file of --split-seconds 90" in by_time
    for bound in ("50", "7w", "0d"):
        assert "kB, MB, GB, TB of files in total, or s, min, h, d" in failure(
            "record", pattern, "--keep", bound, code=2
        )
    assert not list(tmp_path.iterdir())
