"""Whoever reads on the ros2 wire is seen in the ROS graph."""

from __future__ import annotations

import sys

import pytest
from helpers.processes import until
from helpers.raw_ros_nodes import tokens

from zstate.model.load import load_model
from zstate.nodes.listener import TransformListener
from zstate.sources import JointStateListener


@pytest.fixture(autouse=True)
def program(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name of the program, of which the node's is made."""
    monkeypatch.setattr(sys, "argv", ["/home/me/arm_driver.py"])
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def test_listener_is_a_node_with_subscriptions_in_the_graph(sessions):
    writer, reader = sessions
    with TransformListener(reader, "panda", wire="ros2:namespace=r1", follow="joint_states"):
        until(lambda: len(tokens(writer)) == 5)
        chunks = sorted(one.split("/") for one in tokens(writer))
    node, *subscriptions = chunks
    assert node[5:] == ["NN", "%", "%r1", "arm_driver"]
    assert {(one[5], one[9]) for one in subscriptions} == {
        ("MS", "%r1%robot_description"),
        ("MS", "%tf_static"),
        ("MS", "%r1%joint_states"),
        ("MS", "%tf"),
    }
    assert {one[3] for one in subscriptions} == {node[3]}
    assert len({one[4] for one in chunks}) == 5
    until(lambda: not tokens(writer))


def test_native_listener_declares_no_graph_tokens(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "panda"),
        JointStateListener(reader, "r1", load_model("rrbot"), wire="ros2"),
    ):
        until(lambda: len(tokens(writer)) == 2)
        assert {one.split("/")[5] for one in tokens(writer)} == {"NN", "MS"}
