from __future__ import annotations

import math
from pathlib import Path

import pytest
from helpers.cli_runner import (
    RRBOT,
    Spawn,
    found_pose,
    interrupted,
    published_robot,
    run_cli,
    run_until,
    started,
)
from helpers.processes import until

from zstate import TransformListener, connect, discover, load_model
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.sources import JointStateListener
from zstate.wire.protocol import SerializedSample

EVERYTHING = {"joint_states", "robot_description", "tf", "tf_static"}


@pytest.fixture
def client(ros_router: str):
    with connect(mode="client", endpoints=ros_router) as session:
        yield session


def streams(session: Session, wire: str = "ros2") -> set[str]:
    return {stream for info in discover(session, wire=wire) for stream, _ in info.writers}


def test_publish_takes_the_place_of_robot_state_publisher(ros_router: str, client: Session):
    sentence = (
        "publishing 'rrbot' (7 links, 2 joints) on "
        "ROS 2 topics /robot_description, /tf_static, /tf (domain 0)\n"
    )
    ended, found = run_until(lambda: streams(client), "publish", RRBOT, after=sentence)
    assert ended.stdout.startswith(sentence)
    assert found == EVERYTHING - {"joint_states"}
    with (
        TransformListener(client, wire="ros2", follow="tf") as listener,
        published_robot("driver", (0.5, 0.0), wire="ros2", router=ros_router, streams=("joint_states",)),
    ):
        _, placed = run_until(
            lambda: found_pose(listener, "base", "upper"),
            *("publish", RRBOT),
            after="receiving ROS 2 topic /joint_states (domain 0): 2 positions",
        )
    assert math.isclose(placed.rpy[1], 0.5, abs_tol=1e-12)  # the shoulder turns about y


def test_native_joint_states_are_published_completely_on_ros(ros_router: str, client: Session):
    command = ("publish", RRBOT, "--wire", "native", "--wire", "ros2")
    sentence = (
        "publishing 'rrbot' (7 links, 2 joints) on zstate/rrbot/{robot_description,tf_static,tf} and on "
        "ROS 2 topics /joint_states, /robot_description, /tf_static, /tf (domain 0)\n"
    )
    ended, found = run_until(
        lambda: [streams(client, wire) for wire in ("native", "ros2")], *command, after=sentence
    )
    assert ended.stdout.startswith(sentence)
    assert found == [EVERYTHING - {"joint_states"}, EVERYTHING]
    with (
        published_robot(router=ros_router, positions=(0.5, -0.25), streams=("joint_states",)),
        JointStateListener(client, "rrbot", load_model(RRBOT), wire="ros2") as source,
    ):
        _, reading = run_until(lambda: source.read(0), *command)
    assert list(reading.positions) == [0.5, -0.25]


def test_a_sine_is_published_on_all_wires(ros_router: str, client: Session):
    _, found = run_until(
        lambda: [streams(client, wire) for wire in ("native", "ros2:namespace=r1")],
        *("publish", RRBOT, "--source", "sine", "--wire", "native", "--wire", "ros2:namespace=r1"),
        after="publishing 'rrbot'",
    )
    assert found == [EVERYTHING, EVERYTHING]


def test_native_and_ros_wires_together_report_the_router_option():
    result = run_cli(
        *("publish", RRBOT, "--source", "sine", "--seconds", "0.1", "--wire", "native", "--wire", "ros2")
    )
    assert result.code == 0
    assert "pass --connect" in result.stderr


def test_joints_names_its_topic(client: Session):
    sentence = "rrbot: a sine on 2 joints, 100 Hz, on ROS 2 topic /joint_states (domain 0)\n"
    ended, found = run_until(lambda: streams(client), "joints", RRBOT, after=sentence)
    assert ended.stdout.startswith(sentence)
    assert found == {"joint_states"}


EDGE = ("static", "r1/base", "laser", "--xyz", "1", "0", "0")


def test_a_static_edge_of_two_ros_frames_needs_no_robot(client: Session):
    with TransformListener(client, wire="ros2", follow="tf") as listener:
        ended, placed = run_until(
            lambda: found_pose(listener, "r1/base", "laser"), *EDGE, after="topic /tf_static (domain 0)"
        )
    assert "on ROS 2 topic /tf_static (domain 0)" in ended.stdout
    assert placed.translation.tolist() == [1.0, 0.0, 0.0]


def test_topics_have_the_configured_names(client: Session):
    received: list[SerializedSample] = []
    with LatchedSubscriber(client, "0/tf_static/**", received.append):
        run_until(lambda: received or None, *EDGE)
    assert b"r1/base\0" in received[0].payload
    assert b"\0laser\0" in received[0].payload


@pytest.mark.processes
def test_a_file_starts_robots_on_several_wires_and_the_router_of_ros(
    spawn: Spawn, tmp_path: Path, free_port: int
):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    file = tmp_path / "cell.toml"
    file.write_text(
        f"""
        [router]
        listen = ["{endpoint}"]
        ros2 = true
        [[robot]]
        model = "{RRBOT}"
        source = "sine"
        wires = ["native", "ros2:domain=5"]
        """
    )
    command = started(spawn, "up", str(file))
    until(lambda: "publishing 'rrbot'" in command.line())
    with connect(mode="client", endpoints=endpoint) as session:
        assert streams(session, "native") == EVERYTHING
        assert streams(session, "ros2:domain=5") == EVERYTHING
    interrupted(command)
