from __future__ import annotations

import json

from helpers.cli_runner import published_robot, run_cli

from zstate import connect
from zstate.wire.ros2.graph import EndpointToken, NodeToken
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.types import STRING, TF_MESSAGE


def test_each_topic_is_listed_with_its_publishers_and_their_qos(ros_router: str):
    with published_robot(wire="ros2:node=driver", router=ros_router):
        lines = run_cli("ls").stdout.splitlines()
    assert lines[:2] == ["1 node in domain 0", "  /driver"]
    assert lines[lines.index("/joint_states  sensor_msgs/msg/JointState") + 1].split(None, 2) == [
        "publisher",
        "/driver",
        "reliable, volatile, keep last 10",
    ]
    assert lines[lines.index("/tf_static  tf2_msgs/msg/TFMessage") + 1].split(None, 2) == [
        "publisher",
        "/driver",
        "reliable, transient local, keep last 1",
    ]


def test_subscribers_and_nodes_of_others_are_listed_too(ros_router: str):
    qos = Qos("best_effort", "volatile", "keep_all", 0)
    with connect(mode="client", endpoints=ros_router) as session:
        node = NodeToken(0, session.zid, 0, "/", "/cell", "rviz")
        ends = [
            EndpointToken(node, 1, "MS", topic, kind.dds, kind.hash, qos)
            for topic, kind in (("/tf", TF_MESSAGE), ("/chatter", STRING))
        ]
        liveliness = session.zenoh.liveliness()
        tokens = [liveliness.declare_token(token.key) for token in (node, *ends)]
        graph = json.loads(run_cli("ls", "--json").stdout)
        del tokens
    assert [node["node"] for node in graph["nodes"]] == ["/cell/rviz"]
    # Of topics those that carry the state of a robot; a chatter does not.
    (topic,) = graph["topics"]
    assert (topic["topic"], topic["publishers"]) == ("/tf", [])
    (subscriber,) = topic["subscribers"]
    assert subscriber["node"] == "/cell/rviz"
    assert (subscriber["reliability"], subscriber["history"]) == ("best_effort", "keep_all")


def test_robots_in_namespaces_are_listed_with_the_option_that_selects_them(ros_router: str):
    with published_robot("r1", wire="ros2:namespace=*,hash=humble", router=ros_router):
        ended = run_cli("ls")
        called = run_cli("ls", "--wire", "ros2:namespace=r1")
    assert "/r1/joint_states" in ended.stdout
    assert "humble" in ended.stdout
    assert "in namespaces: r1; to use one of them: `--wire ros2:namespace=r1`" in ended.stderr
    assert "in namespaces" not in called.stderr


def test_topics_behind_a_bridge_of_ros2dds_are_listed(ros_router: str):
    with published_robot(wire="ros2dds", router=ros_router):
        graph = json.loads(run_cli("ls", "--wire", "ros2dds", "--json").stdout)
    assert graph["nodes"] == []
    assert {topic["topic"] for topic in graph["topics"]} == {
        "/joint_states",
        "/robot_description",
        "/tf",
        "/tf_static",
    }


def test_empty_network_is_no_error(ros_router: str):
    ended = run_cli("ls", "--wire", "ros2:domain=7")
    assert (ended.code, ended.stdout) == (0, "")
    assert "no ROS 2 node in domain 7" in ended.stderr
