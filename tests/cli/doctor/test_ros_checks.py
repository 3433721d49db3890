"""Doctor on a ROS wire, where nodes share topics and robots have no names."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from helpers.cli_runner import RRBOT, published_robot, run_cli
from helpers.processes import repeated

from zstate import connect
from zstate.cli.doctor.diagnosis import with_same_options
from zstate.cli.session import SessionOptions
from zstate.net.config import ROUTER_ENDPOINT
from zstate.scans import Grid, MapPublisher, ScanPublisher
from zstate.streams import StreamName

WITHOUT_JOINTS: tuple[StreamName, ...] = ("tf", "tf_static", "robot_description")


@pytest.fixture
def gripper(tmp_path: Path) -> str:
    """A robot with other link and joint names than rrbot."""
    text = Path(RRBOT).read_text()
    for name in ("world", "base", "upper", "lower", "tool", "shoulder", "elbow", "rrbot"):
        text = text.replace(f'"{name}"', f'"grip_{name}"')
    path = tmp_path / "gripper.urdf"
    path.write_text(text)
    return str(path)


class Found:
    """The checks of doctor by link."""

    def __init__(self, *arguments: str, code: int = 0) -> None:
        ended = run_cli("doctor", *arguments, "--json", "--timeout", "2")
        assert ended.code == code, (ended.stdout, ended.stderr)
        report: dict[str, Any] = json.loads(ended.stdout)
        self.first_broken = report["first_broken"]
        self.states = {check["name"]: check["state"] for check in report["checks"]}
        self.texts = {check["name"]: check["text"] for check in report["checks"]}
        self.next = {check["name"]: check["next"] for check in report["checks"]}
        assert "ros/" not in ended.stdout


def test_nodes_of_one_robot_are_sound_under_any_name(ros_router: str):
    with published_robot(wire="ros2", router=ros_router):
        for name in ((), ("ros",), ("rrbot",)):
            found = Found(*name)
            assert set(found.states.values()) == {"ok"}, found.texts
        other = Found("ur5")
    assert other.states["model"] == "warning"
    assert other.texts["model"].startswith("/robot_description carries 'rrbot', not 'ur5'")


def test_joints_of_other_models_on_the_topic_are_ok(ros_router: str, gripper: str):
    with ExitStack() as nodes:
        nodes.enter_context(published_robot(wire="ros2", router=ros_router))
        only: tuple[StreamName, ...] = ("joint_states",)
        nodes.enter_context(
            published_robot("grip", wire="ros2", router=ros_router, model=gripper, streams=only)
        )
        found = Found("rrbot")
    assert found.states["joint_states"] == "ok"
    assert found.texts["joint_states"].count(" Hz from ") == 2
    assert found.texts["joint_states"].endswith("; 2 joints outside the model: 'grip_shoulder', 'grip_elbow'")


def test_joint_published_by_two_nodes_is_a_warning(ros_router: str):
    with ExitStack() as nodes:
        nodes.enter_context(published_robot(wire="ros2", router=ros_router))
        nodes.enter_context(
            published_robot("copy", wire="ros2", router=ros_router, streams=("joint_states",))
        )
        found = Found()
    assert found.states["joint_states"] == "warning"
    assert "joint 'shoulder' is published by /" in found.texts["joint_states"]
    assert "(2 of them): poses will jump between them" in found.texts["joint_states"]
    assert found.next["joint_states"] == f"zstate ls --wire ros2 --connect {ros_router}  # stop one of them"


def test_two_robots_in_one_namespace_are_a_warning(ros_router: str, gripper: str):
    with ExitStack() as nodes:
        nodes.enter_context(published_robot(wire="ros2", router=ros_router))
        nodes.enter_context(published_robot("grip", wire="ros2", router=ros_router, model=gripper))
        found = Found()
    assert found.states["writers"] == "warning"
    assert found.texts["writers"].startswith("2 nodes publish the model, ")
    assert "2 trees, with the roots grip_world, world" in found.texts["poses"]
    assert found.next["poses"].startswith("zstate static grip_world world --xyz 0 0 0 --wire ros2 --connect ")


def test_driver_of_other_joints_is_distinguished_from_a_missing_one(ros_router: str, gripper: str):
    with ExitStack() as nodes:
        only: tuple[StreamName, ...] = ("joint_states",)
        nodes.enter_context(published_robot(wire="ros2", router=ros_router, streams=WITHOUT_JOINTS))
        nodes.enter_context(
            published_robot("grip", wire="ros2", router=ros_router, model=gripper, streams=only)
        )
        found = Found(code=1)
    assert found.first_broken["name"] == "joint_states"
    text = "no joint on /joint_states ('grip_shoulder', 'grip_elbow') is in the model 'rrbot'"
    assert text in found.first_broken["text"]


def test_missing_driver_and_missing_model_are_reported(ros_router: str):
    with published_robot(wire="ros2", router=ros_router, streams=("tf_static", "robot_description")):
        lacking = Found(code=1).first_broken
    assert (lacking["name"], lacking["robot"]) == ("joint_states", "ros")
    assert "/joint_states has no publisher, and /" in lacking["text"]
    assert lacking["next"].startswith(f"zstate joints FILE --wire ros2 --connect {ros_router}  # ")
    with published_robot(wire="ros2", router=ros_router, streams=("joint_states",)):
        lacking = Found(code=1).first_broken
    assert (lacking["name"], lacking["text"]) == ("model", "/robot_description has no publisher")
    assert lacking["next"] == f"zstate publish FILE --wire ros2 --connect {ros_router}"


def test_without_nodes_the_domain_is_reported(ros_router: str):
    found = Found(code=1).first_broken
    assert (found["name"], found["text"]) == ("robots", "no node publishes the state of a robot in domain 0")


def test_ros_wire_without_options_joins_the_router_of_the_host(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("ZENOH_CONFIG", raising=False)
    assert SessionOptions().for_wires(("ros2",)) == SessionOptions("client", (ROUTER_ENDPOINT,))
    assert SessionOptions().for_wires(("native",)) == SessionOptions()
    assert SessionOptions("lan").for_wires(("ros2",)) == SessionOptions("lan")


def test_next_command_has_the_endpoints_and_wire_of_doctor():
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


def test_degrees_on_the_topic_are_a_warning(ros_router: str, tmp_path: Path):
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


@contextmanager
def scanning(router: str, frame: str) -> Iterator[None]:
    """A map, and a laser scanner in ``frame`` that measures a hundred times a second."""
    geometry = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.1, "range_max": 10.0}
    with (
        connect(mode="client", endpoints=router) as session,
        MapPublisher(session, "ros", Grid([[0, 100]], 0.5, (0.0, 0.0, 0.0), "world"), wires="ros2"),
        ScanPublisher(session, "ros", "front", frame=frame, wires="ros2", **geometry) as scans,
        repeated(lambda: scans.publish([1.0, 2.0]), every_s=0.01),
    ):
        yield


def test_scans_and_maps_of_nodes_are_sound_if_they_have_a_frame(ros_router: str):
    with published_robot(wire="ros2", router=ros_router), scanning(ros_router, "tool"):
        found = Found()
    assert set(found.states.values()) == {"ok"}, found.texts
    assert re.match(r"\d+\.\d Hz from .*, as 'front', newest ", found.texts["scan"])
    assert found.texts["map"].startswith("'map': 2 x 1 cells of 0.5 m in 'world', from ")


def test_scans_of_nodes_in_a_frame_that_no_node_places_are_broken(ros_router: str):
    with published_robot(wire="ros2", router=ros_router), scanning(ros_router, "tol"):
        found = Found(code=1)
    assert found.states["scan"] == "broken"
    text = "the scan of 'front' is in 'tol', which no writer places; 'tool' is similar"
    assert found.texts["scan"] == text
    assert found.next["scan"].startswith("zstate static TARGET tol --xyz X Y Z --wire ros2")
