"""A publisher and a listener on the ros2 wire, each against a bare Zenoh session and rosbags."""

from __future__ import annotations

import re
import sys
import time

import numpy as np
import pytest
from helpers.processes import until
from helpers.raw_ros_nodes import (
    DESCRIPTION,
    HUMBLE,
    JOINT_STATES,
    TF,
    TF_STATIC,
    TOPICS,
    KeySubscriber,
    gid_of,
    key_of,
    tokens,
)
from helpers.robots import RRBOT, STAMP, wait_for_reader

from zstate.model.kinematics import MovingEdges
from zstate.model.robot import RobotModel
from zstate.net.discovery import discover
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.transform import Transform

SEC, NANOSEC = divmod(STAMP, 10**9)
POSITIONS = np.linspace(-0.5, 0.7, RRBOT.position_count)
JOINT_STATE_MSG, TF_MSG, STRING_MSG = (
    "sensor_msgs/msg/JointState",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/String",
)


@pytest.fixture(autouse=True)
def program(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name of the program, of which the node's is made."""
    monkeypatch.setattr(sys, "argv", ["/home/me/arm_driver.py"])
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def endpoints(session: Session, number: int, domain: int = 0) -> dict[str, list[str]]:
    """The tokens of publishers that are alive by their topic, split into chunks, once there are so many."""
    until(lambda: len([one for one in tokens(session, domain) if "/MP/" in one]) == number)
    return {chunks[9]: chunks for one in tokens(session, domain) if (chunks := one.split("/"))[5] == "MP"}


def moving_poses(model: RobotModel, positions) -> dict[tuple[str, str], list[float]]:
    moving = MovingEdges(model)
    poses = moving.poses(positions).tolist()
    return {(form.parent, form.child): pose for form, pose in zip(moving.forms, poses, strict=True)}


def decoded_poses(message) -> dict[tuple[str, str], list[float]]:
    return {
        (one.header.frame_id, one.child_frame_id): [
            *(getattr(one.transform.translation, axis) for axis in "xyz"),
            *(getattr(one.transform.rotation, axis) for axis in "xyzw"),
        ]
        for one in message.transforms
    }


def test_ros_node_decodes_joint_states_and_transforms(sessions):
    writer, reader = sessions
    joints, transforms = KeySubscriber(reader, key_of(JOINT_STATES)), KeySubscriber(reader, key_of(TF))
    rates, forces = POSITIONS * 2, POSITIONS * 3
    with StatePublisher(writer, RRBOT, wires=("ros2",)) as publisher:
        wait_for_reader(writer, key_of(JOINT_STATES))
        wait_for_reader(writer, key_of(TF))
        publisher.publish(POSITIONS, rates, forces, stamp=STAMP)
        publisher.publish(POSITIONS, stamp=STAMP + 1)
        full, bare = joints.messages(2, JOINT_STATE_MSG)
        (decoded, _) = transforms.messages(2, TF_MSG)
    assert (full.header.stamp.sec, full.header.stamp.nanosec) == (SEC, NANOSEC)
    assert tuple(full.name) == RRBOT.joint_names
    assert [block.tolist() for block in (full.position, full.velocity, full.effort)] == [
        POSITIONS.tolist(),
        rates.tolist(),
        forces.tolist(),
    ]
    assert (bare.header.stamp.nanosec, len(bare.velocity), len(bare.effort)) == (NANOSEC + 1, 0, 0)
    assert {(one.header.stamp.sec, one.header.stamp.nanosec) for one in decoded.transforms} == {
        (SEC, NANOSEC)
    }
    assert decoded_poses(decoded) == moving_poses(RRBOT, POSITIONS)


def test_late_joiner_receives_the_description_and_the_fixed_edges(sessions):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, wires=("ros2",)):
        (text,) = KeySubscriber(reader, key_of(DESCRIPTION), latched=True).messages(1, STRING_MSG)
        (statics,) = KeySubscriber(reader, key_of(TF_STATIC), latched=True).messages(1, TF_MSG)
    assert text.data == RRBOT.urdf
    fixed = {(j.parent, j.child): list(j.origin) for j in RRBOT.joints if j.type == "fixed"}
    assert decoded_poses(statics) == fixed


def test_each_message_is_numbered_dated_and_signed_by_an_endpoint_that_is_alive(sessions):
    writer, reader = sessions
    subscribers = {topic[0]: KeySubscriber(reader, key_of(topic)) for topic in (JOINT_STATES, TF)}
    before = time.time_ns()
    with StatePublisher(writer, RRBOT, wires=("ros2",)) as publisher:
        subscribers |= {
            topic[0]: KeySubscriber(reader, key_of(topic), latched=True) for topic in (TF_STATIC, DESCRIPTION)
        }
        for topic in (JOINT_STATES, TF):
            wait_for_reader(writer, key_of(topic))
        for number in range(3):
            publisher.publish(POSITIONS, stamp=STAMP + number)
        alive = endpoints(reader, 4)
        for topic, numbers in ((JOINT_STATES, 3), (TF, 3), (TF_STATIC, 1), (DESCRIPTION, 1)):
            decoded = subscribers[topic[0]].attachments(numbers)
            assert [seq for seq, _, _ in decoded] == list(range(1, numbers + 1))
            assert all(before <= at <= time.time_ns() for _, at, _ in decoded)
            assert {gid for _, _, gid in decoded} == {gid_of("/".join(alive[f"%{topic[0]}"]))}
            # A ROS node does not look at the encoding; none is what ROS itself gives.
            assert {str(sample.encoding) for sample in subscribers[topic[0]].samples} == {"zenoh/bytes"}


def test_the_graph_has_one_node_with_four_publishers_as_ros_would_announce_them(sessions):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, wires=("ros2",)):
        alive = endpoints(reader, 4)
        nodes = [one.split("/") for one in tokens(reader) if "/NN/" in one]
    (node,) = nodes
    assert node[:3] == ["@ros2_lv", "0", writer.zid]
    assert node[3] == node[4]
    assert node[5:] == ["NN", "%", "%", "arm_driver"]
    for name, dds, its_hash, qos in TOPICS:
        chunks = alive[f"%{name}"]
        assert chunks[:4] == node[:4]
        assert chunks[5:] == ["MP", "%", "%", "arm_driver", f"%{name}", dds, its_hash, qos]
    ids = [node[3], *(chunks[4] for chunks in alive.values())]
    assert len(set(ids)) == 5
    assert all(re.fullmatch(r"\d+", one) for one in ids)
    until(lambda: tokens(reader) == [])


def test_a_program_that_reads_and_writes_is_one_node_until_it_does_neither(sessions):
    program, reader = sessions
    with StatePublisher(program, RRBOT, "ros", ("ros2",), streams=["tf"]):
        with TransformListener(program, "ros", wire="ros2"):
            until(lambda: {one.split("/")[5] for one in tokens(reader)} == {"NN", "MP", "MS"})
            assert len([one for one in tokens(reader) if "/NN/" in one]) == 1
        until(lambda: sorted(one.split("/")[5] for one in tokens(reader)) == ["MP", "NN"])
    until(lambda: tokens(reader) == [])


def test_nothing_is_ever_deleted_from_the_keys_of_ros(sessions):
    writer, reader = sessions
    subscribers = [KeySubscriber(reader, key_of(topic)) for topic in TOPICS]
    last = KeySubscriber(reader, "last")
    for topic in TOPICS:
        wait_for_reader(writer, key_of(topic))
    with StatePublisher(writer, RRBOT, wires=("ros2",)) as publisher:
        publisher.publish(POSITIONS, stamp=STAMP)
        for subscriber in subscribers:
            subscriber.wait_for(1)
    with StaticPublisher(writer, "rrbot", "mount", wires="ros2") as statics:
        statics.set(Transform("tool", "camera", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        statics.withdraw("camera")
    wait_for_reader(writer, "last")
    writer.zenoh.put("last", b"x")
    last.wait_for(1)
    kinds = {str(sample.kind) for subscriber in subscribers for sample in subscriber.samples}
    assert kinds == {"SampleKind.PUT"}
    assert [len(message.transforms) for message in subscribers[2].messages(3, TF_MSG)][1:] == [1, 0]


def test_humble_has_no_hashes(sessions):
    writer, reader = sessions
    subscriber = KeySubscriber(reader, key_of(JOINT_STATES, written=HUMBLE))
    with StatePublisher(writer, RRBOT, wires=("ros2:hash=humble",)) as publisher:
        wait_for_reader(writer, key_of(JOINT_STATES, written=HUMBLE))
        publisher.publish(POSITIONS, stamp=STAMP)
        alive = endpoints(reader, 4)
        assert {chunks[11] for chunks in alive.values()} == {HUMBLE}
        ((_, _, gid),) = subscriber.attachments(1)
        assert gid == gid_of("/".join(alive["%joint_states"]))
        (late,) = KeySubscriber(reader, key_of(DESCRIPTION, written=HUMBLE), latched=True).messages(
            1, STRING_MSG
        )
        assert late.data == RRBOT.urdf


def test_iron_and_humble_can_be_published_together(sessions):
    writer, reader = sessions
    keys = [key_of(JOINT_STATES), key_of(JOINT_STATES, written=HUMBLE)]
    subscribers = [KeySubscriber(reader, key) for key in keys]
    with StatePublisher(writer, RRBOT, wires=("ros2", "ros2:hash=humble")) as publisher:
        for key in keys:
            wait_for_reader(writer, key)
        publisher.publish(POSITIONS, stamp=STAMP)
        iron, humble = (subscriber.wait_for(1)[0] for subscriber in subscribers)
        nodes = [one.split("/")[3] for one in tokens(reader) if "/NN/" in one]
    assert iron.payload.to_bytes() == humble.payload.to_bytes()
    assert len(set(nodes)) == 2


def test_the_domain_is_the_first_chunk_everywhere(sessions, monkeypatch: pytest.MonkeyPatch):
    writer, reader = sessions
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    subscriber = KeySubscriber(reader, key_of(JOINT_STATES, domain=7))
    with StatePublisher(writer, RRBOT, wires=("ros2", "ros2:domain=9")) as publisher:
        wait_for_reader(writer, key_of(JOINT_STATES, domain=7))
        publisher.publish(POSITIONS, stamp=STAMP)
        subscriber.wait_for(1)
        for domain in (7, 9):
            assert len(endpoints(reader, 4, domain)) == 4
        assert tokens(reader, 0) == []


@pytest.mark.parametrize(
    ("options", "namespace", "tf_in"),
    [
        ("namespace=fleet/r1", "fleet/r1", ""),
        ("namespace=/r1/,tf=namespace", "r1", "r1"),
        ("namespace=*", "rrbot", ""),
    ],
)
def test_namespace_prefixes_topics_and_node(sessions, options, namespace, tf_in):
    writer, reader = sessions
    subscribers = {
        topic[0]: KeySubscriber(reader, key_of(topic, namespace), latched=topic == DESCRIPTION)
        for topic in TOPICS
    }
    shared = [
        KeySubscriber(reader, key_of(topic, tf_in), latched=topic == TF_STATIC) for topic in (TF, TF_STATIC)
    ]
    with StatePublisher(writer, RRBOT, wires=(f"ros2:{options}",)) as publisher:
        for key in (key_of(JOINT_STATES, namespace), key_of(TF, tf_in)):
            wait_for_reader(writer, key)
        publisher.publish(POSITIONS, stamp=STAMP)
        for subscriber in (subscribers["joint_states"], subscribers["robot_description"], *shared):
            subscriber.wait_for(1)
        alive = endpoints(reader, 4)
    around = f"%{namespace.replace('/', '%')}"
    assert {chunks[7] for chunks in alive.values()} == {around}
    assert {topic for topic in alive if "tf" not in topic} == {
        f"{around}%joint_states",
        f"{around}%robot_description",
    }


def test_frame_prefix_applies_to_every_frame_of_the_robot(sessions):
    writer, reader = sessions
    transforms = KeySubscriber(reader, key_of(TF))
    with StatePublisher(writer, RRBOT, "r1", wires=("ros2:frame_prefix=*/",)) as publisher:
        (statics,) = KeySubscriber(reader, key_of(TF_STATIC), latched=True).messages(1, TF_MSG)
        wait_for_reader(writer, key_of(TF))
        publisher.publish([0.1, 0.2], stamp=STAMP)
        (moving,) = transforms.messages(1, TF_MSG)
    edges = {(f"r1/{joint.parent}", f"r1/{joint.child}") for joint in RRBOT.joints}
    assert decoded_poses(statics).keys() | decoded_poses(moving).keys() == edges


def test_two_robots_of_one_session_have_two_namespaces(sessions):
    writer, reader = sessions
    wires = ("ros2:namespace=*,frame_prefix=*/",)
    subscribers = {robot: KeySubscriber(reader, key_of(JOINT_STATES, robot)) for robot in ("r1", "r2")}
    transforms = KeySubscriber(reader, key_of(TF))
    with (
        StatePublisher(writer, RRBOT, "r1", wires) as one,
        StatePublisher(writer, RRBOT, "r2", wires) as two,
    ):
        for key in (key_of(JOINT_STATES, "r1"), key_of(JOINT_STATES, "r2"), key_of(TF)):
            wait_for_reader(writer, key)
        one.publish([1.0, 1.0], stamp=STAMP)
        two.publish([2.0, 2.0], stamp=STAMP)
        assert subscribers["r1"].messages(1, JOINT_STATE_MSG)[0].position.tolist() == [1.0, 1.0]
        assert subscribers["r2"].messages(1, JOINT_STATE_MSG)[0].position.tolist() == [2.0, 2.0]
        decoded = transforms.messages(2, TF_MSG)
        alive = tokens(reader)
        robots = {robot.name for robot in discover(reader, wire=wires[0])}
    assert {edge[1] for message in decoded for edge in decoded_poses(message)} == {
        f"{robot}/{link}" for robot in ("r1", "r2") for link in ("upper", "lower")
    }
    assert robots == {"r1", "r2", "ros"}
    nodes = {tuple(one.split("/")[6:9]) for one in alive if "/NN/" in one}
    assert nodes == {("%", "%r1", "arm_driver"), ("%", "%r2", "arm_driver")}
    ids = [one.split("/")[4] for one in alive]
    assert len(set(ids)) == len(ids) == 10


@pytest.mark.parametrize(
    ("script", "node"),
    [
        ("/opt/my driver.v2.py", "my_driver_v2"),
        ("/opt/3d_view.py", "_3d_view"),
        ("/opt/größe.py", "gr__e"),
        ("/usr/lib/zstate/__main__.py", "__main__"),
        ("-c", "python"),
        ("", "python"),
        ("/", "_"),
    ],
)
def test_node_name_is_the_program_made_valid_for_ros(sessions, monkeypatch, script, node):
    monkeypatch.setattr(sys, "argv", [script])
    with StatePublisher(sessions[0], RRBOT, wires=("ros2",)):
        until(lambda: len(tokens(sessions[1])) == 5)
        assert {one.split("/")[8] for one in tokens(sessions[1])} == {node}
    assert re.fullmatch(r"[A-Za-z_]\w*", node, re.ASCII)


def test_the_node_may_be_named(sessions):
    with StatePublisher(sessions[0], RRBOT, wires=("ros2:node=state_publisher",)):
        until(lambda: len(tokens(sessions[1])) == 5)
        assert {one.split("/")[8] for one in tokens(sessions[1])} == {"state_publisher"}
