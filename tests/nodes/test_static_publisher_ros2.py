"""The static edges of ROS nodes, in a listener."""

from __future__ import annotations

import pytest
from helpers.processes import DEADLINE_S, until
from helpers.raw_ros_nodes import (
    HUMBLE,
    TF_STATIC,
    RosNode,
    moved,
)
from helpers.robots import RRBOT, STAMP, assert_pose, kinematic_pose
from helpers.ros_subscriber import publish_description, publish_known_joints, writers, x_of

from zstate.nodes.listener import TransformListener

NAMES = RRBOT.joint_names
FIXED = {(joint.parent, joint.child): joint.origin for joint in RRBOT.joints if joint.type == "fixed"}


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def test_ros_static_edges_of_several_writers_accumulate_and_none_is_withdrawn(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2", follow="tf") as listener:
        mount, room = (
            RosNode(writer, name).publisher(TF_STATIC).announce().wait_for_reader()
            for name in ("mount", "room")
        )
        mount.edge(0, "tool", "camera", 1.0)
        mount.edge(0, "tool", "laser", 2.0)
        room.edge(0, "map", "tool", 4.0)
        assert listener.buffer.wait("map", "laser", timeout_s=DEADLINE_S).translation[0] == 6.0
        until(lambda: x_of(listener, "map", "camera") == 5.0)
        until(lambda: writers(listener) == {"camera": "/mount", "laser": "/mount", "tool": "/room"})
        mount.edge(0, "base", "camera", 8.0)
        assert listener.buffer.wait("base", "camera", timeout_s=DEADLINE_S).translation[0] == 8.0
        mount.close()
        room.edge(0, "map", "tool", 5.0)
        until(lambda: x_of(listener, "map", "laser") == 7.0)
        assert listener.stats.refused == {}


def test_restarted_static_writer_may_reparent_its_child(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        old = RosNode(writer, "mount").publisher(TF_STATIC).announce()
        old.edge(0, "tool", "camera", 1.0)
        until(lambda: writers(listener) == {"camera": "/mount"})
        rival = RosNode(writer, "rival").publisher(TF_STATIC).announce()
        rival.edge(0, "base", "camera", 5.0)
        until(lambda: listener.stats.refused == {"second parent": 1})
        assert x_of(listener, "tool", "camera") == 1.0
        old.close()
        until(lambda: rival.edge(0, "base", "camera", 5.0) or x_of(listener, "base", "camera") == 5.0)
        until(lambda: writers(listener) == {"camera": "/rival"})
        assert x_of(listener, "tool", "camera") is None


def test_late_listeners_get_the_last_message_of_every_static_writer(sessions):
    writer, reader = sessions
    nodes = [RosNode(writer, f"static_{number}").publisher(TF_STATIC).announce() for number in range(5)]
    humble = RosNode(writer, "old").publisher(TF_STATIC, HUMBLE).announce()
    for number, node in enumerate(nodes):
        node.edge(0, "map", f"frame_{number}", float(number))
    humble.edge(0, "map", "humble", 9.0)
    with TransformListener(reader, "r1", wire="ros2") as listener:
        for number in range(5):
            pose = listener.buffer.wait("map", f"frame_{number}", timeout_s=DEADLINE_S)
            assert pose.translation[0] == float(number)
        assert listener.buffer.wait("map", "humble", timeout_s=DEADLINE_S).translation[0] == 9.0


def test_newest_message_of_two_static_writers_is_used(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        one, other = (RosNode(writer, name).publisher(TF_STATIC) for name in ("one", "other"))
        for number, node in enumerate((one, other, one, other)):
            node.edge(0, "tool", "camera", float(number))
            until(lambda number=number: x_of(listener, "tool", "camera") == float(number))
        # Their names arrive later and leave the last values unchanged.
        one.announce()
        other.announce()
        until(lambda: writers(listener)["camera"] == "/other")
        assert x_of(listener, "tool", "camera") == 3.0
        assert listener.stats.refused == {}


@pytest.mark.parametrize("order", ["statics first", "model first", "together"])
def test_fixed_edges_of_the_model_are_no_second_writer_in_any_order(sessions, order: str):
    writer, reader = sessions
    with TransformListener(reader, "r1", wire="ros2") as listener:
        statics = RosNode(writer, "robot_state_publisher").publisher(TF_STATIC).announce()
        if order == "model first":
            publish_description(writer)
            listener.buffer.wait("lower", "tool", timeout_s=DEADLINE_S)
        statics.transforms(0, [*FIXED, ("tool", "camera")], [*FIXED.values(), moved(0.5)])
        if order == "statics first":
            listener.buffer.wait("tool", "camera", timeout_s=DEADLINE_S)
        if order != "model first":
            publish_description(writer)
        driver = publish_known_joints(writer, listener)
        driver.joints(STAMP, NAMES, [0.5, 0.25])
        pose = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert_pose(pose, kinematic_pose(RRBOT, [0.5, 0.25], "world", "tool"))
        assert listener.buffer.wait("tool", "camera", timeout_s=DEADLINE_S).translation[0] == 0.5
        statics.transforms(0, [*FIXED, ("tool", "mark")], [*FIXED.values(), moved(1.5)])
        listener.buffer.wait("tool", "mark", timeout_s=DEADLINE_S)
        assert listener.stats.refused == {}


@pytest.mark.parametrize("model_first", [True, False])
def test_static_edge_that_contradicts_the_model_is_counted_in_either_order(sessions, model_first: bool):
    writer, reader = sessions
    (edge, *_) = FIXED
    with TransformListener(reader, "r1", wire="ros2") as listener:
        statics = RosNode(writer, "wrong").publisher(TF_STATIC).announce()
        if model_first:
            publish_description(writer)
            listener.buffer.wait(*edge, timeout_s=DEADLINE_S)
        statics.edge(0, *edge, 9.0)
        if not model_first:
            until(lambda: x_of(listener, *edge) == 9.0)
            publish_description(writer)
        until(lambda: listener.stats.refused == {"second writer": 1})
        until(lambda: x_of(listener, *edge) not in (9.0, None))
        assert_pose(listener.buffer.lookup(*edge), kinematic_pose(RRBOT, [0, 0], *edge))
