from __future__ import annotations

import re
from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, published_robot, started, zstate

from zstate import StatePublisher, connect, load_model
from zstate.recording.info import read_info
from zstate.recording.reader import RecordingReader

pytestmark = pytest.mark.processes


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
        ended = zstate("record", str(path), "left", "--duration", "1")
    assert ended.returncode == 0, ended.stderr
    assert read_info(path).robots == ("left",)
    with RecordingReader(path) as reader:
        assert {channel.topic for channel in reader.channels()} == {
            *("/robot_description", "/tf_static", "/joint_states", "/tf"),
        }


def test_record_prints_the_reason_while_it_waits_and_the_start(spawn: Spawn, tmp_path: Path):
    command = started(spawn, "record", str(tmp_path / "run.mcap"), "rrbot")
    assert command.line().endswith("  no robot yet")
    with published_robot("rrbot"):
        while not command.line().endswith("  rrbot"):
            pass
        interrupted(command)
    waiting, recording = (
        next(number for number, line in enumerate(command.stderr.splitlines()) if line.startswith(word))
        for word in ("waiting: robot 'rrbot' is not announced", "recording rrbot: ")
    )
    assert waiting < recording


def test_empty_recording_fails_with_the_reason(tmp_path: Path):
    message = failure("record", str(tmp_path / "run.mcap"), "--duration", "1")
    assert "nothing was recorded: no robot is announced" in message
    assert "nothing was recorded: robot 'r1' is not announced" in failure(
        "record", str(tmp_path / "other.mcap"), "r1", "--duration", "1"
    )


def test_the_suffix_is_added_and_a_file_that_exists_is_kept_unless_it_may_be_overwritten(tmp_path: Path):
    with published_robot():
        given = ("record", str(tmp_path / "run"), "--duration", "0.7")
        assert f"recording into '{tmp_path}/run.mcap'" in zstate(*given).stderr.decode()
        before = (tmp_path / "run.mcap").read_bytes()
        message = failure(*given)
        assert "exists; choose another name" in message
        assert "--overwrite" in message
        assert (tmp_path / "run.mcap").read_bytes() == before
        assert zstate(*given, "--overwrite").returncode == 0
    assert (tmp_path / "run.mcap").read_bytes() != before


def test_a_recording_is_split_by_time_and_all_files_are_named(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with published_robot():
        ended = zstate("record", str(path), "--duration", "2.5", "--split-seconds", "1")
    assert f"into 3 files, {path} to run_2.mcap (" in ended.stdout.decode()
    assert len(read_info(path).files) == 3


def test_losses_are_reported(tmp_path: Path):
    with published_robot(streams=("joint_states",)):
        ended = zstate("record", str(tmp_path / "run.mcap"), "rrbot", "--duration", "1")
    assert re.search(r"lost \d+ without a description that fits", ended.stdout.decode())


def test_ros_robot_is_recorded_over_its_wire(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with connect() as session, StatePublisher(session, load_model("rrbot"), "r1", wires=("ros2",)):
        ended = zstate("record", str(path), "--wire", "ros2", "--mode", "peer", "--duration", "1.5")
    assert ended.returncode == 0, ended.stderr
    assert {channel.topic for channel in read_info(path).channels} == {"/robot_description", "/tf_static"}
    assert "no wire 'nonsense'" in failure("record", "x", "--wire", "nonsense", code=2)


def test_invalid_limits_and_names_are_refused(tmp_path: Path):
    path = str(tmp_path / "run.mcap")
    for option in ("--duration", "--split-size", "--split-seconds"):
        for value in ("0", "-1", "nan", "inf"):
            assert option in failure("record", path, option, value, code=2)
    assert "'a/b'" in failure("record", path, "a/b")
    assert "no folder" in failure("record", str(tmp_path / "nowhere" / "run.mcap"))
    assert not list(tmp_path.iterdir())
