"""Bags: the forms of metadata.yaml that rosbag2 wrote over the years, and folders without one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.recording_files import joint_states, write_run

from zstate.recording.errors import RecordingError
from zstate.recording.reader import RecordingReader, bag_files

# As `ros2 bag record` of Foxy, Humble and Jazzy writes it: yaml-cpp, lists one step in.
BY_ROSBAG2 = """\
rosbag2_bagfile_information:
  version: {version}
  storage_identifier: {storage}
  duration:
    nanoseconds: 4990000000
  starting_time:
    nanoseconds_since_epoch: 1700000000000000000
  message_count: 2
  topics_with_message_count:
    - topic_metadata:
        name: /tf
        type: tf2_msgs/msg/TFMessage
        serialization_format: cdr
        offered_qos_profiles: "- history: 3\\n  depth: 0\\n  reliability: 1"
      message_count: 2
  compression_format: ""
  compression_mode: ""
  relative_file_paths:
    - {first}
    - {second}
  files:
    - path: {first}
      starting_time:
        nanoseconds_since_epoch: 1700000000000000000
  custom_data: ~
  ros_distro: jazzy
"""
# As rosbags writes it: ruamel, sorted, lists not moved in, long texts folded.
BY_RUAMEL = """\
rosbag2_bagfile_information:
  compression_format: ''
  compression_mode: ''
  custom_data:
    relative_file_paths: a trap
  relative_file_paths:
  - {first}
  - '{second}'
  storage_identifier: {storage}
  topics_with_message_count:
  - message_count: 200
    topic_metadata:
      name: /joint_states
      offered_qos_profiles: "- history: 3 and a text that is folded
        storage_identifier: another trap"
  version: {version}
"""


def bag(folder: Path, text: str, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "metadata.yaml").write_text(text)
    for name in names:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("text", [BY_ROSBAG2, BY_RUAMEL], ids=["rosbag2", "ruamel"])
@pytest.mark.parametrize(
    ("version", "storage", "paths"),
    [
        (3, "sqlite3", ("bag/bag_0.db3", "bag/bag_1.db3")),
        (5, "sqlite3", ("bag_0.db3", "bag_1.db3")),
        (9, "mcap", ("my bag_9.mcap", "my bag_10.mcap")),
    ],
)
def test_files_come_in_the_order_of_the_metadata(
    tmp_path: Path, text: str, version: int, storage: str, paths: tuple[str, str]
):
    names = [Path(path).name for path in paths]
    filled = text.format(version=version, storage=storage, first=paths[0], second=paths[1])
    folder = bag(tmp_path / "bag", filled, *names)
    assert bag_files(folder) == [folder / name for name in names]


def test_path_that_leads_out_of_the_bag_is_not_followed(tmp_path: Path):
    text = BY_ROSBAG2.format(version=9, storage="mcap", first="../secret.mcap", second="/etc/bag_1.mcap")
    folder = bag(tmp_path / "bag", text, "secret.mcap", "bag_1.mcap")
    assert bag_files(folder) == [folder / "secret.mcap", folder / "bag_1.mcap"]


GOOD = BY_ROSBAG2.format(version=9, storage="mcap", first="a_0.mcap", second="a_1.mcap")
AS_JSON = {
    "rosbag2_bagfile_information": {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": ["a_0.mcap", "a_1.mcap"],
    }
}


@pytest.mark.parametrize(
    ("before", "after", "reason"),
    [
        ("version: 9", "version: 10", "version is '10', and 1 to 9 are known"),
        ("version: 9", "version: nine", "version is 'nine'"),
        ("  version: 9\n", "", "'version' is not one word"),
        ("storage_identifier: mcap", "storage_identifier: rocksdb", "storage is 'rocksdb'"),
        ("storage_identifier: mcap", "storage_identifier: *anchor", "undefined alias"),
        ('compression_mode: ""', "compression_mode: FILE", "compressed by file"),
        ("relative_file_paths:", "relative_files:", "no list 'relative_file_paths'"),
        ("    - a_0.mcap\n", "    - [a_0.mcap]\n", "a path in its 'relative_file_paths' is not one word"),
        ("custom_data: ~", f"custom_data: {'[' * 60}{']' * 60}", "nested more than 50 deep"),
        ("  version: 9\n", "  version: 9\n  version: 9\n", "the key 'version' twice"),
        ("rosbag2_bagfile_information:", "something:", "with the key 'rosbag2_bagfile_information'"),
        ("a_1.mcap", "a_7.mcap", "files that are not there"),
        (GOOD, "", "it is not a mapping"),
    ],
)
def test_unsupported_metadata_is_refused_with_the_reason(
    tmp_path: Path, before: str, after: str, reason: str
):
    assert before in GOOD
    folder = bag(tmp_path / "bag", GOOD.replace(before, after), "a_0.mcap", "a_1.mcap")
    with pytest.raises(RecordingError) as caught:
        bag_files(folder)
    assert reason in str(caught.value)
    assert caught.value.path == str(folder / "metadata.yaml")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("  version: 9", "  # by hand\n  version: 9  # the newest"),
        ("  version: 9", '  "version": "9"'),
        ("storage_identifier: mcap", "storage_identifier: &storage mcap"),
        (
            "relative_file_paths:\n    - a_0.mcap\n    - a_1.mcap",
            "relative_file_paths: [a_0.mcap, 'a_1.mcap']",
        ),
        ("    - a_1.mcap\n", "    - >-\n      a_1.mcap\n"),
        (GOOD, f"%YAML 1.1\n---\n{GOOD}..."),
        (GOOD, json.dumps(AS_JSON)),
    ],
    ids=["comments", "quotes", "anchor", "flow list", "folded", "document", "json"],
)
def test_any_spelling_of_yaml_is_read(tmp_path: Path, before: str, after: str):
    assert before in GOOD
    folder = bag(tmp_path / "bag", GOOD.replace(before, after), "a_0.mcap", "a_1.mcap")
    assert bag_files(folder) == [folder / "a_0.mcap", folder / "a_1.mcap"]


def test_binary_metadata_is_refused(tmp_path: Path):
    folder = bag(tmp_path / "bag", "")
    (folder / "metadata.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match="cannot be read"):
        bag_files(folder)


def test_bag_without_metadata_is_read_by_file_numbers(tmp_path: Path):
    folder = tmp_path / "bag"
    folder.mkdir()
    for number in (0, 2, 10):
        write_run(folder / f"bag_{number}.mcap", joint_states(5))
    last = folder / "bag_10.mcap"
    last.write_bytes(last.read_bytes()[:-1])
    assert [file.name for file in bag_files(folder)] == ["bag_0.mcap", "bag_2.mcap", "bag_10.mcap"]
    with RecordingReader(folder) as reader:
        assert len(list(reader.records(["/joint_states"]))) == 15
        assert not reader.complete


def test_folder_of_several_recordings_or_none_is_refused(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"no .mcap or .db3 file; name a recording's file"):
        bag_files(tmp_path)
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).touch()
    with pytest.raises(RecordingError, match="files of 2 recordings"):
        bag_files(tmp_path)
