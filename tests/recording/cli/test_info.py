from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from helpers.cli_runner import failure, run_cli
from helpers.pictures import jpeg
from helpers.processes import until
from helpers.robots import RRBOT, STAMP, wait_for_stream_readers
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from zstate.cameras.messages import CompressedImage
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.nodes.publisher import StatePublisher
from zstate.recording.recorder import Recorder
from zstate.wire.native import encode, encoding_of


@pytest.fixture
def run(sessions: tuple[Session, Session], tmp_path: Path) -> Path:
    """Fifty samples of one robot."""
    writer, reader = sessions
    path = tmp_path / "run.mcap"
    with StatePublisher(writer, RRBOT, "r1") as publisher, Recorder(reader, path, ["r1"]) as recorder:
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        for number in range(50):
            publisher.publish([0.0, 0.0], stamp=STAMP + number)
        until(lambda: all(recorder.stats.messages.get(("r1", s), 0) == 50 for s in ("joint_states", "tf")))
    return path


def facts(path: Path) -> dict:
    return json.loads(run_cli("info", str(path), "--json").stdout)


def test_info_agrees_with_rosbags(run: Path):
    info = facts(run)
    with AnyReader([run]) as reader:
        assert (info["start"], info["end"]) == (reader.start_time, reader.end_time - 1)
        assert info["messages"] == reader.message_count
        counts = {name: topic.msgcount for name, topic in reader.topics.items()}
    (robot,) = info["robots"]
    assert {stream["topic"]: stream["count"] for stream in robot["streams"]} == counts
    assert info["bytes_per_s"] == info["size"] / info["duration_s"]
    assert (info["size"], info["complete"], info["losses"]) == (run.stat().st_size, True, [])
    assert info["files"] == [str(run)]


def test_info_names_the_messages_that_the_recorder_did_not_get(
    sessions: tuple[Session, Session], tmp_path: Path
):
    path = tmp_path / "run.mcap"
    with (
        Recorder(sessions[1], path, ["r1"]) as recorder,
        KeyPublisher(sessions[0], "zstate/r1/image/wrist", encoding_of(CompressedImage)) as camera,
    ):
        until(lambda: camera.has_readers)
        for seq in (1, 2, 5, 6, 8):  # without 3, 4 and 7
            camera.put(encode(CompressedImage(STAMP + seq, seq, 7, "lens", "jpeg", jpeg())))
        until(lambda: recorder.stats.messages.get(("r1", "image")) == 5)
    assert facts(path)["missing"] == {"r1/image": 3}
    assert "\n  3 messages of r1 image did not arrive, or were dropped\n" in run_cli("info", str(path)).stdout
    damaged = path.with_name("cut.mcap")
    damaged.write_bytes(path.read_bytes()[:-1])  # without its end, the file is searched
    assert facts(damaged)["missing"] == {"r1/image": 3}


def test_info_has_model_streams_rates_and_writers_of_a_robot(run: Path):
    info = facts(run)
    (robot,) = info["robots"]
    assert robot["robot"] == "r1"
    assert robot["model"] == {
        "name": RRBOT.name,
        "links": list(RRBOT.links),
        "joints": list(RRBOT.joint_names),
    }
    streams = {stream["stream"]: stream for stream in robot["streams"]}
    assert streams["joint_states"]["rate_hz"] == pytest.approx(49 / info["duration_s"])
    assert streams["tf_static"]["rate_hz"] is None
    assert all(" pid " in stream["writer"] for stream in streams.values())


def test_text_has_the_same_facts_as_json(run: Path):
    text = run_cli("info", str(run)).stdout
    info = facts(run)
    head, start, end, *_ = text.splitlines()
    assert re.fullmatch(rf"{re.escape(str(run))}: [\d.]+ kB \(mcap, zstd\) by zstate \S+", head)
    assert start.split()[-1] == str(info["start"])
    assert end.split()[-1] == str(info["end"])
    assert re.search(
        rf"\n{info['messages']} messages in {info['duration_s']:.3f} s\n.+ a second, .+ a day\ncomplete\n",
        text,
    )
    links, joints = len(RRBOT.links), len(RRBOT.joints)
    assert f"r1: model '{RRBOT.name}', {links} links, {joints} joints (2 driven)" in text
    assert re.search(
        r"^  joint_states +/joint_states +sensor_msgs/msg/JointState +50 +[\d.]+ Hz ", text, re.M
    )


def test_truncated_recording_is_reported_with_the_recover_command(run: Path):
    run.write_bytes(run.read_bytes()[:-40])
    text = run_cli("info", str(run)).stdout
    assert "\nnot complete\n" in text
    assert f"`zstate recover {run}`" in text
    assert "r1: model " in text
    assert "how many messages did not arrive, and what followed, is not known" in " ".join(text.split())
    info = facts(run)
    assert (info["complete"], info["missing_known"], info["recoverable"]) == (False, False, [str(run)])
    whole = run.with_name("whole.mcap")
    run_cli("recover", str(run), str(whole))
    assert [facts(whole)[name] for name in ("complete", "missing_known")] == [True, False]


def test_info_of_a_ros_bag_lists_other_topics(tmp_path: Path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind in (("/arm/joint_states", "JointState"), ("/image", "Image")):
            name = f"sensor_msgs/msg/{kind}"
            writer.write(writer.add_connection(topic, name, typestore=store), 5, b"\0\1\0\0")
    info = facts(tmp_path / "bag")
    (robot,) = info["robots"]
    assert (robot["robot"], robot["model"]) == ("arm", None)
    assert [(other["topic"], other["count"]) for other in info["others"]] == [("/image", 1)]
    text = run_cli("info", str(tmp_path / "bag")).stdout
    assert "arm: no model" in text
    assert re.search(r"other topics\n  /image +sensor_msgs/msg/Image +1 +-", text)


def test_file_that_is_not_a_recording_is_refused(tmp_path: Path):
    assert "No such file" in failure("info", str(tmp_path / "nothing.mcap"))
    (tmp_path / "notes.txt").write_text("hello, this is a note")
    assert "is not a recording" in failure("info", str(tmp_path / "notes.txt"))
