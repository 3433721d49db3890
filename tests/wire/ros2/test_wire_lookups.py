"""Lookups and samples of the ROS 2 wires equal those of the native wire."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from helpers.manual_cdr import rosbags_joint_state, rosbags_tf_message
from helpers.model_samples import every_joint, random_positions
from helpers.processes import DEADLINE_S, until
from helpers.raw_ros_nodes import (
    JOINT_STATES,
    TF,
    KeySubscriber,
    RosNode,
    key_of,
    moved,
    tokens,
)
from helpers.robots import RRBOT, STAMP, assert_pose, kinematic_pose, wait_for_reader

from zstate.errors import InvalidInput
from zstate.model.load import load_model
from zstate.model.robot import velocity_columns_by_position
from zstate.net.discovery import discover
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.sources import JointStateListener
from zstate.transform import Transform
from zstate.wire.native import NativeWire
from zstate.wire.protocol import SerializedSample
from zstate.wire.ros2.wire import Ros2Wire

EVERY = every_joint().model
WIRES = ("native", "ros2", "ros2dds")
MS = 1_000_000


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def data_key(wire: str, robot: str, stream: str) -> str:
    topic = JOINT_STATES if stream == "joint_states" else TF
    return {"native": f"zstate/{robot}/{stream}", "ros2": key_of(topic), "ros2dds": stream}[wire]


@pytest.mark.parametrize("model", [EVERY, load_model("rrbot")], ids=["every joint", "rrbot"])
@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_lookups_equal_those_of_the_native_wire_bit_for_bit(sessions, model, follow: str):
    writer, reader = sessions
    random = np.random.default_rng(7)
    listeners = [TransformListener(reader, "r1", wire=wire, follow=follow) for wire in WIRES]
    with StatePublisher(writer, model, "r1", WIRES) as publisher:
        for wire in WIRES:
            wait_for_reader(writer, data_key(wire, "r1", follow))
        leaves = [link for link in model.links if link not in {joint.parent for joint in model.joints}]
        links = {
            f"r1/{joint.child}" for joint in model.joints if joint.type == "fixed" or follow == "joint_states"
        }
        for listener in listeners:
            until(lambda one=listener: links <= {frame.name for frame in one.buffer.frames()})
        for number in range(4):
            rates = random.normal(size=len(velocity_columns_by_position(model)))
            publisher.publish(
                random_positions(model, number), rates, rates * 2, stamp=STAMP + number * 10 * MS
            )
        for listener in listeners:
            until(lambda one=listener: one.stats.received == 4)
        moments = [STAMP, STAMP + 12 * MS + 345, STAMP + 30 * MS]
        for leaf in leaves:
            ours, *others = (
                [
                    *(one.buffer.lookup(model.root, leaf, at).pose7.tolist() for at in moments),
                    one.buffer.twist(leaf, model.root, moments[1]).linear.tolist(),
                    one.buffer.twist(leaf, model.root, moments[1]).angular.tolist(),
                ]
                for one in listeners
            )
            assert others == [ours, ours]
            if follow == "joint_states":
                ahead = {
                    (answer.kind, tuple(answer.pose7.tolist()))
                    for one in listeners
                    for answer in [one.buffer.lookup(model.root, leaf, moments[2] + MS, predict_s=0.01)]
                }
                assert len(ahead) == 1
                assert ahead.pop()[0] == "predicted"
        assert [one.stats.refused for one in listeners] == [{}, {}, {}]
    for listener in listeners:
        listener.close()


@pytest.mark.parametrize("wire", WIRES)
def test_joint_states_are_read_back_as_they_were_published(sessions, wire: str):
    writer, reader = sessions
    positions = random_positions(EVERY, 1)
    rates = np.arange(float(len(velocity_columns_by_position(EVERY))))
    with (
        JointStateListener(reader, "r1", EVERY, wire=wire) as source,
        StatePublisher(writer, EVERY, "r1", (wire,), streams=["joint_states"]) as publisher,
    ):
        wait_for_reader(writer, data_key(wire, "r1", "joint_states"))
        publisher.publish(positions, rates, rates + 1.0, stamp=STAMP)
        publisher.publish(positions, stamp=STAMP + 1)
        full, bare = (reading for _, reading in zip(range(2), source, strict=False))
    assert (full.stamp, bare.stamp) == (STAMP, STAMP + 1)
    assert full.positions.tolist() == bare.positions.tolist() == positions.tolist()
    assert (full.velocities.tolist(), full.efforts.tolist()) == (rates.tolist(), (rates + 1.0).tolist())
    assert (bare.velocities, bare.efforts) == (None, None)


def test_source_reads_a_ros_driver_and_counts_other_messages(sessions):
    writer, reader = sessions
    names, nan = RRBOT.joint_names, float("nan")
    with JointStateListener(reader, "r1", RRBOT, wire="ros2") as source:
        driver = RosNode(writer, "driver").publisher(JOINT_STATES).announce().wait_for_reader()
        driver.joints(STAMP, ("elbow", "lid", "shoulder"), [2.0, 7.0, 1.0], [nan] * 3, [0.2, nan, 0.1])
        driver.joints(0, names, [0.0, 0.0])
        driver.joints(STAMP, names[:1], [0.0])
        driver.joints(STAMP, names, [nan, 0.0])
        driver.put(rosbags_joint_state(STAMP, "", names, [], [], []))
        driver.put(rosbags_joint_state(STAMP, "", names, [0.0], [], []))
        driver.put(b"\x00\x01")
        driver.put(rosbags_joint_state(STAMP, "", names, [0.0, 0.0], [], []), None)
        driver.joints(STAMP + 1, names, [3.0, 4.0])
        first, last = (reading for _, reading in zip(range(2), source, strict=False))
    assert (first.positions.tolist(), first.velocities, first.efforts.tolist()) == (
        [1.0, 2.0],
        None,
        [0.1, 0.2],
    )
    assert (last.stamp, last.positions.tolist()) == (STAMP + 1, [3.0, 4.0])
    assert source.incomplete == 1  # the message with one joint: the other one has no driver of its own
    reasons = ["no stamp", "bad numbers", "no positions", "malformed", "truncated"]
    assert source.refused == dict.fromkeys([*reasons, "no attachment"], 1)


def test_both_wires_carry_the_same_numbers_at_the_same_instants(sessions):
    writer, reader = sessions
    keys = {wire: data_key(wire, "r1", "joint_states") for wire in ("native", "ros2")}
    received: dict[str, list[SerializedSample]] = {wire: [] for wire in keys}

    def note(wire: str) -> Callable:
        def take(sample) -> None:
            attached = sample.attachment.to_bytes() if sample.attachment else None
            key, payload = str(sample.key_expr), sample.payload.to_bytes()
            received[wire].append(SerializedSample(key, payload, str(sample.encoding), attached))

        return take

    subscribers = [reader.zenoh.declare_subscriber(key, note(wire)) for wire, key in keys.items()]
    with StatePublisher(writer, RRBOT, "r1", tuple(keys)) as publisher:
        for key in keys.values():
            wait_for_reader(writer, key)
        for number in range(5):
            publisher.publish([0.1 * number, 0.2], [1.0, 2.0])
        until(lambda: all(len(arrivals) == 5 for arrivals in received.values()))
    native = [NativeWire().decode("joint_states", one, "r1")[0] for one in received["native"]]
    ros = [Ros2Wire().decode("joint_states", one, "r1")[0] for one in received["ros2"]]
    for one, other in zip(native, ros, strict=True):
        assert (one.stamp, one.positions, one.velocities) == (other.stamp, other.positions, other.velocities)
        assert (one.seq + 1, one.order) == (other.seq, other.order)
    assert len(subscribers) == 2


def test_behind_a_bridge_robots_are_followed_and_their_writers_named(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1", wire="ros2dds", follow="tf") as listener,
        StatePublisher(writer, RRBOT, "r1", ("ros2dds",)) as publisher,
        StaticPublisher(writer, "r1", "mount", wires="ros2dds") as statics,
    ):
        statics.set(Transform("tool", "camera", (0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        wait_for_reader(writer, "tf")
        until(lambda: len(discover(reader, wire="ros2dds")) == 1)
        publisher.publish([0.5, 0.25], stamp=STAMP)
        pose = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        assert listener.buffer.wait("tool", "camera", timeout_s=DEADLINE_S).translation[0] == 0.5
        expected = f"ros2dds bridge {writer.zid[:8]}"
        until(
            lambda: (
                publisher.publish([0.5, 0.25], stamp=STAMP)
                or expected in {frame.writer for frame in listener.buffer.frames()}
            )
        )
        assert listener.stats.refused == {}


def test_plain_puts_of_a_bridge_need_no_token_and_jumps_of_stamps_are_new_epochs(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2dds", follow="tf") as listener:
        wait_for_reader(writer, "tf")
        for stamp in (STAMP, STAMP + 1, STAMP - 3600 * 1000 * MS, STAMP - 3600 * 1000 * MS + 1):
            writer.zenoh.put("tf", rosbags_tf_message([stamp], [("odom", "base")], [moved(1.0)]))
        until(lambda: listener.stats.received == 3)
        assert listener.buffer.latest("odom", "base") == STAMP - 3600 * 1000 * MS + 1
        assert (listener.stats.late, listener.stats.missed, listener.stats.refused) == (1, 0, {})


@pytest.mark.parametrize("stamp", [0, 2**31 * 10**9])
def test_stamp_out_of_the_range_of_ros_is_sent_on_neither_wire(sessions, stamp: int):
    writer, reader = sessions
    native, ros = "zstate/r1/joint_states", key_of(JOINT_STATES)
    subscribers = KeySubscriber(reader, native), KeySubscriber(reader, ros), KeySubscriber(reader, key_of(TF))
    with StatePublisher(writer, RRBOT, "r1", ("native", "ros2")) as publisher:
        for key in (native, ros, key_of(TF)):
            wait_for_reader(writer, key)
        publisher.publish([0.0, 0.0], stamp=STAMP)
        with pytest.raises(InvalidInput, match="stamp"):
            publisher.publish([1.0, 1.0], stamp=stamp)
        publisher.publish([2.0, 2.0], stamp=STAMP + 1)
        for subscriber in subscribers[1:]:
            assert [seq for seq, _, _ in subscriber.attachments(2)] == [1, 2]
        assert [len(subscriber.wait_for(2)) for subscriber in subscribers] == [2, 2, 2]


def test_wire_that_fails_to_open_closes_the_others(sessions):
    writer, reader = sessions
    errors = []  # kept, with all that is reached from where they were raised
    for bad in ("dds", "ros2:namespace=*", "ros2:domain=300"):
        with pytest.raises(InvalidInput) as caught:
            StatePublisher(writer, RRBOT, "r-1", ("ros2", bad))
        errors.append(caught)
    # What was announced before is known here by the time that a later token is.
    with StatePublisher(writer, RRBOT, "r1", ("ros2:node=later",)):
        until(lambda: any("/later/" in one for one in tokens(reader)))
        assert {one.split("/")[8] for one in tokens(reader)} == {"later"}
