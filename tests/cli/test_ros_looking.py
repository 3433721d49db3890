from __future__ import annotations

import json
import math

import pytest
from helpers.cli_runner import ELBOW, SHOULDER, Command, failure, published_robot, run_cli, run_watched
from helpers.processes import until
from helpers.robots import wait_for_reader

from zstate import StaticPublisher, Transform, connect
from zstate.wire.identity import WriterId
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.protocol import GraphNode
from zstate.wire.ros2.wire import Ros2Wire

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# From the model: see tests/cli/commands/test_tf.py.
BASE_FROM_LOWER = (0.7 * math.sin(SHOULDER), 0.1 + 0.07, 1.05 + 0.7 * math.cos(SHOULDER))


def test_tf_needs_no_model_and_calls_frames_as_ros_does(ros_router: str):
    with published_robot(wire="ros2", router=ros_router, streams=("tf", "tf_static")):
        answer = json.loads(run_cli("tf", "base", "lower", "--once", "--json").stdout)
    assert (answer["target"], answer["source"]) == ("base", "lower")
    assert answer["translation"] == pytest.approx(BASE_FROM_LOWER, abs=1e-12)


def test_tf_reports_missing_topics_in_ros_terms(ros_router: str):
    def watch(command: Command) -> None:
        until(lambda: "waiting: no node publishes /tf in domain 0" in command.stderr)
        assert "`zstate ls --wire ros2`" in command.stderr
        with published_robot(wire="ros2", router=ros_router):
            assert command.line() == "pose of lower in base"
            assert command.line().startswith("At time ")
            until(lambda: "receiving /tf: " in command.stderr)
        until(lambda: "no new sample of 'base' -> 'upper'" in command.stderr)

    ended = run_watched(watch, "tf", "base", "lower", "--rate", "20")
    for unknown_to_ros in ("zstate joints", "zstate publish", "ros/"):
        assert unknown_to_ros not in ended.stderr


def test_tf_between_two_trees_names_the_command_that_joins_them(ros_router: str):
    with (
        published_robot(wire="ros2", router=ros_router),
        connect(mode="client", endpoints=ros_router) as session,
        StaticPublisher(session, "ros", wires="ros2") as statics,
    ):
        statics.set(Transform("map", "shelf", (0.0, 0.0, 1.0), UPRIGHT))
        message = failure("tf", "shelf", "lower", "--once", "--timeout", "1")
    assert "`zstate static --wire ros2 map world --xyz ...`" in message


def test_tree_shows_frames_by_their_ros_names_with_the_nodes_that_write_them(ros_router: str):
    wire = "ros2:namespace=r1,frame_prefix=r1/,node=driver"
    with published_robot("r1", wire=wire, router=ros_router):
        lines = run_cli("tree").stdout.splitlines()
    assert lines[1].split() == ["r1/world", "root"]
    (upper,) = (line for line in lines if "r1/upper" in line)
    assert "pose" in upper
    assert "Hz" in upper
    assert upper.endswith("/r1/driver")
    (tool,) = (line for line in lines if "r1/tool" in line)
    assert tool.split()[-2:] == ["static", "/r1/driver"]


def test_tree_names_a_node_that_sends_nothing(ros_router: str):
    with (
        published_robot(wire="ros2", router=ros_router, streams=("tf_static",)),
        connect(mode="client", endpoints=ros_router) as session,
    ):
        token = "@ros2_lv/0/{zid}/7/8/MP/%/%/mute/%tf/tf2_msgs::msg::dds_::TFMessage_/{hash}/::,100:,:,:,,"
        with session.zenoh.liveliness().declare_token(token.format(zid=session.zid, hash="RIHS01_0")):
            ended = run_cli("tree")
    assert "/mute announces ROS 2 topic /tf (domain 0), but has sent nothing" in ended.stderr
    assert "tool" in ended.stdout


def test_tree_without_robots_is_a_failure(ros_router: str):
    assert "no node publishes /tf in domain 5" in failure("tree", "--wire", "ros2:domain=5")


def test_echo_needs_no_robot_and_no_description(ros_router: str):
    with published_robot(wire="ros2", router=ros_router, streams=("joint_states",)):
        document = json.loads(run_cli("echo", "--once", "--json").stdout)
    assert document["positions"] == {"shoulder": SHOULDER, "elbow": ELBOW}


def test_unmeasured_values_are_null_in_json(ros_router: str):
    unmeasured = JointState(
        5, 0, 1, order_digest(("a",)), to_block([0.5]), None, to_block([math.nan]), ("a",)
    )

    def send(command: Command) -> None:
        with connect(mode="client", endpoints=ros_router) as session:
            node = GraphNode("r", WriterId("driver", "", 0, 0, 1), session.zid, 0)
            encoder = Ros2Wire().stream_encoder(node, "joint_states", number=1)
            wait_for_reader(session, encoder.key)
            session.zenoh.put(encoder.key, encoder.encode(unmeasured), attachment=encoder.attachment(5))
            command.line()

    (line,) = run_watched(send, "echo", "--json").stdout.splitlines()
    document = json.loads(line, parse_constant=pytest.fail)
    assert document["positions"] == {"a": 0.5}
    assert document["efforts"] == {"a": None}


def test_echo_reads_one_namespace_or_the_selected_robot(ros_router: str):
    with (
        published_robot("r1", wire="ros2:namespace=*", router=ros_router),
        published_robot("r2", (0.0, 0.25), wire="ros2:namespace=*", router=ros_router),
    ):
        first = run_cli("echo", "--wire", "ros2:namespace=r1", "--once", "--field", "elbow")
        second = run_cli("echo", "r2", "--wire", "ros2:namespace=*", "--once", "--field", "elbow")
    assert float(first.stdout) == ELBOW
    assert float(second.stdout) == 0.25


def test_missing_robot_argument_is_reported(ros_router: str):
    assert "no robot is announced" in failure("echo", "--wire", "native")
    message = failure("hz", "--wire", "ros2:namespace=*", code=2)
    assert "each robot has a namespace of its name" in message


def test_hz_measures_all_nodes_of_a_topic_together(ros_router: str):
    with published_robot(wire="ros2", router=ros_router), published_robot(wire="ros2", router=ros_router):
        for stream in ("tf", "joint_states"):
            measured = json.loads(run_cli("hz", "--stream", stream, "--once", "--json").stdout)
            # Two writers wait a hundredth of a second between samples; they may be slower, never faster.
            assert 20.0 < measured["rate_hz"] < 220.0
            assert measured["window"] > 20
            assert measured["missed"] == 0


def test_robots_are_monitored_by_tf_and_a_selected_one_by_its_joints(ros_router: str):
    def watch(command: Command) -> None:
        until(lambda: json.loads(command.line())["received"] > 0)

    monitor = ("monitor", "--robots", "--json")
    with published_robot(wire="ros2", router=ros_router):
        everybody = run_watched(watch, *monitor)
        one = run_watched(watch, *monitor, "--robot", "rrbot")
    assert "following ROS 2 topic /tf (domain 0)" in everybody.stderr
    assert "following ROS 2 topic /joint_states (domain 0)" in one.stderr


def test_invalid_wire_is_wrong_usage_with_the_reason():
    message = failure("tf", "a", "b", "--wire", "ros2:domian=5", code=2)
    assert "no option 'domian'; did you mean 'domain'?" in message
    assert "'native'" in failure("ls", "--wire", "ros3", code=2)


DEFAULT_ROUTER = "zstate.net.config.ROUTER_ENDPOINT"
"""Its port 7447 of the test machine may be in use."""


def test_ros_commands_join_the_router_of_this_host(ros_router: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ZSTATE_CONNECT")
    monkeypatch.setattr(DEFAULT_ROUTER, ros_router)
    with published_robot(wire="ros2:node=driver", router=ros_router):
        listed = run_cli("ls").stdout
    assert listed.startswith("1 node in domain 0\n  /driver\n")


def test_missing_router_is_reported_with_the_commands_that_start_one(
    free_port: int, monkeypatch: pytest.MonkeyPatch
):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    monkeypatch.setattr(DEFAULT_ROUTER, endpoint)
    message = failure("ls", "--wire", "ros2")
    assert message.startswith(f"zstate: nothing answers at {endpoint!r}")
    for advice in ("ros2 run rmw_zenoh_cpp rmw_zenohd", "zstate router --ros2", "--connect"):
        assert advice in message
