"""Writers of one robot: samples used when writers join, leave and conflict."""

from __future__ import annotations

import logging

import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT, STAMP, UPRIGHT, assert_pose, kinematic_pose, wait_for_stream_readers

from zstate.errors import InFuture
from zstate.model.load import load_model
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.transform import Transform
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.native import encode, encoding_of

LONGER = load_model(RRBOT.urdf.replace('xyz="0 0 0.6"', 'xyz="0 0 0.9"'))


def received(listener: TransformListener, count: int) -> bool:
    until(lambda: listener.stats.received >= count)
    return listener.stats.received == count


def test_frames_and_errors_name_the_writer(sessions, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/opt/arm_driver.py"])
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as publisher, TransformListener(reader, "r1") as listener:
        wait_for_stream_readers(writer, "r1")
        publisher.publish([0.0, 0.0], stamp=STAMP)
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        until(lambda: any("arm_driver@" in (frame.writer or "") for frame in listener.buffer.frames()))
        with pytest.raises(InFuture, match=r"writer arm_driver@\S+ pid \d+") as caught:
            listener.buffer.lookup("world", "tool", STAMP + 1)
        assert caught.value.writer.startswith("arm_driver@")


def test_changed_urdf_replaces_the_robot(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        with StatePublisher(writer, RRBOT, "r1") as publisher:
            wait_for_stream_readers(writer, "r1")
            publisher.publish([0.5, 0.0], stamp=STAMP)
            listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        with StatePublisher(writer, LONGER, "r1") as publisher:
            # Between the old model and the new one the frames have no parents.
            buffer = listener.buffer
            until(
                lambda: (
                    buffer.can_lookup("lower", "tool")
                    and buffer.lookup("lower", "tool").translation[2] == 0.9
                )
            )
            publisher.publish([0.5, 0.25], stamp=STAMP + 1)
            until(lambda: listener.buffer.can_lookup("world", "tool", STAMP + 1))
            pose = listener.buffer.lookup("world", "tool")
            assert_pose(pose, kinematic_pose(LONGER, [0.5, 0.25], "world", "tool"))
            assert not listener.buffer.can_lookup("world", "tool", STAMP)


def test_model_places_its_links_and_another_writer_yields(sessions, caplog):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener, StaticPublisher(writer, "r1", "mistake") as statics:
        statics.set(Transform("base", "upper", (9.0, 0.0, 0.0), UPRIGHT))
        listener.buffer.wait("base", "upper", timeout_s=DEADLINE_S)
        with caplog.at_level(logging.WARNING), StatePublisher(writer, RRBOT, "r1") as publisher:
            wait_for_stream_readers(writer, "r1")
            publisher.publish([0.5, 0.25], stamp=STAMP)
            until(lambda: listener.buffer.can_lookup("world", "tool", STAMP))
            pose = listener.buffer.lookup("world", "tool", STAMP)
            assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
            assert listener.stats.refused == {"second writer": 1}
            statics.set(Transform("base", "upper", (8.0, 0.0, 0.0), UPRIGHT))
            until(lambda: listener.stats.refused == {"second writer": 2})
        assert "'r1/upper' is written by the model of 'rrbot' already; refused: mistake" in caplog.text


def test_writer_without_a_model_is_mapped_by_its_joint_names(sessions):
    writer, reader = sessions
    names = ("elbow", "lid", "shoulder")
    state = JointState(STAMP, 0, 9, order_digest(names), to_block([2.0, 7.0, 1.0]), None, None, names)
    with (
        StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]),
        KeyPublisher(writer, "zstate/r1/joint_states", encoding_of(JointState)) as driver,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: driver.has_readers)
        driver.put(encode(state))
        pose = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert_pose(pose, kinematic_pose(RRBOT, [1.0, 2.0], "world", "tool"))


def test_lost_samples_count_as_missed(sessions):
    writer, reader = sessions
    order = order_digest(RRBOT.joint_names)
    with (
        StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]),
        KeyPublisher(writer, "zstate/r1/joint_states", encoding_of(JointState)) as driver,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: driver.has_readers)
        for seq in (100, 101, 105, 106, 110):
            driver.put(encode(JointState(seq, seq, 9, order, to_block([0.0, 0.0]))))
        assert received(listener, 5)
        assert (listener.stats.missed, listener.stats.dropped) == (3 + 3, 0)


def test_samples_before_the_description_are_inserted_later(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1") as listener,
        StatePublisher(writer, RRBOT, "r1", streams=["joint_states"]) as driver,
    ):
        wait_for_stream_readers(writer, "r1")
        for number in range(10):
            driver.publish([0.1 * number, 0.0], stamp=number)
        until(lambda: listener.robots() == ("r1",))
        assert listener.stats.received == 0
        with StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]):
            assert received(listener, 10)
        pose = listener.buffer.lookup("world", "tool", 3)
        assert_pose(pose, kinematic_pose(RRBOT, [0.1 * 3, 0.0], "world", "tool"))


def test_newer_of_two_writers_is_used_and_the_other_counted(sessions, caplog):
    writer, reader = sessions
    with (
        caplog.at_level(logging.WARNING),
        TransformListener(reader, "r1") as listener,
        StatePublisher(writer, RRBOT, "r1") as first,
    ):
        wait_for_stream_readers(writer, "r1")
        first.publish([1.0, 1.0], stamp=1)
        assert received(listener, 1)
        with StatePublisher(writer, RRBOT, "r1", takeover=True) as second:
            for stamp in range(2, 12, 2):
                second.publish([2.0, 2.0], stamp=stamp)
                first.publish([1.0, 1.0], stamp=stamp + 1)
            until(lambda: listener.stats.refused == {"second writer": 5})
            assert listener.stats.received == 6
            assert listener.buffer.latest("world", "tool") == 10
            assert not listener.buffer.can_lookup("world", "tool", 1)
        # The newer one has left: the first is taken again.
        until(lambda: first.publish([1.0, 1.0], stamp=20) or listener.stats.received > 6)
        assert listener.buffer.wait("world", "tool", 20, timeout_s=DEADLINE_S)
    assert caplog.text.count("second writer") == 1
