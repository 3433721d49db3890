from __future__ import annotations

import pytest
from helpers.cli_runner import ELBOW, SHOULDER, Spawn, failure, interrupted, published_robot, started

from zstate import TransformListener, connect, load_model
from zstate.model.kinematics import Kinematics

pytestmark = pytest.mark.processes
EACH = "ros2:namespace=*"


@pytest.fixture
def ros(spawn: Spawn, free_port: int) -> str:
    """The endpoint of the router on ROS's side."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--listen", endpoint).line()
    return endpoint


@pytest.mark.parametrize("given", [["rrbot"], [], ["--wire", EACH]], ids=["named", "alone", "all"])
def test_a_native_robot_is_heard_on_ros_and_both_its_coming_and_its_going_are_said(
    spawn: Spawn, ros: str, given: list[str]
):
    wire = EACH if EACH in given else "ros2"
    with (
        connect(mode="client", endpoints=ros) as session,
        TransformListener(session, "rrbot", wire=wire) as listener,
    ):
        with published_robot():
            command = started(spawn, "bridge", *given, "--ros", ros)
            assert command.line().startswith(f"bridging {'every robot' if wire == EACH else repr('rrbot')} ")
            assert command.line() == "carrying 'rrbot': native to ROS"
            tool = listener.buffer.wait("world", "tool", timeout_s=10.0)
            model = load_model("rrbot")
            poses = dict(zip(model.links, Kinematics(model).link_poses([SHOULDER, ELBOW]), strict=True))
            assert tool.translation == pytest.approx(poses["tool"][:3] - poses["world"][:3], abs=1e-12)
        assert command.line() == "'rrbot' is carried no more"
    interrupted(command)


def test_a_robot_on_ros_is_heard_natively(spawn: Spawn, ros: str):
    command = started(spawn, "bridge", "arm", "--ros", ros)
    command.line()
    client = ("--mode", "client", "--connect", ros, "--wire", "ros2")
    started(spawn, "publish", "rrbot", "--source", "sine", *client).line()
    assert command.line() == "carrying 'arm': ROS to native"
    with connect() as session, TransformListener(session, "arm") as listener:
        assert listener.buffer.wait("world", "tool", timeout_s=10.0).kind == "exact"
    interrupted(command)


def test_several_robots_do_not_share_the_root_namespace(ros: str):
    with published_robot("left"), published_robot("right"):
        said = failure("bridge", "--ros", ros)
    assert "room for one robot, not for 'left' and 'right'" in said
    assert "zstate bridge panda" in said
    assert EACH in said


def test_without_a_robot_it_says_how_to_name_one(ros: str):
    assert "zstate bridge panda" in failure("bridge", "--ros", ros)


def test_a_router_that_is_not_there_is_named_with_how_to_start_one(free_port: int):
    said = failure("bridge", "panda", "--ros", f"tcp/127.0.0.1:{free_port}")
    assert f"'tcp/127.0.0.1:{free_port}'" in said
    assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in said
    assert "zstate router --ros2" in said


def test_a_wire_that_there_is_not_is_refused_before_anything_is_opened():
    assert "no wire 'ros3'" in failure("bridge", "panda", "--wire", "ros3")
