"""A buffer made of a recording answers as a listener's did: the same ingest, the same messages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.recording_builder import (
    LATENCY,
    MS,
    RRBOT,
    START,
    Bag,
    RecordingBuilder,
    S,
    pose,
    recorded_buffer,
    swing_positions,
    swing_velocities,
)
from rosbags.rosbag2 import StoragePlugin

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import Disconnected, InvalidInput, UnknownFrame
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_states import JointStateIngest
from zstate.model.kinematics import Kinematics
from zstate.recording.errors import RecordingError
from zstate.transform import Transform
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import RobotDescription

IDENTITY = pose()


def live_buffer() -> tuple[TransformBuffer, JointStateIngest]:
    """The buffer of a listener that knows the model of "arm", and its ingest."""
    live = TransformBuffer()
    ingest = JointStateIngest("arm", FrameOwnership(live, Counters()))
    ingest.describe(RobotDescription(1, RRBOT.urdf, RRBOT.digest, RRBOT.joint_names, ()))
    return live, ingest


def test_lookups_are_bit_identical_to_a_live_buffer(tmp_path: Path):
    live, ingest = live_buffer()
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(1500):
            seconds = n / 100
            state = builder.joints(
                "arm", START + n * 10 * MS + n % 7, swing_positions(seconds), swing_velocities(seconds)
            )
            ingest.insert_sample(state, overflowed=False)
    recorded = recorded_buffer(tmp_path / "r.mcap")
    newest = live.latest("world", "tool")
    stamps = np.random.default_rng(3).integers(newest - 10 * S, newest, 500)
    expected, valid = live.lookup_many("world", "tool", stamps)
    assert valid.sum() > 490
    assert np.array_equal(recorded.lookup_many("world", "tool", stamps)[0][valid], expected[valid])
    assert recorded.latest("world", "tool") == newest
    twist = recorded.twist("tool", "world", newest - S)
    assert np.array_equal(twist.linear, live.twist("tool", "world", newest - S).linear)


def test_long_recording_is_kept_entirely(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(200):
            builder.joints("arm", START + n * 60 * S, swing_positions(n))
    buffer = recorded_buffer(tmp_path / "r.mcap")
    first = buffer.lookup("world", "tool", START)
    (tool,) = (n for n, link in enumerate(RRBOT.links) if link == "tool")
    assert np.allclose(
        first.pose7, Kinematics(RRBOT).link_poses(swing_positions(0))[tool], rtol=0, atol=1e-12
    )
    assert buffer.can_lookup("world", "tool", START + 199 * 60 * S)


def test_samples_recorded_before_their_description_are_not_lost(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        for n in range(3000):
            bag.joints(START - S + n, dict(zip(RRBOT.joint_names, swing_positions(n), strict=True)))
        bag.describe()
    buffer = recorded_buffer(tmp_path / "bag")
    assert buffer.can_lookup("world", "tool", START - S)


def test_restarted_writer_continues_the_same_history(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(10):
            builder.joints("arm", START + n * S, swing_positions(n), session=1 + n // 5)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.can_lookup("world", "tool", START)
    assert buffer.can_lookup("world", "tool", START + 9 * S)


def test_new_writer_with_an_earlier_clock_starts_a_new_history(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(10):
            builder.joints("arm", 5 * S + n * MS, swing_positions(n), session=1, log_time=START + n)
        for n in range(10):
            builder.joints("arm", 3 * S + n * MS, swing_positions(n), session=2, log_time=START + S + n)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.latest("world", "tool") == 3 * S + 9 * MS
    assert not buffer.can_lookup("world", "tool", 5 * S)


def test_second_sample_of_a_clock_set_back_starts_a_new_history_as_live(tmp_path: Path):
    live, ingest = live_buffer()
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for number, stamp in enumerate([100 * S, 101 * S, 5 * S, 6 * S, 7 * S]):
            state = builder.joints("arm", stamp, swing_positions(number), log_time=START + number)
            ingest.insert_sample(state, overflowed=False)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    for known in (live, buffer):
        assert [known.can_lookup("world", "tool", s * S) for s in (5, 6, 7, 100)] == [
            False,
            True,
            True,
            False,
        ]


def test_single_old_sample_changes_nothing(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for number, stamp in enumerate([100 * S, 101 * S, 5 * S, 102 * S, 6 * S, 103 * S]):
            builder.joints("arm", stamp, swing_positions(number), log_time=START + number)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.can_lookup("world", "tool", 100 * S)
    assert not buffer.can_lookup("world", "tool", 50 * S)


def test_late_sample_is_sorted_in(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for number, second in enumerate([0, 2, 1, 3]):
            builder.joints("arm", START + second * S, swing_positions(second), log_time=START + number * S)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.lookup("world", "tool", START + S).kind == "exact"


def test_edges_outside_the_model_come_from_tf(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(10):
            stamp = START + n * 10 * MS
            builder.joints("arm", stamp, swing_positions(n))
            builder.edges("arm", stamp, {("odom", "world"): pose(n), ("base", "upper"): IDENTITY})
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.lookup("odom", "world", START + 45 * MS).translation[0] == 4.5
    # The model defines its links; transforms on tf do not override it.
    kinds = {frame.name: frame.kind for frame in buffer.frames()}
    assert (kinds["arm/upper"], kinds["arm/world"]) == ("joint", "pose")


def test_robot_without_a_description_comes_from_tf(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "cart") as builder:
        for n in range(10):
            builder.edges(
                "cart", START + n * 10 * MS, {("odom", "base"): pose(n), ("base", "mast"): pose(z=n)}
            )
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.lookup("odom", "mast", START + 30 * MS).translation.tolist() == [3.0, 0.0, 3.0]


def test_partial_joint_states_leave_the_robot_to_its_tf(tmp_path: Path, caplog):
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        for n in range(5):
            bag.joints(START + n, {"shoulder": 0.1})
            bag.tf(START + n, [Transform("base", "upper", [0, 0, n], [0, 0, 0, 1], START + n)])
    buffer = recorded_buffer(tmp_path / "bag")
    assert buffer.lookup("base", "upper", START + 3).translation[2] == 3.0
    assert "no robot_description fits" in caplog.text


def test_edges_of_a_clock_set_back_restart_and_others_stay(tmp_path: Path):
    with Bag(tmp_path / "bag", StoragePlugin.MCAP) as bag:
        for n, second in enumerate([100, 101, 102, 5, 6, 7]):
            bag.tf(START + n, [Transform("odom", "base", [second, 0, 0], [0, 0, 0, 1], second * S)])
            bag.tf(START + n, [Transform("map", "odom", [n, 0, 0], [0, 0, 0, 1], (200 + n) * S)])
    buffer = recorded_buffer(tmp_path / "bag")
    assert buffer.latest("odom", "base") == 7 * S
    assert not buffer.can_lookup("odom", "base", 100 * S)
    assert buffer.can_lookup("map", "odom", 200 * S)


def test_new_writer_of_an_edge_continues_its_history(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "cart") as builder:
        for n in range(10):
            edges = {("odom", "base"): pose(n)}
            builder.edges("cart", START + n * 10 * MS, edges, session=10 + n // 5)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.can_lookup("odom", "base", START)
    assert buffer.can_lookup("odom", "base", START + 90 * MS)


def test_static_edges_of_all_writers_are_loaded(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.statics("arm", START, {("tool", "camera"): pose(z=0.1)}, writer="camera")
        builder.statics("arm", START, {("tool", "gripper"): pose(z=0.2)}, writer="gripper", session=4)
        builder.statics("arm", START, {("world", "base"): IDENTITY}, writer=MODEL_WRITER, session=1)
        builder.joints("arm", START, swing_positions(0))
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert np.allclose(buffer.lookup("camera", "gripper").translation, [0, 0, 0.1])


def test_withdrawn_edges_stay_until_the_frame_is_placed_again(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.statics("arm", START, {("table", "cup"): pose(x=1.0), ("table", "plate"): pose(x=2.0)})
        builder.encoder.withdraw("arm", "tf_static", "camera", START + S)
        builder.statics("arm", START + 2 * S, {("tray", "cup"): pose(x=3.0)}, writer="other", session=9)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.lookup("table", "plate").translation[0] == 2.0
    assert buffer.lookup("tray", "cup").translation[0] == 3.0
    with pytest.raises(Disconnected):
        buffer.lookup("table", "cup")


def test_repeated_static_value_does_not_return(tmp_path: Path):
    # Latched values are written again every ten seconds, for those who read from the middle.
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.statics("arm", START, {("table", "cup"): pose(x=1.0)})
        for second in range(1, 30):
            builder.edges("arm", START + second * S, {("table", "cup"): pose(x=second)})
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.lookup("table", "cup", START + 15 * S).translation[0] == 15.0


def test_static_edges_of_a_bag_add_up(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        for n, child in enumerate(("lidar", "camera", "lidar")):
            bag.tf(START + n, [Transform("base", child, [n, 0, 0], [0, 0, 0, 1], 0)], "/tf_static")
    buffer = recorded_buffer(tmp_path / "bag")
    assert buffer.lookup("base", "lidar").translation[0] == 2.0
    assert buffer.lookup("base", "camera").translation[0] == 1.0


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_whole_robot_of_a_bag_is_loaded(tmp_path: Path, storage: StoragePlugin):
    kinematics = Kinematics(RRBOT)
    tool = RRBOT.links.index("tool")
    with Bag(tmp_path / "bag", storage) as bag:
        bag.describe()
        bag.tf(START, [Transform("world", "base", [0, 0, 0], [0, 0, 0, 1], 0)], "/tf_static")
        bag.tf(START, [Transform("tool", "camera", [0, 0, 0.5], [0, 0, 0, 1], 0)], "/tf_static")
        for n in range(50):
            stamp = START + n * 20 * MS
            # A ROS driver may name its joints in any order.
            bag.joints(
                stamp, dict(reversed(list(zip(RRBOT.joint_names, swing_positions(n / 50), strict=True))))
            )
            bag.tf(
                stamp + LATENCY, [Transform("map", "world", [n * 0.02, 0, 0], [0, 0, 0, 1], stamp + LATENCY)]
            )
    buffer = recorded_buffer(tmp_path / "bag")
    found = buffer.lookup("world", "tool", START + 20 * 20 * MS)
    expected = kinematics.link_poses(swing_positions(20 / 50))[tool]
    assert np.allclose(found.pose7, expected, rtol=0, atol=1e-12)
    assert found.kind == "exact"
    assert np.isclose(buffer.lookup("map", "world", START + LATENCY + 210 * MS).translation[0], 0.21)
    assert np.allclose(buffer.lookup("tool", "camera").translation, [0, 0, 0.5])


def test_robot_is_selected_by_name(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        for robot in ("r1", "r2"):
            builder.describe(robot)
            builder.joints(robot, START, swing_positions(0))
    both = recorded_buffer(tmp_path / "r.mcap")
    one = recorded_buffer(tmp_path / "r.mcap", "r2")
    assert both.can_lookup("r1/world", "r1/tool", START)
    assert one.can_lookup("world", "tool", START)
    with pytest.raises(UnknownFrame):
        one.lookup("r1/world", "r1/tool")


def test_unknown_robot_error_lists_the_recorded_ones(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("arm")
    with pytest.raises(InvalidInput, match="no robot 'leg'; its robots: 'arm'"):
        recorded_buffer(tmp_path / "r.mcap", "leg")


def test_file_that_is_not_a_recording_is_refused(tmp_path: Path):
    (tmp_path / "x.mcap").write_text("hello")
    with pytest.raises(RecordingError, match="not a recording"):
        recorded_buffer(tmp_path / "x.mcap")


def test_clock_set_back_by_less_than_ten_seconds_starts_a_new_history(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for number, second in enumerate([10, 11, 12, 6, 7]):
            builder.joints("arm", START + second * S, swing_positions(number), log_time=START + number * S)
            builder.edges(
                "cart", START + second * S, {("floor", "cart"): pose(number)}, log_time=START + number * S
            )
    buffer = recorded_buffer(tmp_path / "r.mcap")
    for frames in (("world", "tool"), ("floor", "cart")):
        assert buffer.latest(*frames) == START + 7 * S
        assert not buffer.can_lookup(*frames, START + 11 * S)
