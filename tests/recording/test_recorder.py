"""Recording robots over real sessions on loopback."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, new_threads, until
from helpers.robots import RRBOT, STAMP, UPRIGHT, SampleCollector, wait_for_reader, wait_for_stream_readers
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from zstate.driving import Commander, DriverHost, Limits, SimulatedDriver, stop
from zstate.driving.driver import StopMode
from zstate.driving.messages import JointCommand, Stop
from zstate.errors import InvalidInput
from zstate.model.kinematics import MovingEdges
from zstate.model.load import load_model
from zstate.model.robot import RobotModel
from zstate.net.latched import LatchedPublisher
from zstate.net.presence import announce, local_writer
from zstate.net.session import Session, connect
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import (
    FixPublisher,
    ImuPublisher,
    MagneticFieldPublisher,
    OdometryPublisher,
    PosePublisher,
    PressurePublisher,
    VelocityPublisher,
)
from zstate.recording.errors import RecordingError
from zstate.recording.info import read_info, recorded_robots
from zstate.recording.player import Player
from zstate.recording.reader import RecordingReader
from zstate.recording.recorder import Recorder
from zstate.recording.recording import Recording
from zstate.scans import Grid, MapPublisher, ScanPublisher
from zstate.sources import SineSource
from zstate.transform import Transform
from zstate.wire.keys import WRITER_TOKEN
from zstate.wire.measurements import covariance_matrix
from zstate.wire.messages import ClockMessage, JointState, from_block, order_digest, to_block
from zstate.wire.native import encode, encoding_of
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import RmwKeys

ODOMETRY_STREAMS = ("imu", "velocity", "pose", "fix", "magnetic_field", "pressure", "odometry")

PERIOD = 1_000_000
ROS_KEYS = RmwKeys(Ros2Options())
SCANNER: dict[str, float] = {
    "angle_min": -1.0,
    "angle_increment": 0.5,
    "range_min": 0.1,
    "range_max": 10.0,
    "ray_ns": 1000,
}
GRIPPER = load_model("gripper")


def by_rosbags(path: Path) -> Iterator[tuple[str, Any]]:
    """Topic and message of each record, as rosbags reads the file."""
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            yield connection.topic, reader.deserialize(data, connection.msgtype)


def by_mcap_ros2(path: Path) -> Iterator[tuple[str, Any]]:
    """The same, as mcap-ros2-support reads it."""
    with path.open("rb") as stream:
        for _, channel, _, message in make_reader(
            stream, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            yield channel.topic, message


OTHERS = [by_rosbags, by_mcap_ros2]


def stamp_of(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def read(path: Path, topic: str) -> list[Any]:
    return [message for name, message in by_rosbags(path) if name == topic]


def count(recorder: Recorder, robot: str, stream: str = "joint_states") -> int:
    return recorder.stats.messages.get((robot, stream), 0)


def publish_paced(
    publisher: StatePublisher, recorder: Recorder, reader: Session, number: int
) -> list[np.ndarray]:
    """Publishes samples of a sine as fast as ``reader`` receives those of "r1"; their positions."""
    sine = SineSource(publisher.model)
    sent = [sine.read(STAMP + k * PERIOD * 10).positions for k in range(number)]
    with closing(SampleCollector(reader, "zstate/r1/tf")) as tap:
        for k, positions in enumerate(sent):
            publisher.publish(positions, stamp=STAMP + k * PERIOD)
            if k % 10 == 9:  # a network whose reader is behind drops samples
                tap.payloads(k + 1)
    until(lambda: count(recorder, "r1") == count(recorder, "r1", "tf") == number)
    return sent


@pytest.fixture(scope="module")
def panda() -> RobotModel:
    return load_model("panda")


@pytest.fixture
def ten_thousand(sessions, tmp_path: Path, panda: RobotModel) -> tuple[Path, list[np.ndarray]]:
    """A recording of at least ten thousand moving transforms, and the positions they were made of."""
    writer, reader = sessions
    path = tmp_path / "run.mcap"
    with StatePublisher(writer, panda, "r1") as publisher, Recorder(reader, path) as recorder:
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        sent = publish_paced(publisher, recorder, reader, 1300)
    assert recorder.failure is None
    stats = recorder.stats
    assert (stats.dropped, stats.missed, stats.refused, stats.unwritten) == (0, 0, {}, 0)
    return path, sent


@pytest.mark.robots
@pytest.mark.long
def test_other_readers_get_ten_thousand_identical_transforms(ten_thousand, panda: RobotModel):
    path, sent = ten_thousand
    moving = MovingEdges(panda)
    edges = [(form.parent, form.child) for form in moving.forms]
    for reader in OTHERS:
        compared = 0
        samples = (message for topic, message in reader(path) if topic == "/tf")
        for k, message in enumerate(samples):
            poses = dict(zip(edges, moving.poses(sent[k]), strict=True))
            for edge in message.transforms:
                move, turn = edge.transform.translation, edge.transform.rotation
                pose = [move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w]
                assert pose == poses[edge.header.frame_id, edge.child_frame_id].tolist()
                assert stamp_of(edge.header) == STAMP + k * PERIOD
                compared += 1
        assert compared >= 10_000


@pytest.mark.robots
def test_other_readers_get_joint_states_bit_for_bit(ten_thousand, panda: RobotModel):
    path, sent = ten_thousand
    for reader in OTHERS:
        states = [message for topic, message in reader(path) if topic == "/joint_states"]
        assert len(states) == len(sent)
        for k, (state, positions) in enumerate(zip(states, sent, strict=True)):
            assert tuple(state.name) == panda.joint_names
            assert list(state.position) == positions.tolist()
            assert stamp_of(state.header) == STAMP + k * PERIOD


@pytest.mark.robots
@pytest.mark.long
def test_recording_has_the_model_and_its_fixed_edges(ten_thousand, panda: RobotModel):
    path, _ = ten_thousand
    for reader in OTHERS:
        described = [message.data for topic, message in reader(path) if topic == "/robot_description"]
        fixed = [message for topic, message in reader(path) if topic == "/tf_static"]
        assert described == [panda.urdf]
        children = {edge.child_frame_id for edge in fixed[0].transforms}
        assert children == {joint.child for joint in panda.joints if joint.type == "fixed"}


def test_several_robots_have_a_namespace_and_a_prefix_each(sessions, tmp_path: Path):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "left") as left,
        StatePublisher(writer, GRIPPER, "right") as right,
        Recorder(reader, tmp_path / "run.mcap") as recorder,
    ):
        for robot in ("left", "right"):
            wait_for_stream_readers(writer, robot, "joint_states", "tf")
        left.publish([0.1, 0.2], stamp=STAMP)
        right.publish(SineSource(GRIPPER).read(STAMP).positions, stamp=STAMP)
        until(lambda: count(recorder, "left", "tf") == count(recorder, "right", "tf") == 1)
        until(lambda: all(count(recorder, robot, "tf_static") for robot in ("left", "right")))
    (state,) = read(tmp_path / "run.mcap", "/left/joint_states")
    assert state.position.tolist() == [0.1, 0.2]
    assert len(read(tmp_path / "run.mcap", "/right/joint_states")) == 1
    assert {topic for topic, _ in by_rosbags(tmp_path / "run.mcap")} == {
        *("/tf", "/tf_static", "/left/joint_states", "/left/robot_description"),
        *("/right/joint_states", "/right/robot_description"),
    }
    recorded = {
        edge.child_frame_id for message in read(tmp_path / "run.mcap", "/tf") for edge in message.transforms
    }
    recorded |= {
        edge.child_frame_id
        for message in read(tmp_path / "run.mcap", "/tf_static")
        for edge in message.transforms
    }
    links = {f"left/{joint.child}" for joint in RRBOT.joints}
    assert recorded == links | {f"right/{joint.child}" for joint in GRIPPER.joints}


def test_later_robot_gets_its_own_namespace(sessions, tmp_path: Path):
    writer, reader = sessions
    with (
        Recorder(reader, tmp_path / "run.mcap") as recorder,
        StatePublisher(writer, RRBOT, "first") as first,
    ):
        wait_for_stream_readers(writer, "first")
        first.publish([0.0, 0.0], stamp=STAMP)
        until(lambda: count(recorder, "first") == 1)
        with StatePublisher(writer, RRBOT, "second") as second:
            second.publish([0.0, 0.0], stamp=STAMP)
            until(lambda: count(recorder, "second") == 1)
    assert len(read(tmp_path / "run.mcap", "/joint_states")) == 1
    assert len(read(tmp_path / "run.mcap", "/second/joint_states")) == 1


def test_only_selected_robots_are_recorded_and_a_single_one_in_the_root(sessions, tmp_path: Path):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "left") as left,
        StatePublisher(writer, RRBOT, "right") as right,
        StatePublisher(writer, RRBOT, "third") as third,
        Recorder(reader, tmp_path / "one.mcap", "left") as one,
        Recorder(reader, tmp_path / "two.mcap", ["left", "right"]) as two,
    ):
        wait_for_stream_readers(writer, "left")
        wait_for_stream_readers(writer, "right")
        for publisher in (third, right, left):
            publisher.publish([0.0, 0.0], stamp=STAMP)
        until(lambda: count(one, "left") == count(two, "left") == count(two, "right") == 1)
    assert {robot for robot, _ in one.stats.messages} == {"left"}
    assert {robot for robot, _ in two.stats.messages} == {"left", "right"}
    assert len(read(tmp_path / "one.mcap", "/joint_states")) == 1
    assert len(read(tmp_path / "two.mcap", "/left/joint_states")) == 1


def test_recorder_of_several_robots_has_no_more_threads_than_of_two(sessions, tmp_path: Path):
    def threads(count: int) -> int:
        before = threading.enumerate()
        with Recorder(sessions[1], tmp_path / f"{count}.mcap", [f"r{number}" for number in range(count)]):
            return len(new_threads(before))

    assert threads(20) == threads(2)


def test_samples_before_the_description_are_recorded_after_it(sessions, tmp_path: Path):
    writer, reader = sessions
    with Recorder(reader, tmp_path / "run.mcap", ["r1"]) as recorder:
        wait_for_stream_readers(writer, "r1")
        with StatePublisher(writer, RRBOT, "r1", streams=("joint_states",)) as publisher:
            publisher.publish([0.25, 0.5], stamp=STAMP)
            until(lambda: recorder.stats.unwritten == 1)
            with StatePublisher(writer, RRBOT, "r1", streams=("robot_description",)):
                until(lambda: count(recorder, "r1") == 1)
    assert recorder.stats.unwritten == 0
    (state,) = read(tmp_path / "run.mcap", "/joint_states")
    assert (state.name, state.position.tolist()) == (list(RRBOT.joint_names), [0.25, 0.5])


def test_restarted_writer_has_its_own_channel_and_name(sessions, tmp_path: Path):
    writer, reader = sessions
    with Recorder(reader, tmp_path / "run.mcap", ["r1"]) as recorder:
        for start in (1, 2):
            with StatePublisher(writer, RRBOT, "r1") as publisher:
                wait_for_stream_readers(writer, "r1")
                until(lambda wanted=start: len(recorder._programs) == wanted)
                publisher.publish([0.0, float(start)], stamp=STAMP + start)
                until(lambda wanted=start: count(recorder, "r1") == wanted)
    with RecordingReader(tmp_path / "run.mcap") as recording:
        records = list(recording.records(["/joint_states"]))
        metadata = [record.metadata for record in records]
    assert len({facts["zstate.session"] for facts in metadata}) == 2
    assert all(facts["zstate.robot"] == "r1" and " pid " in facts["zstate.program"] for facts in metadata)
    assert [record.publish_time for record in records] == [STAMP + 1, STAMP + 2]
    assert all(abs(record.log_time - time.time_ns()) < 60_000_000_000 for record in records)


def test_changed_and_withdrawn_static_edges_are_recorded(sessions, tmp_path: Path):
    writer, reader = sessions
    with Recorder(reader, tmp_path / "run.mcap", ["r1"]) as recorder:
        with StaticPublisher(writer, "r1", "mount") as statics:
            statics.set(Transform("tool", "hook", (0.0, 0.0, 0.25), UPRIGHT))
            until(lambda: count(recorder, "r1", "tf_static") == 1)
            statics.set(Transform("fleet/map", "camera", (1.0, 0.0, 0.0), UPRIGHT))
            until(lambda: count(recorder, "r1", "tf_static") == 2)
        until(lambda: count(recorder, "r1", "tf_static") == 3)
    recorded = [
        [(edge.header.frame_id, edge.child_frame_id) for edge in message.transforms]
        for message in read(tmp_path / "run.mcap", "/tf_static")
    ]
    assert recorded == [[("tool", "hook")], [("tool", "hook"), ("fleet/map", "camera")], []]


def put_state(publisher: KeyPublisher, seq: int, stamp: int = STAMP) -> None:
    names = ("a",)
    state = JointState(stamp, seq, 5, order_digest(names), to_block([0.5]), None, None, names)
    publisher.put(encode(state))


def test_missed_undecodable_and_unwritable_messages_are_counted(sessions, tmp_path: Path):
    writer, reader = sessions
    key = "zstate/r1/joint_states"
    with (
        Recorder(reader, tmp_path / "run.mcap", ["r1"]) as recorder,
        KeyPublisher(writer, key, encoding_of(JointState)) as ours,
        KeyPublisher(writer, key, "text/plain") as foreign,
    ):
        until(lambda: ours.has_readers and foreign.has_readers)
        for seq in (7, 8, 12):
            put_state(ours, seq)
        put_state(ours, 13, stamp=0)
        put_state(ours, 14, stamp=2**31 * 1_000_000_000)
        ours.put(b"\x93")
        foreign.put(b"hello")
        put_state(ours, 15)
        until(lambda: count(recorder, "r1") == 4)
        until(lambda: sum(recorder.stats.refused.values()) == 4)
    stats = recorder.stats
    assert (stats.missed, stats.dropped, stats.missing) == (3, 0, {("r1", "joint_states"): 3})
    assert stats.refused == {"no stamp": 1, "stamp outside 1901 to 2038": 1, "malformed": 1, "foreign": 1}
    with RecordingReader(tmp_path / "run.mcap") as recording:
        assert [record.sequence for record in recording.records()] == [7, 8, 12, 15]
        assert recording.missing == {"r1/joint_states": 3}


def test_simulated_time_is_recorded_with_the_robots(sessions, tmp_path: Path):
    writer, reader = sessions
    with (
        Recorder(reader, tmp_path / "run.mcap", ["r1"]) as recorder,
        KeyPublisher(writer, "zstate/clock", encoding_of(ClockMessage)) as clock,
    ):
        until(lambda: clock.has_readers)
        clock.put(encode(ClockMessage(3_000_000_007, 0, 9)))
        until(lambda: count(recorder, "ros", "clock") == 1)
    (message,) = read(tmp_path / "run.mcap", "/clock")
    assert (message.clock.sec, message.clock.nanosec) == (3, 7)


def test_ros_messages_are_recorded_unchanged(sessions, tmp_path: Path):
    writer, reader = sessions
    with (
        Recorder(reader, tmp_path / "run.mcap", wire="ros2:domain=3") as recorder,
        StatePublisher(writer, RRBOT, "r1", wires=("ros2:domain=3",)) as publisher,
    ):
        until(lambda: count(recorder, "ros", "robot_description") == 1)
        until(lambda: count(recorder, "ros", "tf_static") == 1)
        positions = [0.5, 0.25]
        until(lambda: publisher.publish(positions) or count(recorder, "ros", "tf") > 3)
    assert recorder.failure is None
    assert (recorder.stats.missed, recorder.stats.refused) == (0, {})
    state = read(tmp_path / "run.mcap", "/joint_states")[-1]
    assert (state.name, state.position.tolist()) == (list(RRBOT.joint_names), positions)
    fixed = {joint.child for joint in RRBOT.joints if joint.type == "fixed"}
    (recorded,) = read(tmp_path / "run.mcap", "/tf_static")
    assert {edge.child_frame_id for edge in recorded.transforms} == fixed
    with RecordingReader(tmp_path / "run.mcap") as recording:
        programs = {channel.metadata["zstate.program"] for channel in recording.channels()}
    assert len(programs) == 1


def test_each_file_of_a_split_recording_is_readable_alone(sessions, tmp_path: Path):
    writer, reader = sessions
    path = tmp_path / "run.mcap"
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        Recorder(reader, path, max_bytes=1 << 16) as recorder,
    ):
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        sent = publish_paced(publisher, recorder, reader, 1000)
        files = recorder.stats.files
    assert len(files) > 2
    counts: Counter[str] = Counter()
    for file in files:
        with file.open("rb") as stream:
            topics = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
        assert {"/robot_description", "/tf_static"} <= set(topics[:2])
        counts.update(topics)
    assert counts["/joint_states"] == counts["/tf"] == len(sent)
    assert recorder.stats.files[-1] == tmp_path / f"run_{len(recorder.stats.files) - 1}.mcap"


RECORDER = """
    import sys, threading
    from zstate import connect
    from zstate.recording.recorder import Recorder
    with connect() as session, Recorder(session, sys.argv[1], ["r1"]) as recorder:
        print("ready")
        recorder.wait()
"""


def test_a_recorder_that_is_closed_at_once_writes_all_that_has_arrived(sessions, tmp_path: Path):
    number = 1000
    with StatePublisher(sessions[0], RRBOT) as publisher:
        with Recorder(sessions[0], tmp_path / "run.mcap", ["rrbot"]) as recorder:
            for step in range(number):
                publisher.publish([0.0, 0.0], stamp=STAMP + step * PERIOD)
        assert count(recorder, "rrbot") == number
    assert len(read(tmp_path / "run.mcap", "/joint_states")) == number


def test_killed_recorder_loses_at_most_the_last_half_second(sessions, spawn, tmp_path: Path):
    from zstate.recording.mcap.recover import recover

    writer = sessions[0]
    child = spawn(RECORDER, str(tmp_path / "run.mcap"))
    assert child.line() == "ready"
    sent: list[int] = []
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        began = time.monotonic()
        sine = iter(range(10**9))
        while time.monotonic() < began + 2.0:
            sent.append(time.time_ns())
            publisher.publish([0.0, 0.001 * next(sine)], stamp=sent[-1])
            until(lambda: time.time_ns() > sent[-1] + 3 * PERIOD)
        child.kill()
        killed = time.time_ns()
    report = recover(tmp_path / "run.mcap", tmp_path / "saved.mcap")
    saved = [stamp_of(state.header) for state in read(tmp_path / "saved.mcap", "/joint_states")]
    assert saved == sent[: len(saved)]
    # Half a second and what a busy machine adds. Each stream has a thread, so that one may be ahead.
    assert report.messages["/joint_states"] == len(saved)
    for topic in ("/joint_states", "/tf"):
        assert sum(stamp < killed - 1_000_000_000 for stamp in sent) <= report.messages[topic]
    assert read(tmp_path / "saved.mcap", "/robot_description")[0].data == RRBOT.urdf


ON_A_SMALL_DISK = """
    import resource, sys
    from zstate import connect
    from zstate.recording.recorder import Recorder
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
    with connect() as session, Recorder(session, sys.argv[1], ["r1"]) as recorder:
        print("ready")
        print(recorder.wait(15.0))
        print(type(recorder.failure).__name__, recorder.failure)
        print(sum(recorder.stats.messages.values()) - recorder.stats.lost, recorder.stats.lost)
        recorder.close()
    print("goes on")
"""


def test_full_disk_ends_the_recording_with_a_reason_and_what_it_has_lost_is_counted(
    sessions, spawn, tmp_path: Path
):
    writer = sessions[0]
    child = spawn(ON_A_SMALL_DISK, str(tmp_path / "run.mcap"))
    assert child.line() == "ready"
    with (
        StatePublisher(writer, GRIPPER, "r1") as publisher,
        KeyPublisher(writer, "zstate/r1/joint_states", "") as probe,
    ):
        until(lambda: probe.has_readers)
        dice = np.random.default_rng(3)
        count = len(GRIPPER.joint_names)
        until(lambda: publisher.publish(dice.uniform(0.0, 0.01, count)) or not probe.has_readers)
    assert child.line() == "True"
    failure = child.line()
    assert failure.startswith("RecordingError")
    assert "cannot grow" in failure
    written, lost = map(int, child.line().split())
    assert child.line() == "goes on"
    assert (child.wait(), child.stderr) == (0, "")
    with RecordingReader(tmp_path / "run.mcap") as recording:
        assert not recording.complete
        assert 0 < sum(1 for _ in recording.records()) == written
    assert lost > 0


def test_close_finishes_the_file_and_may_be_repeated(sessions, tmp_path: Path):
    writer, reader = sessions
    recorder = Recorder(reader, tmp_path / "run.mcap", ["r1"])
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_stream_readers(writer, "r1")
        publisher.publish([0.0, 0.0], stamp=STAMP)
        until(lambda: count(recorder, "r1") == 1)
        assert not recorder.wait(0.0)
        recorder.close()
        recorder.close()
        assert recorder.wait(0.0)
        with KeyPublisher(writer, "zstate/r1/joint_states", "") as probe:
            until(lambda: not probe.has_readers)
    assert recorder.failure is None
    with RecordingReader(tmp_path / "run.mcap") as recording:
        assert recording.complete


def test_received_samples_are_written_even_if_the_recording_ends_at_once(sessions, tmp_path: Path):
    writer, reader = sessions
    with (
        Recorder(reader, tmp_path / "run.mcap") as recorder,
        KeyPublisher(writer, "zstate/r1/joint_states", encoding_of(JointState)) as publisher,
    ):
        until(lambda: publisher.has_readers)
        with closing(SampleCollector(reader, "zstate/r1/joint_states")) as tap:
            for number in range(1, 20):
                put_state(publisher, number)
                tap.payloads(number)
    with RecordingReader(tmp_path / "run.mcap") as recording:
        sequences = [record.sequence for record in recording.records()]
    assert sequences == list(range(1, len(sequences) + 1))
    assert recorder.stats.messages == {("r1", "joint_states"): len(sequences)}


def test_recording_without_robots_is_a_complete_file(tmp_path: Path):
    with connect() as session, Recorder(session, tmp_path / "run.mcap") as recorder:
        assert recorder.stats.messages == {}
    with RecordingReader(tmp_path / "run.mcap") as recording:
        assert (recording.complete, recording.span) == (True, None)


def test_closed_session_leaves_a_complete_file(tmp_path: Path):
    session = connect()
    recorder = Recorder(session, tmp_path / "run.mcap")
    session.close()
    recorder.close()
    with RecordingReader(tmp_path / "run.mcap") as recording:
        assert recording.complete


def test_invalid_recorder_arguments_are_refused_and_create_no_file(sessions, tmp_path: Path):
    session, path = sessions[0], tmp_path / "run.mcap"
    with pytest.raises(InvalidInput, match="robot name 'a/b'"):
        Recorder(session, path, ["a/b"])
    with pytest.raises(InvalidInput, match="no wire 'dds'"):
        Recorder(session, path, wire="dds")
    with pytest.raises(InvalidInput, match="max_bytes"):
        Recorder(session, path, max_bytes=5)
    assert not path.exists()
    path.write_text("mine")
    with pytest.raises(RecordingError, match="exists"):
        Recorder(session, path)
    assert path.read_text() == "mine"
    with KeyPublisher(session, "zstate/r1/joint_states", "") as probe:
        until(lambda: not probe.has_readers)
    with Recorder(session, path, overwrite=True):
        pass
    assert path.read_bytes().startswith(b"\x89MCAP")


def test_large_latched_values_are_recorded_entirely_on_their_own_thread(
    sessions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As if all of it were large: sets of edges in their order, and samples that wait for the description."""
    monkeypatch.setattr("zstate.recording.recorder.LARGE_BYTES", 1)
    writer, reader = sessions
    with (
        Recorder(reader, tmp_path / "run.mcap", "r1") as recorder,
        StatePublisher(writer, RRBOT, "r1") as publisher,
        StaticPublisher(writer, "r1") as statics,
    ):
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        for number in range(20):
            publisher.publish([0.1, number / 100], stamp=STAMP + number * PERIOD)
            statics.set(Transform("tool", f"mark_{number}", (0.0, 0.0, 0.1), UPRIGHT))
            until(lambda: count(recorder, "r1", "tf_static") >= number + 2)  # noqa: B023  # called at once
        until(lambda: count(recorder, "r1") == 20)
    fixed = [
        [edge.child_frame_id for edge in message.transforms]
        for message in read(tmp_path / "run.mcap", "/tf_static")
    ]
    marks = [f"mark_{number}" for number in range(20)]
    assert [children for children in fixed if "mark_0" in children] == [marks[: n + 1] for n in range(20)]
    assert len(read(tmp_path / "run.mcap", "/joint_states")) == 20
    assert recorder.stats.dropped == recorder.stats.unwritten == 0


def test_transforms_of_each_writer_are_recorded_beside_joint_states(sessions, tmp_path: Path):
    writer, reader = sessions
    path = tmp_path / "run.mcap"
    with (
        StatePublisher(writer, RRBOT, "r1", streams=("joint_states", "robot_description")) as wheels,
        TransformPublisher(writer, "r1", "odometry") as odometry,
        TransformPublisher(writer, "r1", "tracker") as tracker,
        Recorder(reader, path, "r1") as recorder,
    ):
        wait_for_stream_readers(writer, "r1", "joint_states", "transforms/odometry", "transforms/tracker")
        for k in range(3):
            wheels.publish([0.0, 0.0], stamp=STAMP + k * PERIOD)
            base = Transform("odom", "world", (float(k), 0, 0), UPRIGHT)
            odometry.publish([base.with_covariance(np.diag([k + 1.0] * 6))], STAMP + k * PERIOD)
            tracker.publish([Transform("odom", "ball", (0, float(k), 0), UPRIGHT)], STAMP + k * PERIOD)
        until(lambda: count(recorder, "r1", "transforms") == 6 and count(recorder, "r1") == 3)
    messages = [message.transforms[0] for message in read(path, "/tf")]
    assert Counter((one.header.frame_id, one.child_frame_id) for one in messages) == {
        ("odom", "world"): 3,
        ("odom", "ball"): 3,
    }
    with Recording(path) as recording:
        buffer = recording.buffer()
        found = buffer.lookup("ball", "world", STAMP + PERIOD // 2)
        placed = buffer.lookup("odom", "world", STAMP + PERIOD)
        named = {channel.metadata.get("zstate.writer") for channel in recording.info.channels}
    # Half way between samples at x = 0 and 1 of one writer, and y = 0 and 1 of the other.
    assert found.translation == pytest.approx([0.5, -0.5, 0.0])
    assert {"odometry", "tracker"} <= named
    assert np.array_equal(placed.covariance, np.diag([2.0] * 6))
    assert len(read(path, "/pose_with_covariance/world")) == 3


def test_joint_states_of_each_driver_are_recorded_on_a_channel_of_its_own(sessions, tmp_path: Path):
    writer, reader = sessions
    path = tmp_path / "run.mcap"
    names = RRBOT.joint_names
    with (
        StatePublisher(writer, RRBOT, "r1", streams=("robot_description",)),
        PartialStatePublisher(writer, RRBOT, names[:1], "r1", writer="lower") as lower,
        PartialStatePublisher(writer, RRBOT, names[1:], "r1", writer="upper") as upper,
        Recorder(reader, path, "r1") as recorder,
    ):
        wait_for_stream_readers(
            writer, "r1", "partial_joint_states/lower", "partial_joint_states/upper", "robot_description"
        )
        for k in range(3):
            lower.publish([k + 0.25], [1.0], [2.0], STAMP + k * PERIOD)
            upper.publish([-k], stamp=STAMP + k * PERIOD)
        until(lambda: count(recorder, "r1", "partial_joint_states") == 6)
        until(lambda: count(recorder, "r1", "robot_description") == 1)
    for decoded in OTHERS:
        states = [message for topic, message in decoded(path) if topic == "/joint_states"]
        lower_states, upper_states = ([one for one in states if list(one.name) == [name]] for name in names)
        assert [list(one.position) for one in lower_states] == [[0.25], [1.25], [2.25]]
        assert [(list(one.velocity), list(one.effort)) for one in lower_states] == [([1.0], [2.0])] * 3
        assert [list(one.position) for one in upper_states] == [[0.0], [-1.0], [-2.0]]
    with Recording(path) as recording:
        channels = [one for one in recording.info.channels if one.topic == "/joint_states"]
        positions, _ = recording.buffer().joint_positions("r1", STAMP + PERIOD // 2)
    assert {one.metadata["zstate.writer"] for one in channels} == {"lower", "upper"}
    assert positions == pytest.approx([0.75, -0.5])


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_scans_and_maps_are_recorded_as_published(sessions, tmp_path: Path, wire: str):
    writer, reader = sessions
    hall = Grid([[0, 100, -1], [7, 0, 0]], 0.5, (1.0, 2.0, 0.5), "map", STAMP)
    sweeps = [np.array([k, 1.5, math.inf, math.nan, 0.25], np.float32) for k in range(5)]
    path = tmp_path / "run.mcap"
    with (
        MapPublisher(writer, "r1", hall, [wire], writer="floor"),
        ScanPublisher(writer, "r1", "front", [wire], **SCANNER) as scanner,
        ScanPublisher(writer, "r1", "rear", [wire], **SCANNER) as rear,
        Recorder(reader, path, ["r1"], wire=wire) as recorder,
    ):
        for sensor in ("front", "rear"):
            keys = {"native": f"zstate/r1/scan/{sensor}", "ros2": ROS_KEYS.key("r1", "scan", sensor)}
            wait_for_reader(writer, keys[wire])
        for k, ranges in enumerate(sweeps):
            scanner.publish(ranges, STAMP + k)
        rear.publish(sweeps[0], STAMP, intensities=sweeps[0])
        until(lambda: (count(recorder, "r1", "scan"), count(recorder, "r1", "map")) == (6, 1))
    assert recorder.stats.missed == 0
    assert not recorder.stats.refused
    for other in OTHERS:
        by_topic: dict[str, list[Any]] = {}
        for topic, message in other(path):
            by_topic.setdefault(topic, []).append(message)
        assert [stamp_of(one.header) for one in by_topic["/front"]] == [STAMP + k for k in range(5)]
        for message, ranges in zip(by_topic["/front"], sweeps, strict=True):
            assert np.array_equal(np.asarray(message.ranges, np.float32), ranges, equal_nan=True)
            assert message.time_increment == pytest.approx(1e-6)
        assert np.array_equal(by_topic["/rear"][0].intensities, sweeps[0], equal_nan=True)
        (floor,) = by_topic["/floor"]
        assert (floor.info.width, floor.info.height) == (3, 2)
        assert list(floor.data) == [0, 100, -1, 7, 0, 0]
    with Recording(path) as recording:
        (grid,) = recording.maps()
        front = list(recording.scans("r1", "front"))
        assert len(list(recording.scans())) == 6
    assert (grid.cells.tolist(), grid.resolution, grid.stamp) == (hall.cells.tolist(), 0.5, STAMP)
    assert [scan.ray_ns for scan in front] == [1000] * 5
    assert all(np.array_equal(one.ranges, r, equal_nan=True) for one, r in zip(front, sweeps, strict=True))


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_sensors_and_odometry_are_recorded_and_looked_up_as_live(sessions, tmp_path: Path, wire: str):
    writer, reader = sessions
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-3
    path, now = tmp_path / "run.mcap", time.time_ns()
    with (
        TransformListener(reader, "r1", wire=wire, follow="tf") as listener,
        ImuPublisher(writer, "r1", "imu", [wire], frame="chest") as imu,
        VelocityPublisher(writer, "r1", "flow", [wire]) as velocity,
        OdometryPublisher(writer, "r1", "odom", [wire]) as odometry,
        PosePublisher(writer, "r1", "mocap", [wire]) as mocap,
        FixPublisher(writer, "r1", "gps", [wire], frame="mast") as gps,
        PressurePublisher(writer, "r1", "bmp", [wire]) as barometer,
        MagneticFieldPublisher(writer, "r1", "mag", [wire], frame="mast") as mag,
        Recorder(reader, path, ["r1"], wire=wire) as recorder,
    ):
        for stream, name in zip(
            ODOMETRY_STREAMS, ("imu", "flow", "mocap", "gps", "mag", "bmp", "odom"), strict=True
        ):
            keys = {"native": f"zstate/r1/{stream}/{name}", "ros2": ROS_KEYS.key("r1", stream, name)}
            wait_for_reader(writer, keys[wire])
        for k in range(5):
            imu.publish([k, 0, 0], [0, 0, 9.81], now + k)
            velocity.publish([k, 1, 2], stamp=now + k, covariance=np.eye(3))
            pose = Transform("odom", "base", [k, 0, 0], UPRIGHT).with_covariance(covariance * (k + 1))
            odometry.publish(pose, [k, 0, 0], [0, 0, 1], now + k * PERIOD, twist_covariance=covariance)
            mocap.publish(pose, now + k)
            barometer.publish(101325.0 - k, now + k, variance=2.25)
            gps.publish(47.5, 8.0 + k, None, now + k, covariance=np.eye(3), covariance_type=1, status=1)
            mag.publish([k * 1e-6, 0, -4e-5], now + k)
        until(lambda: [count(recorder, "r1", one) for one in ODOMETRY_STREAMS] == [5] * 7)
        until(lambda: count(recorder, "r1", {"native": "transforms", "ros2": "tf"}[wire]) == 5)
        live = [
            listener.buffer.wait("odom", "base", at, DEADLINE_S) for at in (now + PERIOD // 2, now + PERIOD)
        ]
    assert (recorder.stats.missed, recorder.stats.refused) == (0, {})
    for other in OTHERS:
        by_topic: dict[str, list[Any]] = {}
        for topic, message in other(path):
            by_topic.setdefault(topic, []).append(message)
        assert [one.angular_velocity.x for one in by_topic["/imu"]] == list(range(5))
        assert [one.twist.twist.linear.x for one in by_topic["/flow"]] == list(range(5))
        assert [one.pose.pose.position.x for one in by_topic["/mocap"]] == list(range(5))
        assert [one.longitude for one in by_topic["/gps"]] == [8.0 + k for k in range(5)]
        assert [
            (bmp.fluid_pressure, mag.magnetic_field.x)
            for bmp, mag in zip(by_topic["/bmp"], by_topic["/mag"], strict=True)
        ] == [(101325.0 - k, k * 1e-6) for k in range(5)]
        assert {(one.status.status, one.position_covariance_type) for one in by_topic["/gps"]} == {(1, 1)}
        assert [one.pose.pose.position.x for one in by_topic["/odom"]] == list(range(5))
        assert [one.transforms[0].child_frame_id for one in by_topic["/tf"]] == ["base"] * 5
    with Recording(path) as recording:
        readings, velocities = list(recording.imu("r1", "imu")), list(recording.velocities())
        samples, poses = list(recording.odometry("r1", "odom")), list(recording.poses("r1", "mocap"))
        more = recording.fixes("r1", "gps"), recording.pressures("r1"), recording.magnetic_fields("r1")
        fixes, *others = (list(one) for one in more)
        buffer = recording.buffer()
        recorded = [buffer.lookup("odom", "base", at) for at in (now + PERIOD // 2, now + PERIOD)]
        streams = {one.stream for one in recorded_robots(recording.info)[0].streams}
    assert [(one.stamp, one.frame) for one in readings] == [(now + k, "r1/chest") for k in range(5)]
    assert [from_block(one.linear)[0] for one in velocities] == list(range(5))
    assert velocities[0].angular is None
    child = {"native": "r1/base", "ros2": ""}[wire]
    assert [(one.stamp, one.parent, one.child) for one in poses] == [
        (now + k, "r1/odom", child) for k in range(5)
    ]
    assert [covariance_matrix(one.covariance)[5, 5] for one in poses] == pytest.approx(
        [6e-3 * (k + 1) for k in range(5)]
    )
    assert from_block(velocities[0].covariance).tolist() == [1, 0, 0, 1, 0, 1]
    assert [from_block(one.twist).tolist() for one in samples] == [[k, 0, 0, 0, 0, 1] for k in range(5)]
    assert [(one.stamp, one.frame, one.longitude, one.altitude) for one in fixes] == [
        (now + k, "r1/mast", 8.0 + k, None) for k in range(5)
    ]
    assert [
        (bmp.frame, bmp.pressure, bmp.variance, mag.stamp, mag.frame, from_block(mag.field)[0])
        for bmp, mag in zip(*others, strict=True)
    ] == [("r1/bmp", 101325.0 - k, 2.25, now + k, "r1/mast", k * 1e-6) for k in range(5)]
    assert set(ODOMETRY_STREAMS) <= streams
    for there, here in zip(live, recorded, strict=True):
        assert (there.pose7 == here.pose7).all()
        assert (here.kind, np.array_equal(there.covariance, here.covariance)) == (there.kind, True)
    assert (recorded[1].covariance is None) == (wire == "ros2")  # /tf has none


def test_withdrawn_map_keeps_static_edges_of_its_name(sessions, tmp_path: Path):
    writer, reader = sessions
    grid = Grid([[0]], 1.0, (0.0, 0.0, 0.0))
    with (
        StaticPublisher(writer, "r1", "floor") as statics,
        Recorder(reader, tmp_path / "run.mcap", ["r1"]) as recorder,
    ):
        statics.set(Transform("tool", "hook", (0.0, 0.0, 0.25), UPRIGHT))
        with MapPublisher(writer, "r1", grid, writer="floor"):
            until(lambda: count(recorder, "r1", "map") == count(recorder, "r1", "tf_static") == 1)
        until(lambda: count(recorder, "r1", "map") == 2)
    sizes = [message.info.width for message in read(tmp_path / "run.mcap", "/floor")]
    edges = [len(message.transforms) for message in read(tmp_path / "run.mcap", "/tf_static")]
    assert (sizes, edges) == ([1, 0], [1])


def test_commands_are_recorded_as_joint_states_and_not_replayed(sessions, tmp_path):
    path, teleop = tmp_path / "run.mcap", local_writer(9, "teleop")
    renewal = JointCommand(STAMP, 0, 9, order_digest(()), names=(), motion=0)
    setpoint = JointCommand(
        STAMP, 1, 9, order_digest(("elbow",)), to_block([0.25]), names=("elbow",), ttl=50_000_000
    )
    with (
        StatePublisher(sessions[0], RRBOT, "arm") as publisher,
        Recorder(sessions[1], path, ["arm"]) as recorder,
        announce(sessions[0], WRITER_TOKEN.key("arm", "joint_commands", teleop.identity)),
        KeyPublisher(sessions[0], "zstate/arm/joint_commands", encoding_of(JointCommand)) as commands,
    ):
        wait_for_stream_readers(sessions[0], "arm", "joint_states", "joint_commands")
        until(lambda: teleop.session in recorder._programs)
        publisher.publish([0.0, 0.0])
        for command in (renewal, setpoint):
            commands.put(encode(command))
        until(lambda: recorder.stats.messages.get(("arm", "joint_commands")))
        until(lambda: recorder.stats.messages.get(("arm", "joint_states")))
        assert recorder.stats.refused == {}
    (command,) = read(path, "/joint_commands")
    assert (command.name, command.position.tolist()) == (["elbow"], [0.25])
    assert command.header.frame_id == "ttl_ns=50000000"
    with Recording(path) as recording:
        (same,) = recording.commands("arm")
    assert (same.stamp, same.ttl) == (stamp_of(command.header), 50_000_000)
    assert (same.names, from_block(same.positions or b"").tolist()) == (("elbow",), [0.25])
    (robot,) = recorded_robots(read_info(path))
    (stream,) = [one for one in robot.streams if one.stream == "joint_commands"]
    assert (stream.count, stream.writer.partition("@")[0]) == (1, "teleop")
    with (
        closing(SampleCollector(sessions[1], "zstate/arm/joint_commands")) as commands,
        closing(SampleCollector(sessions[1], "zstate/arm/joint_states")) as states,
        Player(sessions[0], path, rate=math.inf) as player,
    ):
        wait_for_stream_readers(sessions[0], "arm", "joint_states", "joint_commands")
        player.run()
        states.joint_states(1)
        assert commands.arrivals == []


def test_stops_with_and_without_torque_are_recorded_and_their_numbers_have_no_gaps(sessions, tmp_path):
    path, writer = tmp_path / "run.mcap", local_writer(9)
    with Recorder(sessions[1], path, ["arm"]) as recorder, ExitStack() as opened:
        hows: tuple[tuple[str, StopMode], ...] = (("stop", "hold"), ("relax", "relax"))
        for stream, how in hows:
            key = f"zstate/arm/{stream}/{writer.identity}"
            latched = opened.enter_context(LatchedPublisher(sessions[0], key, encoding_of(Stop)))
            wait_for_reader(sessions[0], key)
            for seq in (5, 2**40):
                latched.set(encode(Stop(STAMP, seq, writer.session, how, "")))
        until(lambda: count(recorder, "arm", "stop") == 4)
        assert recorder.stats.missed == 0
    with Recording(path) as recording:
        found = {(program, stop.how, stop.seq) for program, stop in recording.stops("arm")}
    assert found == {(str(writer), how, seq) for how in ("hold", "relax") for seq in (5, 2**40)}


def test_states_motions_and_stops_of_a_driver_are_recorded_and_not_replayed(sessions, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    path = tmp_path / "run.mcap"
    driver = SimulatedDriver(RRBOT, "mirror")
    with (
        Recorder(sessions[1], path, ["arm"]) as recorder,
        DriverHost(sessions[0], driver, RRBOT, "arm", limits=Limits.of(RRBOT, velocity=2.0)) as host,
        Commander(sessions[1], "arm", program="teleop") as arm,
    ):
        loop = threading.Thread(target=host.run)
        loop.start()
        arm.wait_for_driver(DEADLINE_S)
        until(lambda: count(recorder, "arm", "joint_states"))  # the driver knows its joints
        assert arm.move({"elbow": [0.05]}, [0.2], stretch=True).wait(DEADLINE_S).name == "reached"
        stop(sessions[1], "arm", "door open", timeout_s=DEADLINE_S)
        until(lambda: count(recorder, "arm", "stop"))
        assert arm.release(DEADLINE_S).state == "ready"
        host.close()
        loop.join()
        until(lambda: count(recorder, "arm", "joint_states"))
        assert (recorder.stats.refused, recorder.stats.missed) == ({}, 0)
    with Recording(path) as recording:
        states, stops = list(recording.driver_states("arm")), list(recording.stops())
    (program, one), by_state = stops[0], {state.state: state for state in states}
    assert (one.how, one.reason, program) == ("hold", "door open", str(local_writer(0)))
    assert set(by_state) >= {"ready", "active", "stopped", "off"}
    assert by_state["stopped"].stops == ((one.session, one.seq),)
    assert by_state["stopped"].reason == f"stopped by {program}: door open"
    assert [(outcome.name, outcome.reason) for outcome in states[-1].outcomes] == [("reached", "")]
    assert any(state.motion is not None and 0.0 < state.progress <= 1.0 for state in states)
    for other in OTHERS:
        shown = [message.status[0] for topic, message in other(path) if topic == "/diagnostics"]
        assert len(shown) == len(states)
        assert {(status.name, status.hardware_id) for status in shown} == {("arm: driver", "arm")}
        warning = next(status for status in shown if bytes([status.level]) == b"\x01")
        assert warning.message == by_state["stopped"].reason
        assert {value.key: value.value for value in warning.values}["joint_names"] == '["shoulder", "elbow"]'
    (robot,) = recorded_robots(read_info(path))
    writers = {stream.stream: stream.writer for stream in robot.streams}
    assert (writers["driver"], writers["stop"]) == (states[0].program, program)
    with (
        closing(SampleCollector(sessions[1], "zstate/arm/*")) as seen,
        closing(SampleCollector(sessions[1], "zstate/arm/stop/*")) as stopped,
        Player(sessions[0], path, rate=math.inf) as player,
    ):
        wait_for_stream_readers(sessions[0], "arm", "joint_states")
        player.run()
        until(lambda: any(arrival.key.endswith("joint_states") for arrival in list(seen.arrivals)))
        assert stopped.arrivals == []
        assert {arrival.key.rpartition("/")[2] for arrival in seen.arrivals}.isdisjoint(
            {"driver", "joint_commands"}
        )
