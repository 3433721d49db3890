from __future__ import annotations

import json
import signal

import pytest
from helpers.cli_runner import Spawn, failure, found_pose, run_cli, run_until, started
from helpers.processes import SOON_S
from helpers.programs import moving_edge

from zstate import Transform, TransformListener, connect


def line(target: str, source: str, x: float = 0.0, **others: object) -> str:
    pose = {"translation": [x, 0.0, 0.0], "rotation": [0.0, 0.0, 0.0, 1.0]}
    return json.dumps({"target": target, "source": source, **pose, **others})


def test_pose_is_published_at_the_rate_as_a_moving_edge():
    with connect() as session, TransformListener(session, "r1") as listener:
        options = ("--xyz", "1", "2", "0", "--rpy-deg", "0", "0", "90", "--rate", "200", "--robot", "r1")

        def find() -> Transform | None:
            return found_pose(listener, "odom", "base_link") if listener.stats.received > 20 else None

        ended, found = run_until(
            find, "transform", "odom", "base_link", *options, "--writer", "odometry", after="until Ctrl-C"
        )
    assert found.translation.tolist() == [1.0, 2.0, 0.0]
    # A quarter turn about z: half the angle is 45 degrees.
    assert abs(found.rotation - [0.0, 0.0, 0.5**0.5, 0.5**0.5]).max() < 1e-12
    assert found.stamp is not None
    first, last, *_ = ended.stdout.splitlines()
    assert first == (
        "pose of base_link in odom: xyz [1, 2, 0] m, rpy [0, 0, 90] deg, 200 Hz, "
        "on zstate/r1/transforms/odometry, until Ctrl-C"
    )
    assert "commanded 200 Hz" in last


@pytest.mark.processes
def test_lines_of_json_are_published_with_their_stamps_until_ctrl_c(spawn: Spawn):
    with connect() as session, TransformListener(session, "r1") as listener:
        child = started(spawn, "transform", "--stdin", "--robot", "r1")
        child.send_line(line("map", "ball", 1.0, stamp=1_000))
        child.send_line(line("map", "ball", 3.0, stamp=2_000))
        between = listener.buffer.wait("map", "ball", 1_500, timeout_s=2 * SOON_S)
        assert between.translation[0] == 2.0
        child.process.send_signal(signal.SIGINT)
        assert child.wait() == 130
    assert "publishing the transforms of standard input on zstate/r1/transforms/" in child.line()
    assert child.line() == "2 transforms published"


def test_bad_line_is_reported_with_its_number_and_the_next_ones_go_on():
    lines = ["nonsense", line("map", "ball"), "[1]", "", line("map", "map"), line("map", "ball", 2.0)]
    ended = run_cli("transform", "--stdin", "--robot", "r1", stdin="\n".join(lines).encode())
    assert ended.stdout.endswith("2 transforms published, 3 lines refused\n")
    assert ended.code == 1
    reports = [text for text in ended.stderr.splitlines() if "line " in text]
    assert [text.split(": ")[1] for text in reports] == ["line 1", "line 3", "line 5"]
    assert "a transform is a JSON object, not list" in reports[1]
    assert "placed on itself" in reports[2]


@pytest.mark.processes
def test_output_of_tf_is_an_input(spawn: Spawn):
    pose = Transform("odom", "base_link", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), 5).to_dict()
    with connect() as session, TransformListener(session, "twin") as listener:
        child = started(spawn, "transform", "--stdin", "--robot", "twin")
        child.send_line(json.dumps({**pose, "rpy": [0, 0, 0], "age_s": 0.1}))
        assert listener.buffer.wait("odom", "base_link", 5, timeout_s=2 * SOON_S).translation[2] == 3.0


def test_robot_is_that_of_a_full_name():
    edge = ("fleet/map", "r7/odom", "--xyz", "0", "0", "0")
    run_until(lambda: True, "transform", *edge, after="zstate/r7/transforms/")


def test_second_writer_of_an_edge_is_refused_with_the_first():
    edge = ("odom", "base", "--xyz", "0", "0", "0", "--robot", "r1")
    with moving_edge("r1", "odom", "base", writer="wheels"):
        assert "'wheels'" in failure("transform", *edge, "--writer", "lidar")
        assert "'wheels'" in failure("static", *edge, "--writer", "lidar")


def test_ros_wire_has_messages_that_listeners_read(ros_router: str):
    with (
        connect(mode="client", endpoints=ros_router) as session,
        TransformListener(session, wire="ros2") as listener,
    ):
        ended, found = run_until(
            lambda: found_pose(listener, "odom", "base_link"),
            *("transform", "odom", "base_link", "--xyz", "4", "0", "0"),
            *("--wire", "ros2", "--connect", ros_router),
        )
    assert "ROS 2 topic /tf" in ended.stdout
    assert found.translation.tolist() == [4.0, 0.0, 0.0]


def test_transforms_on_the_ros_wire_are_read_by_tf(ros_router: str):
    with moving_edge("ros", "odom", "base_link", (4.0, 0.0, 0.0), wire="ros2"):
        found = run_cli("tf", "odom", "base_link", "--once", "--json")
    assert json.loads(found.stdout)["translation"] == [4.0, 0.0, 0.0]


def test_half_an_edge_and_mixed_sources_are_wrong_usage():
    assert "--stdin" in failure("transform", "odom", "base", code=2)
    assert "leave out TARGET" in failure("transform", "odom", "base", "--stdin", code=2)
    assert "--rate" in failure("transform", "--stdin", "--rate", "5", code=2)
