"""Unusable input is counted, logged once, and stops nothing."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT, STAMP, assert_pose, kinematic_pose, wait_for_stream_readers

from zstate.net.latched import LatchedPublisher
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    to_block,
)
from zstate.wire.native import encode, encoding_of

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
def test_garbage_on_every_key_is_counted_by_reason_and_logged_once(sessions, caplog, follow):
    writer, reader = sessions
    keys = [key for key in KINDS if key not in ({"joint_states", "tf"} - {follow})]
    random = np.random.default_rng(4)
    with (
        caplog.at_level(logging.WARNING),
        TransformListener(reader, "r1", follow=follow) as listener,
        StatePublisher(writer, RRBOT, "r1") as publisher,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        for key in keys:
            kind, good = KINDS[key]
            ours = encoding_of(kind)
            for _ in range(2):
                for payload, encoding in (
                    (good[: len(good) // 2], ours),
                    (good, "application/json"),
                    (good, encoding_of(RobotDescription if kind is JointState else JointState)),
                    (good, ours.replace("v=1", "v=2")),
                    (b"\xc1" + random.bytes(40), ours),
                    (random.bytes(40), "zenoh/bytes"),
                ):
                    with KeyPublisher(writer, f"zstate/r1/{key}", encoding) as stream:
                        stream.put(payload)
        times = 2 * len(keys)
        expected = {"truncated": times, "foreign": 3 * times, "newer version": times, "malformed": times}
        until(lambda: sum(listener.stats.refused.values()) >= 6 * times)
        assert listener.stats.refused == expected
        assert [record.getMessage().count("refused") for record in caplog.records] == [1] * 4
        publisher.publish([0.5, 0.25], stamp=STAMP)
        pose = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        assert listener.stats.refused == expected


@pytest.mark.parametrize("positions", [[0.0], [0.0] * 3, [0.0, float("nan")], [float("-inf"), 0.0]])
def test_message_with_invalid_positions_is_counted_and_the_next_is_inserted(sessions, positions):
    writer, reader = sessions
    order = order_digest(RRBOT.joint_names)
    with (
        StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]),
        KeyPublisher(writer, "zstate/r1/joint_states", encoding_of(JointState)) as driver,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: driver.has_readers)
        driver.put(encode(JointState(1, 0, 9, order, to_block(positions))))
        driver.put(encode(JointState(2, 1, 9, order, to_block([0.5, 0.25]))))
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert listener.buffer.latest("world", "tool") == 2
        assert listener.stats.refused == {"bad numbers": 1}


def test_unusable_description_is_counted_and_a_good_one_is_used(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        bad = encode(RobotDescription(9, "<robot name='x'/>", "digest", (), ()))
        key, encoding = "zstate/r1/robot_description", encoding_of(RobotDescription)
        with LatchedPublisher(writer, key, encoding) as latched:
            latched.set(bad)
            until(lambda: listener.stats.refused == {"robot description": 1})
        with StatePublisher(writer, RRBOT, "r1"):
            assert listener.buffer.wait("lower", "tool", timeout_s=DEADLINE_S).translation[2] == 0.6
