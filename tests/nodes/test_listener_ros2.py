"""A listener on the ros2 wire among nodes made of bare Zenoh and rosbags."""

from __future__ import annotations

import pytest
from helpers.manual_cdr import rosbags_joint_state, rosbags_tf_message
from helpers.processes import DEADLINE_S, until
from helpers.raw_ros_nodes import (
    DESCRIPTION,
    HUMBLE,
    JOINT_STATES,
    TF,
    TF_STATIC,
    RosNode,
    RosPublisher,
    attachment,
    moved,
)
from helpers.robots import RRBOT, STAMP, assert_pose, kinematic_pose, wait_for_reader
from helpers.ros_subscriber import publish_description, publish_known_joints, writers, x_of

from zstate.errors import InFuture
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher

SECOND = 10**9
NAMES = RRBOT.joint_names


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def test_several_transform_writers_build_one_tree_without_conflict(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        arm = RosNode(writer, "robot_state_publisher").publisher(TF).announce().wait_for_reader()
        odometry = RosNode(writer, "odometry").publisher(TF).announce()
        for number in range(20):
            odometry.edge(STAMP + number, "odom", "base", 100.0 + number)
            arm.edge(STAMP + number, "base", "tool", 1.0 + number)
        until(lambda: listener.stats.received == 40)
        assert [x_of(listener, "odom", "tool", STAMP + n) for n in range(20)] == [
            101.0 + 2 * n for n in range(20)
        ]
        assert (listener.stats.refused, listener.stats.missed, listener.stats.late) == ({}, 0, 0)

        def are_named() -> bool:
            odometry.edge(STAMP + 20, "odom", "base", 1.0)
            arm.edge(STAMP + 20, "base", "tool", 1.0)
            return writers(listener) == {"base": "/odometry", "tool": "/robot_state_publisher"}

        until(are_named)


def test_message_may_have_transforms_of_several_instants(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        bag = RosNode(writer, "player").publisher(TF).announce().wait_for_reader()
        edges = [("odom", "base"), ("base", "tool"), ("odom", "other")]
        for later in (0, 10):
            stamps = [STAMP + later + 1, STAMP + later, STAMP + later + 1]
            bag.put(rosbags_tf_message(stamps, edges, [moved(1.0), moved(2.0), moved(3.0)]))
        until(lambda: listener.stats.received == 4)
        assert [x_of(listener, *edge, STAMP + 10) for edge in edges] == [1.0, 2.0, 3.0]
        assert listener.buffer.latest("odom", "base") == STAMP + 11
        assert listener.buffer.latest("base", "tool") == STAMP + 10
        assert (listener.stats.refused, listener.stats.missed) == ({}, 0)


def test_writers_are_named_by_their_nodes_even_if_announced_late(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        node = RosNode(writer, "arm", "/fleet/r1")
        moving, fixed = node.publisher(TF).wait_for_reader(), node.publisher(TF_STATIC)
        moving.edge(STAMP, "base", "tool", 1.0)
        fixed.edge(0, "tool", "camera", 2.0)
        listener.buffer.wait("base", "camera", timeout_s=DEADLINE_S)
        assert set(writers(listener).values()) != {"/fleet/r1/arm"}
        moving.announce()
        fixed.announce()
        until(lambda: writers(listener)["camera"] == "/fleet/r1/arm")
        until(
            lambda: (
                moving.edge(STAMP + 1, "base", "tool", 1.0) or writers(listener)["tool"] == "/fleet/r1/arm"
            )
        )


@pytest.mark.parametrize("written", ["", HUMBLE])
def test_writers_of_every_distribution_are_received(sessions, written: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        described = RosNode(writer, "rsp").publisher(DESCRIPTION, written)
        described.text(RRBOT.urdf)
        driver = RosNode(writer, "driver").publisher(JOINT_STATES, written).announce().wait_for_reader()
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        pose = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        until(lambda: writers(listener)["lower"] == "/driver")


def test_joints_are_found_by_name_in_any_order_and_among_others(sessions):
    writer, reader = sessions
    nan = float("nan")
    with TransformListener(reader, "r1", wire="ros2") as listener:
        publish_description(writer)
        driver = publish_known_joints(writer, listener)
        driver.joints(STAMP, ("lid", "elbow", "shoulder"), [7.0, 0.25, 0.5], [0.0, 2.0, 1.0], [nan] * 3)
        pose = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        driver.joints(STAMP + SECOND // 100, ("elbow", "shoulder"), [0.27, 0.51], [2.0, 1.0])
        until(lambda: listener.stats.received == 2)
        ahead = STAMP + SECOND // 100 + SECOND // 1000
        predicted = listener.buffer.lookup("world", "tool", ahead, predict_s=0.01)
        assert predicted.kind == "predicted"
        assert_pose(predicted, kinematic_pose(RRBOT, [0.511, 0.272], "world", "tool"))
        assert listener.stats.refused == {}


def test_nodes_that_publish_some_joints_each_move_one_robot(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        lower, upper = (
            RosNode(writer, name).publisher(JOINT_STATES).announce().wait_for_reader()
            for name in ("arm", "gripper")
        )
        lower.joints(STAMP, ("shoulder",), [0.0])  # before the description
        publish_description(writer)
        lower.joints(STAMP + 100, ("shoulder",), [1.0])
        upper.joints(STAMP + 20, ("elbow", "lid"), [2.0, 7.0])
        upper.joints(STAMP + 60, ("elbow", "lid"), [0.0, 7.0])
        pose = listener.buffer.wait("world", "tool", STAMP + 30, timeout_s=DEADLINE_S)
        assert_pose(pose, kinematic_pose(RRBOT, [0.3, 1.5], "world", "tool"))
        until(lambda: (writers(listener)["upper"], writers(listener)["lower"]) == ("/arm", "/gripper"))
        with pytest.raises(InFuture, match="/gripper"):
            listener.buffer.lookup("world", "tool", STAMP + 61)
        assert (listener.stats.refused, {event.kind for event in listener.events()}) == ({}, {"joined"})


def test_some_joints_are_refused_from_a_node_that_published_more_of_them(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        publish_description(writer)
        driver = publish_known_joints(writer, listener)
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        driver.joints(STAMP + 1, ("shoulder",), [0.0])
        until(lambda: listener.stats.refused == {"missing joints": 1})
        assert listener.refusals["missing joints"].endswith("together with 'elbow', refused: without")


@pytest.mark.parametrize(
    ("joint_state", "reason"),
    [
        ((0, NAMES, [0.0, 0.0], [], []), "no stamp"),
        ((STAMP, NAMES, [], [], []), "no positions"),
        ((STAMP, NAMES, [], [1.0, 1.0], []), "no positions"),
        ((STAMP, (), [], [], []), "missing joints"),
        ((STAMP, NAMES, [0.0, 0.0, 0.0], [], []), "malformed"),
        ((STAMP, NAMES, [0.0, 0.0], [0.0], []), "malformed"),
        ((STAMP, ("elbow", "elbow"), [0.0, 0.0], [], []), "malformed"),
        ((STAMP, NAMES, [0.0, float("nan")], [], []), "bad numbers"),
        ((STAMP, NAMES, [0.0, float("inf")], [], []), "bad numbers"),
    ],
)
def test_unusable_joint_states_are_counted_by_reason(sessions, joint_state, reason: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        publish_description(writer)
        driver = publish_known_joints(writer, listener)
        stamp, names, *blocks = joint_state
        driver.put(rosbags_joint_state(stamp, "", names, *blocks))
        driver.joints(STAMP + 1, NAMES, [0.5, 0.25])
        until(lambda: listener.stats.received == 1)
        assert listener.stats.refused == {reason: 1}


GOOD = rosbags_joint_state(STAMP, "", NAMES, [0.5, 0.25], [], [])
LABELLED = b"\x0fsequence_number" + bytes(8) + b"\x10source_timestamp" + bytes(8)


@pytest.mark.parametrize(
    ("payload", "raw_attachment", "reason"),
    [
        (GOOD[:-1], "next", "truncated"),
        (GOOD[:30], "next", "truncated"),
        (b"", "next", "truncated"),
        (b"\x00\x03" + GOOD[2:], "next", "malformed"),
        (b"\xff" * 60, "next", "malformed"),
        (GOOD, None, "no attachment"),
        (GOOD, LABELLED, "foreign"),
        (GOOD, bytes(33), "foreign"),
        (GOOD, b"x", "foreign"),
    ],
    ids=range(9),
)
def test_invalid_ros_messages_are_counted_by_reason_on_every_topic(sessions, payload, raw_attachment, reason):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        node = RosNode(writer, "strange")
        driver = node.publisher(JOINT_STATES).announce().wait_for_reader()
        driver.put(payload, raw_attachment)
        until(lambda: listener.stats.refused == {reason: 1})
        for topic in (TF_STATIC, DESCRIPTION):
            node.publisher(topic).announce().wait_for_reader().put(payload, raw_attachment)
        until(lambda: sum(listener.stats.refused.values()) == 3)
        publish_description(writer)
        publish_known_joints(writer, listener).joints(STAMP + 1, NAMES, [0.5, 0.25])
        until(lambda: listener.stats.received == 1)
        assert listener.stats.missed == 0


def test_gaps_in_attachment_numbers_count_as_missed(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        one, other = (RosNode(writer, name).publisher(TF).announce().wait_for_reader() for name in "ab")
        for node, child in ((one, "x"), (other, "y")):
            for seq in (5, 6, 9):
                payload = rosbags_tf_message([STAMP + seq], [("base", child)], [moved(1.0)])
                node.put(payload, attachment(seq, node.gid))
        until(lambda: listener.stats.received == 6)
        assert (listener.stats.missed, listener.stats.dropped) == (4, 0)


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_restarted_bag_starts_a_new_epoch(sessions, follow: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow=follow) as listener:
        publish_description(writer)
        node = RosNode(writer, "player")
        topic = JOINT_STATES if follow == "joint_states" else TF
        player = node.publisher(topic).announce().wait_for_reader()
        until(lambda: follow == "tf" or "r1/tool" in {frame.name for frame in listener.buffer.frames()})

        def play(first: float) -> None:
            for number in range(20):
                stamp = STAMP + number * SECOND
                if follow == "tf":
                    player.edge(stamp, "upper", "lower", first + number)
                else:
                    player.joints(stamp, NAMES, [0.0, first + 0.01 * number])

        play(0.0)
        until(lambda: listener.stats.received == 20)
        play(0.5)
        until(lambda: listener.stats.received == 39)
        assert (listener.stats.late, listener.stats.refused, listener.stats.missed) == (1, {}, 0)
        assert listener.buffer.latest("upper", "lower") == STAMP + 19 * SECOND
        assert listener.buffer.can_lookup("upper", "lower", STAMP + 19 * SECOND - 10 * SECOND)


@pytest.mark.parametrize("behind", [3 * SECOND, 30 * SECOND, -SECOND])
@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_restarted_node_starts_a_new_epoch_on_any_clock(sessions, follow, behind: int):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow=follow) as listener:
        publish_description(writer)
        topic = JOINT_STATES if follow == "joint_states" else TF

        def live(first: int, angle: float, count: int) -> RosPublisher:
            node = RosNode(writer, "arm").publisher(topic).announce().wait_for_reader()
            until(lambda: follow == "tf" or "r1/tool" in {frame.name for frame in listener.buffer.frames()})
            before = listener.stats.received
            for number in range(5):
                if follow == "tf":
                    node.edge(first + number, "upper", "lower", angle)
                else:
                    node.joints(first + number, NAMES, [0.0, angle])
            until(lambda: listener.stats.received == before + count)
            return node

        live(STAMP, 1.0, 5).close()
        until(lambda: ("left", follow) in {(event.kind, event.stream) for event in listener.events()})
        live(STAMP - behind, 0.5, 5)
        assert listener.buffer.latest("upper", "lower") == STAMP - behind + 4
        assert not listener.buffer.can_lookup("upper", "lower", STAMP)
        assert listener.stats.refused == {}


MOVING = [(joint.parent, joint.child) for joint in RRBOT.joints if joint.type != "fixed"]


def x_moved(*places: float) -> list[tuple[float, ...]]:
    return [moved(x) for x in places]


def test_other_edges_of_tf_are_received_beside_joint_states(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        publish_description(writer)
        driver = publish_known_joints(writer, listener)
        ekf = RosNode(writer, "ekf").publisher(TF).announce().wait_for_reader()
        amcl, tags = (RosNode(writer, name).publisher(TF).announce() for name in ("amcl", "apriltag"))
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        ekf.edge(STAMP, "odom", "world", 2.0)
        amcl.edge(STAMP, "map", "odom", 30.0)
        tags.edge(STAMP, "tool", "tag_5", 0.5)
        until(lambda: x_of(listener, "tool", "tag_5", STAMP) == 0.5)
        found = listener.buffer.wait("map", "tool", STAMP, timeout_s=DEADLINE_S)
        in_world = listener.buffer.lookup("world", "tool", STAMP)
        assert_pose(in_world, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        assert found.translation - in_world.translation == pytest.approx([32.0, 0.0, 0.0])
        # A name that arrives after the sample is that of the next one.
        until(lambda: ekf.edge(STAMP + 1, "odom", "world", 2.0) or writers(listener)["world"] == "/ekf")
        assert listener.stats.refused == {}


def test_tf_of_a_state_publisher_is_not_read(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1", "ros2") as publisher,
        TransformListener(reader, "r1", wire="ros2") as listener,
    ):
        until(lambda: publisher.publish([0.5, 0.25]) or listener.buffer.can_lookup("world", "tool"))
        # Until all tokens of the publisher have arrived, the listener may subscribe to /tf for a moment.
        tf = "ros2", "tf"
        before = publisher.stats.streams[tf].suppressed
        until(lambda: publisher.publish([0.5, 0.25]) or publisher.stats.streams[tf].suppressed > before)
        ekf = RosNode(writer, "ekf").publisher(TF).announce().wait_for_reader()
        until(lambda: ekf.edge(STAMP, "odom", "world", 2.0) or x_of(listener, "odom", "world", STAMP) == 2.0)


@pytest.mark.parametrize("is_described_first", [True, False])
def test_edges_of_the_model_on_tf_change_nothing(sessions, is_described_first: bool):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        simulator = RosNode(writer, "simulator").publisher(TF).announce().wait_for_reader()
        if not is_described_first:
            simulator.transforms(STAMP, MOVING, x_moved(7.0, 8.0))
            until(lambda: x_of(listener, *MOVING[0]) == 7.0)
        publish_description(writer)
        driver = publish_known_joints(writer, listener)
        for later in range(5):
            # In one message with an edge that only this writer has, as simulators publish them.
            edges = [("odom", "world"), *MOVING]
            simulator.transforms(STAMP + later, edges, x_moved(float(later), 7.0, 8.0))
            simulator.transforms(STAMP + later, MOVING, x_moved(7.0, 8.0))
            driver.joints(STAMP + later, NAMES, [0.5, 0.25])
        until(lambda: listener.buffer.can_lookup("odom", "tool", STAMP + 4))
        assert x_of(listener, "odom", "world", STAMP + 3) == 3.0
        pose = listener.buffer.lookup("world", "tool", STAMP + 4)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        kinds = {frame.name: frame.kind for frame in listener.buffer.frames()}
        assert {kinds[f"r1/{child}"] for _, child in MOVING} == {"joint"}
        # Of both writers five samples with something new, and the one before the description.
        until(lambda: listener.stats.received == (10 if is_described_first else 11))
        assert (listener.stats.refused, listener.stats.missed) == ({}, 0)


def test_another_parent_of_a_link_of_the_model_is_refused_by_name(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        publish_description(writer)
        publish_known_joints(writer, listener)
        RosNode(writer, "ekf").publisher(TF).announce().wait_for_reader().edge(STAMP, "odom", "lower", 1.0)
        until(lambda: listener.stats.refused == {"second parent": 1})
        assert "'r1/odom'" in listener.refusals["second parent"]


def test_transforms_of_a_robot_without_a_description_are_received(sessions):
    writer, reader = sessions
    with TransformListener(reader, "cell", wire="ros2") as listener:
        tracker = RosNode(writer, "tracker").publisher(TF).announce().wait_for_reader()
        tracker.edge(STAMP, "cell_origin", "ball", 2.0)
        until(lambda: x_of(listener, "cell_origin", "ball") == 2.0)
        assert listener.robots() == ("cell",)


def test_namespace_and_root_are_subscribed_separately(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1", wire="ros2:namespace=r1") as listener,
        TransformListener(reader, "root", wire="ros2") as root,
    ):
        node = RosNode(writer, "rsp", "/r1")
        described = node.publisher(DESCRIPTION, namespace="r1")
        described.text(RRBOT.urdf)
        driver = node.publisher(JOINT_STATES, namespace="r1").announce().wait_for_reader()
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert root.robots() == ()


def test_all_robots_in_namespaces_are_followed(sessions):
    writer, reader = sessions
    wire = "ros2:namespace=*,frame_prefix=*/"
    with TransformListener(reader, wire=wire) as listener:
        publishers = [StatePublisher(writer, RRBOT, robot, (wire,)) for robot in ("r1", "r2")]
        for number, publisher in enumerate(publishers):
            wait_for_reader(writer, f"0/{publisher.robot}/joint_states/{JOINT_STATES[1]}/{JOINT_STATES[2]}")
            publisher.publish([0.1, 0.5 + number], stamp=STAMP)
        for number, publisher in enumerate(publishers):
            pose = listener.buffer.wait(
                f"{publisher.robot}/upper", f"{publisher.robot}/lower", timeout_s=DEADLINE_S
            )
            expected = kinematic_pose(RRBOT, [0.1, 0.5 + number], "upper", "lower")
            assert_pose(pose, expected)
            publisher.close()
        assert {"r1", "r2"} <= set(listener.robots())
        assert listener.stats.refused == {}
