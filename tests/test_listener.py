"""Following robots over real sessions on loopback."""

from __future__ import annotations

import logging
import time

import numpy as np
import pytest
from live import RRBOT, assert_pose, await_reader, kinematic_pose
from support import Child, until

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import ManualClock
from zstate.errors import AmbiguousFrame, InFuture, InvalidInput
from zstate.listener import TransformListener
from zstate.model.catalog import load_model
from zstate.net.latched import LatchedPublisher
from zstate.net.session import Session, connect
from zstate.net.streams import StreamPublisher
from zstate.publisher import StatePublisher
from zstate.sources import SineSource
from zstate.statics import StaticPublisher
from zstate.transform import Transform
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    to_block,
)
from zstate.wire.native import ENCODINGS, encode

STAMP = 1_789_012_345_678_901_234
PERIOD = 10_000_000
GRIPPER = load_model("gripper")
LONGER = load_model(RRBOT.urdf.replace('xyz="0 0 0.6"', 'xyz="0 0 0.9"'))
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def sessions():
    with connect() as writer, connect() as reader:
        yield writer, reader


def settle(session: Session, robot: str, *streams: str) -> None:
    for stream in streams or ("joint_states",):
        await_reader(session, f"zstate/{robot}/{stream}")


def received(listener: TransformListener, count: int) -> bool:
    until(lambda: listener.stats.received >= count)
    return listener.stats.received == count


@pytest.mark.parametrize("model", [RRBOT, load_model("diffbot"), GRIPPER], ids=lambda model: model.name)
def test_both_ways_of_following_agree_with_kinematics_at_every_stamp(sessions, model):
    writer, reader = sessions
    sine = SineSource(model)
    stamps = [STAMP + number * PERIOD for number in range(20)]
    with (
        StatePublisher(writer, model, "r1") as publisher,
        TransformListener(reader, "r1") as joints,
        TransformListener(reader, "r1", follow="tf") as transforms,
    ):
        settle(writer, "r1", "joint_states", "tf")
        for stamp in stamps:
            publisher.publish(sine.read(stamp).positions, stamp=stamp)
        for listener in (joints, transforms):
            for link in model.links:
                listener.buffer.wait(model.root, link, timeout_s=5.0)
            until(lambda listener=listener: listener.stats.received == 20)
    for stamp in stamps:
        for link in model.links:
            expected = kinematic_pose(model, sine.read(stamp).positions, model.root, link)
            for listener in (joints, transforms):
                assert_pose(listener.buffer.lookup(model.root, link, stamp), expected)
    assert joints.stats == transforms.stats
    assert (joints.stats.missed, joints.stats.late, joints.stats.refused) == (0, 0, {})


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_who_joins_late_has_the_model_and_all_statics_before_any_sample(sessions, follow):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1"), StaticPublisher(writer, "r1", "mount") as statics:
        statics.set(Transform("tool", "hook", (0.0, 0.0, 0.25), UPRIGHT))
        with TransformListener(reader, "r1", follow=follow) as listener:
            camera = listener.buffer.wait("hook", "camera_link", timeout_s=5.0)
            expected = kinematic_pose(RRBOT, [0.0, 0.0], "tool", "camera_link")
            expected[2, 3] -= 0.25
            assert_pose(camera, expected)
            until(lambda: listener.robots() == ("r1",))
            assert listener.stats.received == 0


def test_frames_answer_to_their_bare_and_their_full_names(sessions):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as publisher, TransformListener(reader, "r1") as listener:
        settle(writer, "r1")
        publisher.publish([0.5, 0.25], stamp=STAMP)
        bare = listener.buffer.wait("world", "tool", timeout_s=5.0)
        for target, source in (("r1/world", "r1/tool"), ("world", "r1/tool")):
            assert_pose(listener.buffer.lookup(target, source), bare.matrix)
        assert {frame.name for frame in listener.buffer.frames()} == {f"r1/{link}" for link in RRBOT.links}


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_of_two_robots_of_one_model_bare_names_are_ambiguous_and_full_ones_exact(sessions, follow):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as first,
        StatePublisher(writer, RRBOT, "r2") as second,
        TransformListener(reader, follow=follow) as listener,
    ):
        settle(writer, "r1", follow)
        settle(writer, "r2", follow)
        first.publish([0.5, 0.25], stamp=STAMP)
        second.publish([-1.0, 2.0], stamp=STAMP + 1)
        for robot, positions in (("r1", [0.5, 0.25]), ("r2", [-1.0, 2.0])):
            pose = listener.buffer.wait(f"{robot}/world", f"{robot}/tool", timeout_s=5.0)
            assert_pose(pose, kinematic_pose(RRBOT, positions, "world", "tool"))
        with pytest.raises(AmbiguousFrame) as caught:
            listener.buffer.lookup("world", "tool")
        assert set(caught.value.candidates) == {"r1/world", "r2/world"}
        assert listener.robots() == ("r1", "r2")


def test_a_listener_of_one_robot_hears_nothing_of_another(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as mine,
        StatePublisher(writer, RRBOT, "r2") as other,
        TransformListener(reader, "r1") as listener,
    ):
        settle(writer, "r1")
        other.publish([0.0, 0.0])
        mine.publish([0.0, 0.0])
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert listener.robots() == ("r1",)
        assert all(frame.name.startswith("r1/") for frame in listener.buffer.frames())


def test_two_listeners_fill_one_buffer_that_was_handed_in(sessions):
    writer, reader = sessions
    buffer = TransformBuffer(history_s=3.0, clock=ManualClock(5))
    buffer.insert_static(Transform("hall", "r1/world", (1.0, 0.0, 0.0), UPRIGHT))
    buffer.insert_static(Transform("hall", "r2/mount", (0.0, 2.0, 0.0), UPRIGHT))
    with (
        StatePublisher(writer, RRBOT, "r1"),
        StatePublisher(writer, GRIPPER, "r2"),
        TransformListener(reader, "r1", buffer) as one,
        TransformListener(reader, "r2", buffer, follow="tf") as other,
    ):
        assert one.buffer is other.buffer is buffer
        palm_from_base = buffer.wait("base", "palm", timeout_s=5.0)
        # mount_to_palm is 0.01 above; base is at world.
        assert np.allclose(palm_from_base.translation, [-1.0, 2.0, 0.01], rtol=0, atol=1e-12)


def test_history_and_clock_are_those_of_the_listeners_own_buffer(sessions):
    clock = ManualClock(5)
    with TransformListener(sessions[1], "r1", history_s=2.5, clock=clock) as listener:
        assert (listener.buffer.history_s, listener.buffer.clock) == (2.5, clock)


def test_what_cannot_be_followed_is_refused(sessions):
    with pytest.raises(InvalidInput, match="follow is 'joint_states' or 'tf', not 'joints'"):
        TransformListener(sessions[0], "r1", follow="joints")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="no wire 'dds'"):
        TransformListener(sessions[0], "r1", wire="dds")
    with pytest.raises(InvalidInput, match="robot name 'a/b'"):
        TransformListener(sessions[0], "a/b")
    with pytest.raises(InvalidInput, match="history_s"):
        TransformListener(sessions[0], "r1", history_s=0.0)


def test_the_writers_name_stands_in_frames_and_in_errors(sessions, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/opt/arm_driver.py"])
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as publisher, TransformListener(reader, "r1") as listener:
        settle(writer, "r1")
        publisher.publish([0.0, 0.0], stamp=STAMP)
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        until(lambda: any("arm_driver@" in (frame.writer or "") for frame in listener.buffer.frames()))
        with pytest.raises(InFuture, match=r"writer arm_driver@\S+ pid \d+") as caught:
            listener.buffer.lookup("world", "tool", STAMP + 1)
        assert caught.value.writer.startswith("arm_driver@")


def test_closing_is_quick_ends_hearing_and_may_be_repeated(sessions):
    writer, reader = sessions
    listener = TransformListener(reader, "r1")
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        settle(writer, "r1")
        publisher.publish([0.0, 0.0], stamp=STAMP)
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        began = time.monotonic()
        listener.close()
        listener.close()
        assert time.monotonic() - began < 1.0
        with StreamPublisher(writer, "zstate/r1/joint_states", "") as probe:
            until(lambda: not probe.has_readers)
        assert listener.buffer.latest("world", "tool") == STAMP


def test_a_changed_urdf_replaces_the_robot(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        with StatePublisher(writer, RRBOT, "r1") as publisher:
            settle(writer, "r1")
            publisher.publish([0.5, 0.0], stamp=STAMP)
            listener.buffer.wait("world", "tool", timeout_s=5.0)
        with StatePublisher(writer, LONGER, "r1") as publisher:
            until(lambda: listener.buffer.lookup("lower", "tool").translation[2] == 0.9)
            publisher.publish([0.5, 0.25], stamp=STAMP + 1)
            until(lambda: listener.buffer.can_lookup("world", "tool", STAMP + 1))
            pose = listener.buffer.lookup("world", "tool")
            assert_pose(pose, kinematic_pose(LONGER, [0.5, 0.25], "world", "tool"))
            assert not listener.buffer.can_lookup("world", "tool", STAMP)


def test_the_model_places_its_links_and_another_writer_that_did_gives_way(sessions, caplog):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener, StaticPublisher(writer, "r1", "mistake") as statics:
        statics.set(Transform("base", "upper", (9.0, 0.0, 0.0), UPRIGHT))
        listener.buffer.wait("base", "upper", timeout_s=5.0)
        with caplog.at_level(logging.WARNING), StatePublisher(writer, RRBOT, "r1") as publisher:
            settle(writer, "r1")
            publisher.publish([0.5, 0.25], stamp=STAMP)
            until(lambda: listener.buffer.can_lookup("world", "tool", STAMP))
            pose = listener.buffer.lookup("world", "tool", STAMP)
            assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
            assert listener.stats.refused == {"second writer": 1}
            statics.set(Transform("base", "upper", (8.0, 0.0, 0.0), UPRIGHT))
            until(lambda: listener.stats.refused == {"second writer": 2})
        assert "'mistake' placed 'r1/upper', a link of the model" in caplog.text


def test_a_writer_without_a_model_is_mapped_by_the_names_it_gives(sessions):
    writer, reader = sessions
    names = ("elbow", "lid", "shoulder")
    state = JointState(STAMP, 0, 9, order_digest(names), to_block([2.0, 7.0, 1.0]), None, None, names)
    with (
        StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]),
        StreamPublisher(writer, "zstate/r1/joint_states", ENCODINGS[JointState]) as driver,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: driver.has_readers)
        driver.put(encode(state))
        pose = listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert_pose(pose, kinematic_pose(RRBOT, [1.0, 2.0], "world", "tool"))


def test_samples_that_were_lost_on_the_way_are_missed(sessions):
    writer, reader = sessions
    order = order_digest(RRBOT.joint_names)
    with (
        StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]),
        StreamPublisher(writer, "zstate/r1/joint_states", ENCODINGS[JointState]) as driver,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: driver.has_readers)
        for seq in (100, 101, 105, 106, 110):
            driver.put(encode(JointState(seq, seq, 9, order, to_block([0.0, 0.0]))))
        assert received(listener, 5)
        assert (listener.stats.missed, listener.stats.dropped) == (3 + 3, 0)


def test_samples_before_the_description_arrive_in_the_end(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1") as listener,
        StatePublisher(writer, RRBOT, "r1", streams=["joint_states"]) as driver,
    ):
        settle(writer, "r1")
        for number in range(10):
            driver.publish([0.1 * number, 0.0], stamp=number)
        until(lambda: listener.robots() == ("r1",))
        assert listener.stats.received == 0
        with StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]):
            assert received(listener, 10)
        pose = listener.buffer.lookup("world", "tool", 3)
        assert_pose(pose, kinematic_pose(RRBOT, [0.1 * 3, 0.0], "world", "tool"))


def test_of_two_writers_at_once_the_newer_is_followed_and_the_other_counted(sessions, caplog):
    writer, reader = sessions
    with (
        caplog.at_level(logging.WARNING),
        TransformListener(reader, "r1") as listener,
        StatePublisher(writer, RRBOT, "r1") as first,
    ):
        settle(writer, "r1")
        first.publish([1.0, 1.0], stamp=1)
        assert received(listener, 1)
        with StatePublisher(writer, RRBOT, "r1") as second:
            for stamp in range(2, 12, 2):
                second.publish([2.0, 2.0], stamp=stamp)
                first.publish([1.0, 1.0], stamp=stamp + 1)
            until(lambda: listener.stats.refused == {"second writer": 5})
            assert listener.stats.received == 6
            assert listener.buffer.latest("world", "tool") == 10
            assert not listener.buffer.can_lookup("world", "tool", 1)
        # The newer one has left: the first is taken again.
        until(lambda: first.publish([1.0, 1.0], stamp=20) or listener.stats.received > 6)
        assert listener.buffer.wait("world", "tool", 20, timeout_s=5.0)
    assert caplog.text.count("second writer") == 1


JOINT_STATE = encode(JointState(1, 0, 9, order_digest(RRBOT.joint_names), to_block([0.0, 0.0])))
SAMPLE = encode(TransformSample(1, 0, 9, b"8 bytes.", to_block([0.0] * 14)))
STATICS = encode(StaticTransforms(9, (("a", "b"),), to_block([0, 0, 0, 0, 0, 0, 1.0])))
DESCRIPTION = encode(RobotDescription(9, RRBOT.urdf, "digest", RRBOT.joint_names, ()))
KINDS = {
    "joint_states": (JointState, JOINT_STATE),
    "tf": (TransformSample, SAMPLE),
    "tf_static/bad": (StaticTransforms, STATICS),
    "robot_description": (RobotDescription, DESCRIPTION),
}


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_garbage_on_every_key_is_counted_by_reason_logged_once_and_stops_nothing(sessions, caplog, follow):
    writer, reader = sessions
    keys = [key for key in KINDS if key not in ({"joint_states", "tf"} - {follow})]
    random = np.random.default_rng(4)
    with (
        caplog.at_level(logging.WARNING),
        TransformListener(reader, "r1", follow=follow) as listener,
        StatePublisher(writer, RRBOT, "r1") as publisher,
    ):
        settle(writer, "r1", follow)
        for key in keys:
            kind, good = KINDS[key]
            ours = ENCODINGS[kind]
            for _ in range(2):
                for payload, encoding in (
                    (good[: len(good) // 2], ours),
                    (good, "application/json"),
                    (good, ENCODINGS[RobotDescription if kind is JointState else JointState]),
                    (good, ours.replace("v=1", "v=2")),
                    (b"\xc1" + random.bytes(40), ours),
                    (random.bytes(40), "zenoh/bytes"),
                ):
                    with StreamPublisher(writer, f"zstate/r1/{key}", encoding) as stream:
                        stream.put(payload)
        times = 2 * len(keys)
        expected = {"truncated": times, "foreign": 3 * times, "newer version": times, "malformed": times}
        until(lambda: sum(listener.stats.refused.values()) >= 6 * times)
        assert listener.stats.refused == expected
        assert [record.getMessage().count("refused") for record in caplog.records] == [1] * 4
        publisher.publish([0.5, 0.25], stamp=STAMP)
        pose = listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        assert listener.stats.refused == expected


@pytest.mark.parametrize("positions", [[0.0], [0.0] * 3, [0.0, float("nan")], [float("-inf"), 0.0]])
def test_a_message_with_impossible_positions_is_counted_and_the_next_is_taken(sessions, positions):
    writer, reader = sessions
    order = order_digest(RRBOT.joint_names)
    with (
        StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]),
        StreamPublisher(writer, "zstate/r1/joint_states", ENCODINGS[JointState]) as driver,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: driver.has_readers)
        driver.put(encode(JointState(1, 0, 9, order, to_block(positions))))
        driver.put(encode(JointState(2, 1, 9, order, to_block([0.5, 0.25]))))
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert listener.buffer.latest("world", "tool") == 2
        assert listener.stats.refused == {"bad numbers": 1}


def test_a_description_that_cannot_be_used_is_counted_and_a_good_one_is_taken(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        bad = encode(RobotDescription(9, "<robot name='x'/>", "digest", (), ()))
        key, encoding = "zstate/r1/robot_description", ENCODINGS[RobotDescription]
        with LatchedPublisher(writer, key, encoding) as latched:
            latched.set(bad)
            until(lambda: listener.stats.refused == {"robot description": 1})
        with StatePublisher(writer, RRBOT, "r1"):
            assert listener.buffer.wait("lower", "tool", timeout_s=5.0).translation[2] == 0.6


READER = """
    import sys
    from zstate import TransformListener, connect
    with connect() as session, TransformListener(session, "r1", follow=sys.argv[1]) as listener:
        print("ready")
        print(listener.buffer.wait("world", "tool", timeout_s=15.0).stamp)
        print(sorted({"pinocchio", "viser", "mcap", "click", "rich"} & set(sys.modules)))
"""


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_a_reader_loads_neither_pinocchio_nor_a_window(sessions, spawn, follow):
    reader: Child = spawn(READER, follow)
    assert reader.line() == "ready"
    writer = sessions[0]
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        settle(writer, "r1", follow)
        publisher.publish([0.0, 0.0], stamp=STAMP)
        assert reader.line() == str(STAMP)
        assert reader.line() == "[]"
    assert (reader.wait(), reader.stderr) == (0, "")
