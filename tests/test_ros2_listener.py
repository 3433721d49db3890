"""A listener on the ros2 wire among nodes made of bare Zenoh and rosbags."""

from __future__ import annotations

import pytest
from live import RRBOT, STAMP, assert_pose, await_reader, kinematic_pose
from support import until
from wire.ros2.by_hand import rosbags_joint_state, rosbags_tf_message
from wire.ros2.raw_nodes import (
    DESCRIPTION,
    HUMBLE,
    JOINT_STATES,
    TF,
    TF_STATIC,
    RosNode,
    RosPublisher,
    attachment,
    moved,
    tokens,
)

from zstate.listener import TransformListener
from zstate.net.session import Session
from zstate.publisher import StatePublisher

SECOND = 10**9
NAMES = RRBOT.joint_names
FIXED = {(joint.parent, joint.child): joint.origin for joint in RRBOT.joints if joint.type == "fixed"}


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def writers(listener: TransformListener) -> dict[str, str | None]:
    """Who places each frame, by its bare name."""
    frames = [frame for frame in listener.buffer.frames() if frame.parent is not None]
    return {frame.name.partition("/")[2]: frame.writer for frame in frames}


def x_of(listener: TransformListener, target: str, source: str, at: int | None = None) -> float | None:
    reason = listener.buffer.explain(target, source, at)
    return None if reason is not None else listener.buffer.lookup(target, source, at).translation[0]


def described(session: Session, text: str = RRBOT.urdf) -> RosPublisher:
    publisher = RosNode(session, "robot_state_publisher").publisher(DESCRIPTION).announce()
    publisher.text(text)
    return publisher


def following_joints(session: Session, listener: TransformListener, name: str = "driver") -> RosPublisher:
    """A node that writes joint states of a robot that the listener knows."""
    driver = RosNode(session, name).publisher(JOINT_STATES).announce().await_reader()
    until(lambda: "r1/tool" in {frame.name for frame in listener.buffer.frames()})
    return driver


def test_several_writers_of_transforms_make_one_tree_and_do_not_fight(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        arm = RosNode(writer, "robot_state_publisher").publisher(TF).announce().await_reader()
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


def test_a_message_may_have_transforms_of_several_instants(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        bag = RosNode(writer, "player").publisher(TF).announce().await_reader()
        edges = [("odom", "base"), ("base", "tool"), ("odom", "other")]
        for later in (0, 10):
            stamps = [STAMP + later + 1, STAMP + later, STAMP + later + 1]
            bag.put(rosbags_tf_message(stamps, edges, [moved(1.0), moved(2.0), moved(3.0)]))
        until(lambda: listener.stats.received == 4)
        assert [x_of(listener, *edge, STAMP + 10) for edge in edges] == [1.0, 2.0, 3.0]
        assert listener.buffer.latest("odom", "base") == STAMP + 11
        assert listener.buffer.latest("base", "tool") == STAMP + 10
        assert (listener.stats.refused, listener.stats.missed) == ({}, 0)


def test_static_edges_of_several_writers_add_up_and_nothing_is_withdrawn(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        mount, room = (RosNode(writer, name).publisher(TF_STATIC).announce() for name in ("mount", "room"))
        mount.edge(0, "tool", "camera", 1.0)
        mount.edge(0, "tool", "laser", 2.0)
        room.edge(0, "map", "tool", 4.0)
        assert listener.buffer.wait("map", "laser", timeout_s=5.0).translation[0] == 6.0
        assert x_of(listener, "map", "camera") == 5.0
        until(lambda: writers(listener) == {"camera": "/mount", "laser": "/mount", "tool": "/room"})
        mount.edge(0, "base", "camera", 8.0)
        assert listener.buffer.wait("base", "camera", timeout_s=5.0).translation[0] == 8.0
        mount.leave()
        room.edge(0, "map", "tool", 5.0)
        until(lambda: x_of(listener, "map", "laser") == 7.0)
        assert listener.stats.refused == {}


def test_a_static_writer_that_starts_again_may_place_its_child_elsewhere(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        old = RosNode(writer, "mount").publisher(TF_STATIC).announce()
        old.edge(0, "tool", "camera", 1.0)
        until(lambda: writers(listener) == {"camera": "/mount"})
        rival = RosNode(writer, "rival").publisher(TF_STATIC).announce()
        rival.edge(0, "base", "camera", 5.0)
        until(lambda: listener.stats.refused == {"second parent": 1})
        assert x_of(listener, "tool", "camera") == 1.0
        old.leave()
        until(lambda: rival.edge(0, "base", "camera", 5.0) or x_of(listener, "base", "camera") == 5.0)
        assert writers(listener) == {"camera": "/rival"}
        assert x_of(listener, "tool", "camera") is None


def test_late_listeners_get_the_last_words_of_every_static_writer(sessions):
    writer, reader = sessions
    nodes = [RosNode(writer, f"static_{number}").publisher(TF_STATIC).announce() for number in range(5)]
    humble = RosNode(writer, "old").publisher(TF_STATIC, HUMBLE).announce()
    for number, node in enumerate(nodes):
        node.edge(0, "map", f"frame_{number}", float(number))
    humble.edge(0, "map", "humble", 9.0)
    with TransformListener(reader, "r1", wire="ros2") as listener:
        for number in range(5):
            pose = listener.buffer.wait("map", f"frame_{number}", timeout_s=5.0)
            assert pose.translation[0] == float(number)
        assert listener.buffer.wait("map", "humble", timeout_s=5.0).translation[0] == 9.0


def test_of_two_writers_of_one_static_edge_the_newest_word_counts(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        one, other = (RosNode(writer, name).publisher(TF_STATIC) for name in ("one", "other"))
        for number, node in enumerate((one, other, one, other)):
            node.edge(0, "tool", "camera", float(number))
            until(lambda number=number: x_of(listener, "tool", "camera") == float(number))
        # Their names come later, and leave what was said last.
        one.announce()
        other.announce()
        until(lambda: writers(listener)["camera"] == "/other")
        assert x_of(listener, "tool", "camera") == 3.0
        assert listener.stats.refused == {}


@pytest.mark.parametrize("order", ["statics first", "model first", "together"])
def test_the_models_own_fixed_edges_are_no_second_writer_whenever_they_come(sessions, order: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        statics = RosNode(writer, "robot_state_publisher").publisher(TF_STATIC).announce()
        if order == "model first":
            described(writer)
            listener.buffer.wait("lower", "tool", timeout_s=5.0)
        statics.transforms(0, [*FIXED, ("tool", "camera")], [*FIXED.values(), moved(0.5)])
        if order == "statics first":
            listener.buffer.wait("tool", "camera", timeout_s=5.0)
        if order != "model first":
            described(writer)
        driver = following_joints(writer, listener)
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        pose = listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        assert listener.buffer.wait("tool", "camera", timeout_s=5.0).translation[0] == 0.5
        statics.transforms(0, [*FIXED, ("tool", "mark")], [*FIXED.values(), moved(1.5)])
        listener.buffer.wait("tool", "mark", timeout_s=5.0)
        assert listener.stats.refused == {}


@pytest.mark.parametrize("model_first", [True, False])
def test_a_static_edge_that_contradicts_the_model_is_counted_in_either_order(sessions, model_first: bool):
    writer, reader = sessions
    (edge, *_) = FIXED
    with TransformListener(reader, "r1", wire="ros2") as listener:
        statics = RosNode(writer, "wrong").publisher(TF_STATIC).announce()
        if model_first:
            described(writer)
            listener.buffer.wait(*edge, timeout_s=5.0)
        statics.edge(0, *edge, 9.0)
        if not model_first:
            until(lambda: x_of(listener, *edge) == 9.0)
            described(writer)
        until(lambda: listener.stats.refused == {"second writer": 1})
        until(lambda: x_of(listener, *edge) not in (9.0, None))
        assert_pose(listener.buffer.lookup(*edge), kinematic_pose(RRBOT, [0, 0], *edge))


def test_writers_are_named_by_their_nodes_also_when_they_are_announced_late(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        node = RosNode(writer, "arm", "/fleet/r1")
        moving, fixed = node.publisher(TF).await_reader(), node.publisher(TF_STATIC)
        moving.edge(STAMP, "base", "tool", 1.0)
        fixed.edge(0, "tool", "camera", 2.0)
        listener.buffer.wait("base", "camera", timeout_s=5.0)
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
def test_writers_of_every_distribution_are_heard(sessions, written: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        RosNode(writer, "rsp").publisher(DESCRIPTION, written).text(RRBOT.urdf)
        driver = RosNode(writer, "driver").publisher(JOINT_STATES, written).announce().await_reader()
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        pose = listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        until(lambda: writers(listener)["lower"] == "/driver")


def test_joints_are_found_by_name_in_any_order_and_among_others(sessions):
    writer, reader = sessions
    nan = float("nan")
    with TransformListener(reader, "r1", wire="ros2") as listener:
        described(writer)
        driver = following_joints(writer, listener)
        driver.joints(STAMP, ("lid", "elbow", "shoulder"), [7.0, 0.25, 0.5], [0.0, 2.0, 1.0], [nan] * 3)
        pose = listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        driver.joints(STAMP + SECOND // 100, ("elbow", "shoulder"), [0.27, 0.51], [2.0, 1.0])
        until(lambda: listener.stats.received == 2)
        ahead = STAMP + SECOND // 100 + SECOND // 1000
        predicted = listener.buffer.lookup("world", "tool", ahead, predict_s=0.01)
        assert predicted.kind == "predicted"
        assert_pose(predicted, kinematic_pose(RRBOT, [0.511, 0.272], "world", "tool"))
        assert listener.stats.refused == {}


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ((0, NAMES, [0.0, 0.0], [], []), "no stamp"),
        ((STAMP, NAMES, [], [], []), "no positions"),
        ((STAMP, NAMES, [], [1.0, 1.0], []), "no positions"),
        ((STAMP, (), [], [], []), "missing joints"),
        ((STAMP, ("shoulder",), [0.0], [], []), "missing joints"),
        ((STAMP, NAMES, [0.0, 0.0, 0.0], [], []), "malformed"),
        ((STAMP, NAMES, [0.0, 0.0], [0.0], []), "malformed"),
        ((STAMP, ("elbow", "elbow"), [0.0, 0.0], [], []), "malformed"),
        ((STAMP, NAMES, [0.0, float("nan")], [], []), "bad numbers"),
        ((STAMP, NAMES, [0.0, float("inf")], [], []), "bad numbers"),
    ],
)
def test_joint_states_that_cannot_be_used_are_counted_by_reason(sessions, said, reason: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        described(writer)
        driver = following_joints(writer, listener)
        stamp, names, *blocks = said
        driver.put(rosbags_joint_state(stamp, "", names, *blocks))
        driver.joints(STAMP + 1, NAMES, [0.5, 0.25])
        until(lambda: listener.stats.received == 1)
        assert listener.stats.refused == {reason: 1}


GOOD = rosbags_joint_state(STAMP, "", NAMES, [0.5, 0.25], [], [])
LABELLED = b"\x0fsequence_number" + bytes(8) + b"\x10source_timestamp" + bytes(8)


@pytest.mark.parametrize(
    ("payload", "beside", "reason"),
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
def test_what_is_no_message_of_ros_is_counted_by_reason_on_every_topic(sessions, payload, beside, reason):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        node = RosNode(writer, "strange")
        driver = node.publisher(JOINT_STATES).announce().await_reader()
        driver.put(payload, beside)
        until(lambda: listener.stats.refused == {reason: 1})
        for topic in (TF_STATIC, DESCRIPTION):
            node.publisher(topic).announce().await_reader().put(payload, beside)
        until(lambda: sum(listener.stats.refused.values()) == 3)
        described(writer)
        following_joints(writer, listener).joints(STAMP + 1, NAMES, [0.5, 0.25])
        until(lambda: listener.stats.received == 1)
        assert listener.stats.missed == 0


def test_gaps_in_the_numbers_beside_messages_are_missed(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        one, other = (RosNode(writer, name).publisher(TF).announce().await_reader() for name in "ab")
        for node, child in ((one, "x"), (other, "y")):
            for seq in (5, 6, 9):
                payload = rosbags_tf_message([STAMP + seq], [("base", child)], [moved(1.0)])
                node.put(payload, attachment(seq, node.gid))
        until(lambda: listener.stats.received == 6)
        assert (listener.stats.missed, listener.stats.dropped) == (4, 0)


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_a_bag_that_begins_again_is_a_new_epoch(sessions, follow: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow=follow) as listener:
        described(writer)
        node = RosNode(writer, "player")
        topic = JOINT_STATES if follow == "joint_states" else TF
        player = node.publisher(topic).announce().await_reader()
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
def test_a_node_that_starts_again_begins_a_new_epoch_wherever_its_clock_stands(sessions, follow, behind: int):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow=follow) as listener:
        described(writer)
        topic = JOINT_STATES if follow == "joint_states" else TF

        def live(first: int, angle: float, count: int) -> RosPublisher:
            node = RosNode(writer, "arm").publisher(topic).announce().await_reader()
            until(lambda: follow == "tf" or "r1/tool" in {frame.name for frame in listener.buffer.frames()})
            before = listener.stats.received
            for number in range(5):
                if follow == "tf":
                    node.edge(first + number, "upper", "lower", angle)
                else:
                    node.joints(first + number, NAMES, [0.0, angle])
            until(lambda: listener.stats.received == before + count)
            return node

        live(STAMP, 1.0, 5).leave()
        until(lambda: not any("/arm/" in token for token in tokens(reader) if topic[1] in token))
        live(STAMP - behind, 0.5, 5)
        assert listener.buffer.latest("upper", "lower") == STAMP - behind + 4
        assert not listener.buffer.can_lookup("upper", "lower", STAMP)
        assert listener.stats.refused == {}


def test_a_namespace_is_heard_alone_and_the_root_alone(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1", wire="ros2:namespace=r1") as listener,
        TransformListener(reader, "root", wire="ros2") as root,
    ):
        node = RosNode(writer, "rsp", "/r1")
        node.publisher(DESCRIPTION, namespace="r1").text(RRBOT.urdf)
        driver = node.publisher(JOINT_STATES, namespace="r1").announce().await_reader()
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert root.robots() == ()


def test_all_robots_that_stand_in_namespaces_of_their_own_are_followed(sessions):
    writer, reader = sessions
    wire = "ros2:namespace=*,frame_prefix=*/"
    with TransformListener(reader, wire=wire) as listener:
        publishers = [StatePublisher(writer, RRBOT, robot, (wire,)) for robot in ("r1", "r2")]
        for number, publisher in enumerate(publishers):
            await_reader(writer, f"0/{publisher.robot}/joint_states/{JOINT_STATES[1]}/{JOINT_STATES[2]}")
            publisher.publish([0.1, 0.5 + number], stamp=STAMP)
        for number, publisher in enumerate(publishers):
            pose = listener.buffer.wait(f"{publisher.robot}/upper", f"{publisher.robot}/lower", timeout_s=5.0)
            expected = kinematic_pose(RRBOT, [0.1, 0.5 + number], "upper", "lower")
            assert_pose(pose, expected)
            publisher.close()
        assert {"r1", "r2"} <= set(listener.robots())
        assert listener.stats.refused == {}
