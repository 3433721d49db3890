"""Recordings of several drivers of one robot: rrbot's shoulder and elbow come from two programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.recording_builder import MS, START, Bag, RecordingBuilder, S, recorded_buffer
from helpers.robots import RRBOT, assert_pose, kinematic_pose
from rosbags.rosbag2 import StoragePlugin

from zstate.errors import InPast, NoData
from zstate.model.urdf import parse_urdf
from zstate.recording.recording import Recording

SHOULDER, ELBOW = RRBOT.joint_names
TOOL = RRBOT.links[-1]
CHAIN = "".join(
    f"""<joint name="{name}" type="continuous"> <parent link="l{n}"/> <child link="l{n + 1}"/>
    <axis xyz="0 0 1"/> </joint> <link name="l{n + 1}"/>"""
    for n, name in enumerate("abc")
)
CHAIN = f'<robot name="chain"> <link name="l0"/> {CHAIN} </robot>'


def test_each_joint_is_interpolated_between_the_samples_of_its_own_driver(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.part("arm", START, {SHOULDER: 0.0}, "lower", session=4)
        builder.part("arm", START + 20 * MS, {ELBOW: 2.0}, "upper", session=5)
        builder.part("arm", START + 60 * MS, {ELBOW: 0.0}, "upper", session=5)
        builder.part("arm", START + 100 * MS, {SHOULDER: 1.0}, "lower", session=4)
    at = START + 30 * MS
    # The shoulder is 30 ms into 100 ms, the elbow 10 ms into 40 ms.
    expected = [0.3, 1.5]
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
        poses, valid = recording.lookup_many("world", TOOL, [at, START + 10 * MS])
    assert buffer.joint_positions("arm", at)[0] == pytest.approx(expected)
    assert_pose(buffer.lookup("world", TOOL, at), kinematic_pose(RRBOT, expected, "world", TOOL))
    assert np.array_equal(poses[0], buffer.lookup("world", TOOL, at).pose7)
    assert valid.tolist() == [True, False]


def test_rows_of_joint_states_are_the_instants_that_all_drivers_cover(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.part("arm", START, {SHOULDER: 0.0}, "lower", session=4, velocities=[10.0])
        builder.part("arm", START + 50 * MS, {ELBOW: 2.0}, "upper", session=5)
        builder.part("arm", START + 100 * MS, {SHOULDER: 1.0}, "lower", session=4, velocities=[20.0])
        builder.part("arm", START + 150 * MS, {ELBOW: 4.0}, "upper", session=5)
    with Recording(tmp_path / "r.mcap") as recording:
        states = recording.joint_states()
        reader = recording.joint_state_reader("arm")
    assert reader.count == 4
    assert states.stamps.tolist() == [START + 50 * MS, START + 100 * MS]
    assert states.positions == pytest.approx(np.array([[0.5, 2.0], [1.0, 3.0]]))
    assert states.velocities is not None
    assert np.array_equal(states.velocities, [[np.nan, np.nan], [20.0, np.nan]], equal_nan=True)


def test_restarted_driver_continues_its_history_under_another_name(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm", {4: "a.py@h pid 1", 6: "a.py@h pid 2"}) as builder:
        builder.describe("arm")
        for n in range(10):
            name, session = ("a.py-1", 4) if n < 5 else ("a.py-2", 6)
            builder.part("arm", START + n * 10 * MS, {SHOULDER: float(n)}, name, session=session)
            builder.part("arm", START + n * 10 * MS, {ELBOW: -float(n)}, "upper", session=5)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    # Half way between the last sample of the first start and the first one of the second.
    assert buffer.joint_positions("arm", START + 45 * MS)[0] == pytest.approx([4.5, -4.5])
    movers = {frame.writer for frame in buffer.frames() if frame.kind == "joint"}
    assert movers == {"a.py@h pid 2", "upper"}


def test_restarted_driver_with_an_earlier_clock_drops_its_own_history_only(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(10):
            at = START + n * 10 * MS
            builder.part("arm", at, {SHOULDER: 1.0}, "lower", session=4)
            builder.part("arm", at, {ELBOW: 2.0}, "upper", session=5)
        builder.part("arm", START + 50 * MS, {SHOULDER: 3.0}, "lower", session=6, log_time=START + S)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    assert buffer.joint_positions("arm", START + 50 * MS)[0].tolist() == [3.0, 2.0]
    upper_arm, forearm = (joint.child for joint in RRBOT.driven_joints)
    with pytest.raises(InPast):
        buffer.lookup("world", upper_arm, START)
    assert buffer.can_lookup(upper_arm, forearm, START)


@pytest.mark.parametrize("later", ["both", "elbow"])
def test_of_two_writers_of_a_joint_the_one_that_appears_later_counts(tmp_path: Path, later: str):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")

        def all_joints(n: int) -> None:
            builder.joints("arm", START + n * 10 * MS, [1.0, 1.0], session=9)

        def elbow(n: int) -> None:
            builder.part("arm", START + n * 10 * MS, {ELBOW: 2.0}, "upper", session=3)

        for n in range(3):
            for write in (elbow, all_joints) if later == "both" else (all_joints, elbow):
                write(n)
    positions, _ = recorded_buffer(tmp_path / "r.mcap").joint_positions("arm", START + 10 * MS)
    assert positions.tolist() == ([1.0, 1.0] if later == "both" else [1.0, 2.0])


def test_replaced_driver_keeps_its_samples_of_other_joints(tmp_path: Path):
    arm = parse_urdf(CHAIN, "a chain")
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm", arm)
        for n in range(10):
            at = START + n * 10 * MS
            builder.part("arm", at, {"a": 1.0, "b": 2.0}, "both", session=4)
            if n >= 5:
                builder.part("arm", at, {"b": 3.0, "c": 4.0}, "later", session=5)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    movers = {frame.name: (frame.writer, frame.newest) for frame in buffer.frames() if frame.kind == "joint"}
    last = START + 90 * MS
    # "both" would be half a driver from the first sample of "later" on.
    assert movers == {
        "arm/l1": ("both", START + 50 * MS),
        "arm/l2": ("later", last),
        "arm/l3": ("later", last),
    }


def test_missing_driver_leaves_exactly_its_own_links_without_data(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.part("arm", START, {ELBOW: 0.5}, "upper", session=5)
    buffer = recorded_buffer(tmp_path / "r.mcap")
    upper_arm, forearm = (joint.child for joint in RRBOT.driven_joints)
    assert buffer.can_lookup(upper_arm, forearm, START)
    with pytest.raises(NoData):
        buffer.lookup("world", upper_arm, START)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_nodes_of_a_bag_are_told_apart_by_their_joints(tmp_path: Path, storage: StoragePlugin):
    with Bag(tmp_path / "bag", storage) as bag:
        bag.describe()
        for n in range(100):
            at = START + n * 10 * MS
            bag.joints(at, {SHOULDER: n / 100, "finger_of_another_robot": 7.0})
            if n % 10 == 0:  # its clock is 2 s behind, which is no step back of the other one's
                for k in range(2):
                    stamp = at - 2 * S + k * MS
                    bag.joints(stamp, {ELBOW: (stamp - START) / S}, log_time=at + (k + 1) * MS)
        for n in range(10):
            at = START - 2 * S + (101 + n) * 10 * MS
            bag.joints(at, {ELBOW: (at - START) / S}, log_time=START + S + n * MS)
    buffer = recorded_buffer(tmp_path / "bag")
    upper_arm, forearm = (joint.child for joint in RRBOT.driven_joints)
    # Each driver's own clock: positions are linear in time.
    assert_pose(
        buffer.lookup("world", upper_arm, START + 505 * MS),
        kinematic_pose(RRBOT, [0.505, 0.0], "world", upper_arm),
    )
    assert_pose(
        buffer.lookup(upper_arm, forearm, START - 1505 * MS),
        kinematic_pose(RRBOT, [0.0, -1.505], upper_arm, forearm),
    )


def test_all_joints_of_a_topic_count_before_some_of_them(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.describe()
        for n in range(4):
            bag.joints(START + n * 10 * MS, {SHOULDER: 1.0, ELBOW: 2.0})
            bag.joints(START + n * 10 * MS, {ELBOW: 3.0})
    positions, _ = recorded_buffer(tmp_path / "bag").joint_positions("ros", START + 15 * MS)
    assert positions.tolist() == [1.0, 2.0]
    with Recording(tmp_path / "bag") as recording:
        assert recording.joint_states().positions.tolist() == [[1.0, 2.0]] * 4
