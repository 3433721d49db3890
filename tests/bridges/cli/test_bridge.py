from __future__ import annotations

from collections.abc import Iterator

import pytest
from helpers.cli_runner import (
    ELBOW,
    SHOULDER,
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_watched,
    started,
)
from helpers.programs import router

from zstate import TransformListener, connect, load_model
from zstate.model.kinematics import Kinematics

EACH = "ros2:namespace=*"


@pytest.fixture
def ros(free_port: int) -> Iterator[str]:
    """The endpoint of the router on ROS's side."""
    with router(f"tcp/127.0.0.1:{free_port}") as endpoint:
        yield endpoint


@pytest.mark.parametrize("given", [["rrbot"], [], ["--wire", EACH]], ids=["named", "alone", "all"])
def test_native_robot_is_carried_to_ros_with_a_line_at_start_and_end(ros: str, given: list[str]):
    wire = EACH if EACH in given else "ros2"

    def watch(command: Command) -> None:
        with published_robot():
            assert command.line().startswith(f"bridging {'every robot' if wire == EACH else repr('rrbot')} ")
            assert command.line() == "carrying 'rrbot': native to ROS"
            tool = listener.buffer.wait("world", "tool", timeout_s=10.0)
            model = load_model("rrbot")
            poses = dict(zip(model.links, Kinematics(model).link_poses([SHOULDER, ELBOW]), strict=True))
            assert tool.translation == pytest.approx(poses["tool"][:3] - poses["world"][:3], abs=1e-12)
        assert command.line() == "'rrbot' is no longer carried"

    with (
        connect(mode="client", endpoints=ros) as session,
        TransformListener(session, "rrbot", wire=wire) as listener,
    ):
        run_watched(watch, "bridge", *given, "--ros", ros)


@pytest.mark.processes
def test_ros_robot_is_carried_to_native(spawn: Spawn, ros: str):
    command = started(spawn, "bridge", "arm", "--ros", ros)
    command.line()
    with published_robot(wire="ros2", router=ros), connect() as session:
        assert command.line() == "carrying 'arm': ROS to native"
        with TransformListener(session, "arm") as listener:
            assert listener.buffer.wait("world", "tool", timeout_s=10.0).kind == "exact"
        interrupted(command)


def test_several_robots_do_not_share_the_root_namespace(ros: str):
    with published_robot("left"), published_robot("right"):
        message = failure("bridge", "--ros", ros)
    assert "room for one robot, not for 'left' and 'right'" in message
    assert "zstate bridge panda" in message
    assert EACH in message


def test_bridge_without_a_robot_prints_how_to_name_one(ros: str):
    assert "zstate bridge panda" in failure("bridge", "--ros", ros)


@pytest.mark.usefixtures("impatient")
def test_missing_router_error_names_it_and_how_to_start_one(free_port: int):
    message = failure("bridge", "panda", "--ros", f"tcp/127.0.0.1:{free_port}")
    assert f"'tcp/127.0.0.1:{free_port}'" in message
    assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in message
    assert "zstate router --ros2" in message


def test_unknown_wire_is_refused_before_a_session_opens():
    assert "no wire 'ros3'" in failure("bridge", "panda", "--wire", "ros3")
