from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import Spawn, failure, interrupted, run_cli, run_until, started

from zstate import StreamListener, connect, discover
from zstate.scans import Grid, MapPublisher, load_map
from zstate.scans.messages import OccupancyGrid

# Two rows of three cells: two occupied, three free, one unknown.
CELLS = [[100, 0, 0], [-1, 0, 100]]


@pytest.fixture
def hall(tmp_path: Path) -> str:
    """A map of map_server, 3 x 2 cells of half a metre, turned by a quarter."""
    path = tmp_path / "hall.yaml"
    Grid(CELLS, 0.5, (1.0, 2.0, np.pi / 2)).save(path)
    return str(path)


@pytest.mark.processes
def test_map_is_published_under_the_name_of_the_file_until_ctrl_c(spawn: Spawn, hall: str):
    child = started(spawn, "map", hall)
    assert child.line() == (
        "hall: 3 x 2 cells of 0.5 m, 1.5 x 1 m, in map, on zstate/hall/map/map, until Ctrl-C"
    )
    found = json.loads(run_cli("echo", "hall", "--stream", "map", "--once", "--json").stdout)
    assert found["frame"] == "hall/map"
    assert (found["width"], found["height"], found["size"]) == (3, 2, [1.5, 1.0])
    assert (found["occupied"], found["free"], found["unknown"]) == (2, 3, 1)
    assert found["origin"]["translation"] == [1.0, 2.0, 0.0]
    # A quarter turn about z: half the angle is 45 degrees.
    assert found["origin"]["rotation"] == pytest.approx([0.0, 0.0, 0.5**0.5, 0.5**0.5])
    interrupted(child)
    assert "robot 'hall' is not announced" in failure("hz", "hall", "--once", "--timeout", "1")


def test_name_frame_and_writer_are_those_given(hall: str):
    with connect() as session:
        options = ("--name", "r1", "--frame", "odom", "--writer", "slam")
        ended, (robot,) = run_until(lambda: discover(session) or None, "map", hall, *options)
    assert "in odom, on zstate/r1/map/slam" in ended.stdout
    assert (robot.name, [name for name, _ in robot.named("map")]) == ("r1", ["slam"])


def test_map_is_listed_with_its_writer(hall: str):
    with connect() as session, MapPublisher(session, "r1", load_map(hall), writer="slam"):
        listed = json.loads(run_cli("ls", "--json").stdout)
        (writer,) = listed[0]["writers"]
        assert (listed[0]["robot"], writer["stream"], writer["names"]) == ("r1", "map", ["slam"])
        assert "map/slam" in run_cli("ls").stdout
        assert "r1: map/slam" in run_cli("graph").stdout


def test_name_of_a_file_becomes_that_of_a_place(hall: str):
    path = Path(hall).rename(Path(hall).with_name("floor 2 @home.yaml"))
    ended, _ = run_until(lambda: True, "map", str(path))
    assert ended.stdout.startswith("floor_2_home: ")


def test_place_with_nothing_but_a_map_is_sound(hall: str):
    with connect() as session, MapPublisher(session, "hall", load_map(hall)):
        ended = run_cli("doctor", "hall", "--json")
    checks = {one["name"]: one for one in json.loads(ended.stdout)["checks"] if one["robot"] == "hall"}
    assert ended.code == 0
    assert {name: one["state"] for name, one in checks.items()} == {
        "writers": "ok",
        "map": "ok",
        "tf_static": "ok",
    }
    assert "3 x 2 cells of 0.5 m in 'hall/map'" in checks["map"]["text"]


def test_second_map_of_a_place_is_refused_with_the_first(hall: str):
    with connect() as session, MapPublisher(session, "hall", load_map(hall)):
        assert "'hall'" in failure("map", hall)


def test_bad_file_is_reported_with_every_line(hall: str):
    text = Path(hall).read_text().replace("resolution: 0.5", "resolution: none")
    Path(hall).write_text(text.replace("negate: 0\n", ""))
    message = failure("map", hall)
    assert "hall.yaml:1: negate is missing" in message
    assert "resolution" in message


def test_map_too_large_for_the_network_is_refused_with_its_file(tmp_path: Path):
    path = tmp_path / "city.yaml"
    Grid(np.zeros((4096, 4097), dtype=np.int8), 0.5, (0.0, 0.0, 0.0)).save(path)
    assert f"{path} has 4097 x 4096 cells" in failure("map", str(path)).replace("\n", " ")


def test_missing_file_and_bad_names_are_refused(hall: str):
    assert "does not exist" in failure("map", "none.yaml", code=2)
    assert "'a/b'" in failure("map", hall, "--name", "a/b")
    assert "'a/b'" in failure("map", hall, "--writer", "a/b")


def test_ros_wire_has_the_map_on_its_topic(ros_router: str, hall: str):
    with (
        connect(mode="client", endpoints=ros_router) as session,
        StreamListener(session, "hall", "map", wire="ros2") as maps,
    ):
        ended, received = run_until(lambda: maps.get(0.0), "map", hall)
    assert "ROS 2 topic /map" in ended.stdout
    grid = received.message
    assert isinstance(grid, OccupancyGrid)
    assert (grid.frame, grid.width, grid.height) == ("map", 3, 2)


def test_map_of_a_ros_topic_is_in_a_frame_of_ros(ros_router: str, hall: str):
    with (
        connect(mode="client", endpoints=ros_router) as session,
        MapPublisher(session, "hall", load_map(hall), "ros2"),
    ):
        found = json.loads(run_cli("echo", "--stream", "map", "--once", "--json").stdout)
    assert (found["width"], found["occupied"], found["frame"]) == (3, 2, "ros/map")


@pytest.mark.parametrize("name", ["map_server", "dummy_map_server"])
def test_words_of_ros_lead_here(name: str):
    assert "use `zstate map FILE.yaml`" in failure(name, code=2)
