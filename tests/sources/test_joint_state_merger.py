"""Joint states of several drivers of one robot as whole readings."""

import logging
import time

import pytest
from helpers.processes import until
from helpers.raw_ros_nodes import JOINT_STATES, RosNode
from helpers.robots import RRBOT, wait_for_stream_readers

from zstate.errors import InvalidInput, MessageError
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.sources import JointStateListener
from zstate.sources.joint_state_merger import JointStateMerger
from zstate.wire.messages import JointState, order_digest, to_block

MS = 1_000_000
SHOULDER, ELBOW = RRBOT.joint_names


def state(session: int, names: tuple[str, ...], numbers: list[float], stamp: int, rates=None) -> JointState:
    block = None if rates is None else to_block(rates)
    return JointState(stamp, 0, session, order_digest(names), to_block(numbers), block, None, names)


def test_each_sample_gives_a_reading_with_the_newest_values_of_the_others():
    merger = JointStateMerger(RRBOT, 0.5)
    assert merger.add(state(1, (ELBOW,), [0.1], 100), "gripper") is None
    reading = merger.add(state(2, (SHOULDER,), [0.2], 130), "arm")
    assert reading is not None
    assert reading.positions.tolist() == [0.2, 0.1]
    assert (reading.stamp, reading.oldest_stamp) == (130, 100)
    reading = merger.add(state(1, (ELBOW,), [0.3], 120), "gripper")
    assert reading is not None
    assert reading.positions.tolist() == [0.2, 0.3]
    assert (reading.stamp, reading.oldest_stamp) == (130, 120)
    assert merger.incomplete == 1


def test_velocities_are_known_once_all_drivers_send_them():
    merger = JointStateMerger(RRBOT, 0.5)
    merger.add(state(1, (ELBOW,), [0.1], 100, [1.0]), "gripper")
    without = merger.add(state(2, (SHOULDER,), [0.2], 100), "arm")
    complete = merger.add(state(2, (SHOULDER,), [0.2], 101, [2.0]), "arm")
    assert without is not None
    assert complete is not None
    assert without.velocities is None
    assert complete.velocities is not None
    assert complete.velocities.tolist() == [2.0, 1.0]


def test_value_older_than_the_bound_makes_readings_incomplete():
    merger = JointStateMerger(RRBOT, 0.1)
    merger.add(state(1, (ELBOW,), [0.1], 0), "gripper")
    assert merger.add(state(2, (SHOULDER,), [0.2], 100 * MS), "arm") is not None
    assert merger.add(state(2, (SHOULDER,), [0.2], 100 * MS + 1), "arm") is None
    assert merger.missing_joints() == ()
    assert merger.add(state(2, (SHOULDER,), [0.2], 200 * MS + 1), "arm") is None
    assert merger.missing_joints() == (ELBOW,)
    assert merger.explanation() == (
        f"'{ELBOW}' of gripper 200.0 ms older than the newest, more than 100.0 ms"
    )
    assert merger.add(state(1, (ELBOW,), [0.1], 200 * MS), "gripper") is not None


def test_joint_of_another_driver_is_refused_with_both_names():
    merger = JointStateMerger(RRBOT, 10.0)
    merger.add(state(1, (ELBOW,), [0.1], 0), "gripper")
    with pytest.raises(
        MessageError, match=f"joint '{ELBOW}' is published by gripper; refused: arm"
    ) as raised:
        merger.add(state(2, (SHOULDER, ELBOW), [0.2, 0.2], 0), "arm")
    assert raised.value.reason == "second writer"


def test_listener_merges_two_drivers_and_names_the_missing_one_once(sessions, caplog):
    writer, reader = sessions
    stamp = time.time_ns()
    with (
        PartialStatePublisher(writer, RRBOT, [SHOULDER], "r1", writer="arm") as arm,
        PartialStatePublisher(writer, RRBOT, [ELBOW], "r1", writer="gripper") as gripper,
        JointStateListener(reader, "r1", RRBOT, max_age_s=0.1) as joints,
        caplog.at_level(logging.WARNING, "zstate"),
    ):
        wait_for_stream_readers(writer, "r1", "partial_joint_states/arm", "partial_joint_states/gripper")
        gripper.publish([0.5], stamp=stamp)
        until(lambda: joints.incomplete == 1)
        for step in range(10):
            arm.publish([0.1 * step], stamp=stamp + 40 * step * MS)
        until(lambda: joints.incomplete == 8)
        readings = [reading for _, reading in zip(range(3), joints, strict=False)]
    assert [reading.positions.tolist() for reading in readings] == [[0.1 * n, 0.5] for n in range(3)]
    assert [reading.oldest_stamp for reading in readings] == [stamp] * 3
    assert caplog.text.count(f"no whole joint states: '{ELBOW}' of 'gripper'") == 1
    with pytest.raises(InvalidInput, match="max_age_s"):
        JointStateListener(reader, "r1", RRBOT, max_age_s=0.0)


def test_nodes_that_publish_some_joints_each_are_merged(sessions, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "0")
    writer, reader = sessions
    stamp = time.time_ns()
    with JointStateListener(reader, "r1", RRBOT, wire="ros2") as joints:
        arm, gripper = (
            RosNode(writer, name).publisher(JOINT_STATES).announce().wait_for_reader()
            for name in ("arm", "gripper")
        )
        arm.joints(stamp, (SHOULDER,), [0.5])
        until(lambda: joints.incomplete == 1)
        gripper.joints(stamp + MS, (ELBOW, "lid"), [0.25, 7.0])
        gripper.joints(stamp + 2 * MS, ("lid", ELBOW), [7.0, 0.75])
        readings = [reading for _, reading in zip(range(2), joints, strict=False)]
    assert [reading.positions.tolist() for reading in readings] == [[0.5, 0.25], [0.5, 0.75]]
