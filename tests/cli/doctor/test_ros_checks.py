"""What doctor says of ROS's side, where nodes share topics and robots have no names."""

from __future__ import annotations

import json
import re
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import RRBOT, published_robot, zstate

from zstate.cli.doctor.diagnosis import effective_network, with_same_options
from zstate.cli.session import SessionOptions
from zstate.net.config import ROUTER_ENDPOINT
from zstate.wire.keys import Stream

WRITTEN: tuple[Stream, ...] = ("tf", "tf_static", "robot_description")


@pytest.fixture
def gripper(tmp_path: Path) -> str:
    """Another robot than rrbot, whose joints are called otherwise."""
    text = Path(RRBOT).read_text()
    for name in ("world", "base", "upper", "lower", "tool", "shoulder", "elbow", "rrbot"):
        text = text.replace(f'"{name}"', f'"grip_{name}"')
    path = tmp_path / "gripper.urdf"
    path.write_text(text)
    return str(path)


class Found:
    """What doctor finds, link by link."""

    def __init__(self, *arguments: str, code: int = 0) -> None:
        ended = zstate("doctor", *arguments, "--json", "--timeout", "2")
        assert ended.returncode == code, (ended.stdout, ended.stderr)
        said: dict[str, Any] = json.loads(ended.stdout)
        self.first_broken = said["first_broken"]
        self.states = {check["name"]: check["state"] for check in said["checks"]}
        self.texts = {check["name"]: check["text"] for check in said["checks"]}
        self.next = {check["name"]: check["next"] for check in said["checks"]}
        assert "ros/" not in ended.stdout.decode()


@pytest.mark.processes
def test_nodes_that_make_one_robot_are_sound_whatever_it_is_called(ros_router: str):
    with published_robot(wire="ros2", router=ros_router):
        for name in ((), ("ros",), ("rrbot",)):
            found = Found(*name)
            assert set(found.states.values()) == {"ok"}, found.texts
        other = Found("ur5")
    assert other.states["model"] == "warning"
    assert other.texts["model"].startswith("/robot_description carries 'rrbot', and not 'ur5'")


@pytest.mark.processes
def test_joints_of_others_on_the_topic_are_of_no_concern(ros_router: str, gripper: str):
    with ExitStack() as nodes:
        nodes.enter_context(published_robot(wire="ros2", router=ros_router))
        only: tuple[Stream, ...] = ("joint_states",)
        nodes.enter_context(
            published_robot("grip", wire="ros2", router=ros_router, model=gripper, streams=only)
        )
        found = Found("rrbot")
    assert found.states["joint_states"] == "ok"
    assert found.texts["joint_states"].count(" Hz from ") == 2
    assert found.texts["joint_states"].endswith("; 2 joints of no concern: 'grip_shoulder', 'grip_elbow'")


@pytest.mark.processes
def test_a_joint_that_two_nodes_tell_is_a_warning(ros_router: str):
    with ExitStack() as nodes:
        nodes.enter_context(published_robot(wire="ros2", router=ros_router))
        nodes.enter_context(
            published_robot("twin", wire="ros2", router=ros_router, streams=("joint_states",))
        )
        found = Found()
    assert found.states["joint_states"] == "warning"
    assert "the joint 'shoulder' is told by /" in found.texts["joint_states"]
    assert "(2 of them): what follows it jumps between them" in found.texts["joint_states"]
    assert found.next["joint_states"] == f"zstate ls --wire ros2 --connect {ros_router}  # end one of them"


@pytest.mark.processes
def test_two_robots_in_one_namespace_are_a_warning(ros_router: str, gripper: str):
    with ExitStack() as nodes:
        nodes.enter_context(published_robot(wire="ros2", router=ros_router))
        nodes.enter_context(published_robot("grip", wire="ros2", router=ros_router, model=gripper))
        found = Found()
    assert found.states["writers"] == "warning"
    assert found.texts["writers"].startswith("2 nodes publish the model, ")
    assert "2 trees, with the roots grip_world, world" in found.texts["poses"]
    assert found.next["poses"].startswith("zstate static grip_world world --xyz 0 0 0 --wire ros2 --connect ")


@pytest.mark.processes
def test_a_driver_of_other_joints_is_told_from_one_that_is_missing(ros_router: str, gripper: str):
    with ExitStack() as nodes:
        only: tuple[Stream, ...] = ("joint_states",)
        nodes.enter_context(published_robot(wire="ros2", router=ros_router, streams=WRITTEN))
        nodes.enter_context(
            published_robot("grip", wire="ros2", router=ros_router, model=gripper, streams=only)
        )
        found = Found(code=1)
    assert found.first_broken["name"] == "joint_states"
    told = "none of the joints on it ('grip_shoulder', 'grip_elbow') is one of the model 'rrbot'"
    assert told in found.first_broken["text"]


@pytest.mark.processes
def test_who_makes_transforms_lacks_the_driver_and_a_driver_lacks_the_model(ros_router: str):
    with published_robot(wire="ros2", router=ros_router, streams=("tf_static", "robot_description")):
        lacking = Found(code=1).first_broken
    assert (lacking["name"], lacking["robot"]) == ("joint_states", "ros")
    assert "nobody publishes /joint_states, for which /" in lacking["text"]
    assert lacking["next"].startswith(f"zstate joints FILE --wire ros2 --connect {ros_router}  # ")
    with published_robot(wire="ros2", router=ros_router, streams=("joint_states",)):
        lacking = Found(code=1).first_broken
    assert (lacking["name"], lacking["text"]) == ("model", "nobody publishes /robot_description")
    assert lacking["next"] == f"zstate publish FILE --wire ros2 --connect {ros_router}"


@pytest.mark.processes
def test_where_no_node_publishes_it_says_in_which_domain(ros_router: str):
    found = Found(code=1).first_broken
    assert (found["name"], found["text"]) == ("robots", "nobody publishes the state of a robot in domain 0")


def test_a_ros_wire_joins_the_router_of_the_host_where_nothing_is_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ZENOH_CONFIG", raising=False)
    assert effective_network(SessionOptions(), "ros2") == SessionOptions("client", (ROUTER_ENDPOINT,))
    assert effective_network(SessionOptions(), "native") == SessionOptions()
    assert effective_network(SessionOptions("lan"), "ros2") == SessionOptions("lan")


def test_the_next_command_looks_where_doctor_has_looked():
    network = SessionOptions(connect=("tcp/a:1", "tcp/b:2"))
    both = "--connect tcp/a:1 --connect tcp/b:2"
    assert (
        with_same_options("zstate hz r1  # how often?", network, "native")
        == f"zstate hz r1 {both}  # how often?"
    )
    assert (
        with_same_options("zstate ls", SessionOptions(), "ros2:domain=5") == "zstate ls --wire ros2:domain=5"
    )
    for whole in ("zstate check FILE", "ps -p 7", "zstate ls --wire ros2 --connect tcp/c:3"):
        assert with_same_options(whole, network, "ros2") == whole


@pytest.mark.processes
def test_degrees_on_the_topic_are_named(ros_router: str, tmp_path: Path):
    text = Path(RRBOT).read_text().replace('type="continuous"', 'type="revolute"')
    limit = '<limit lower="-2" upper="2" effort="1" velocity="1"/>'
    model = tmp_path / "limited.urdf"
    model.write_text(re.sub(r"<limit [^>]*/>", "", text).replace("<axis", f"{limit}<axis"))
    with published_robot(positions=(45.0, 0.0), model=str(model), wire="ros2", router=ros_router):
        found = Found()
    assert found.states["limits"] == "warning"
    assert found.texts["limits"].endswith(
        "is outside -2 to 2; this looks like degrees: convert with math.radians"
    )
    assert found.next["limits"].startswith("zstate echo --once --wire ros2")
