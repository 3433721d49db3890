from __future__ import annotations

import json
import math
import re
import time
from itertools import islice
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from helpers.cli_runner import (
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_until,
    run_watched,
    started,
)
from helpers.processes import DEADLINE_S, SOON_S, repeated, until
from helpers.programs import scanner

from zstate import StaticPublisher, StreamListener, Transform, TransformPublisher, connect
from zstate.scans import Grid, ScanListener
from zstate.scans.messages import LaserScan
from zstate.scans.scan import scan_from_message

WALL_M = 3.0


@pytest.fixture
def hall(tmp_path: Path) -> str:
    """A square room around the origin, with walls whose inner sides are 3 m away."""
    side = np.zeros((64, 64), dtype=np.int8)
    side[[0, 1, -2, -1], :] = side[:, [0, 1, -2, -1]] = 100
    path = tmp_path / "hall.yaml"
    Grid(side, 0.1, (-3.2, -3.2, 0.0)).save(path)
    return str(path)


def document(*robot: str) -> dict:
    return json.loads(run_cli("echo", *robot, "--stream", "scan", "--once", "--json").stdout)


@pytest.mark.processes
def test_dummy_scans_have_the_pattern_of_dummy_laser(spawn: Spawn):
    child = started(spawn, "scan", "r1", "--frame", "laser", "--dummy", "--sensor", "front")
    assert child.line() == "r1: scans in laser, 30 Hz, on zstate/r1/scan/front"
    found = document("r1")
    assert (found["frame"], found["rays"], found["valid"], found["ray_ns"]) == ("r1/laser", 1081, 1081, 0)
    # |sin| of 3 rad/s of the stamp; its phase is that of pi / 3 s.
    expected = abs(np.sin(np.pi * (found["stamp"] % round(np.pi / 3 * 1e9)) / round(np.pi / 3 * 1e9)))
    assert found["ranges"] == pytest.approx([expected] * 1081, abs=1e-6)
    assert found["nearest"] == found["farthest"]
    measured = json.loads(run_cli("hz", "r1", "--stream", "scan", "--once", "--json").stdout)
    assert measured["rate_hz"] == pytest.approx(30.0, rel=0.3)
    interrupted(child)
    assert "commanded 30 Hz" in child.line()


def test_summary_of_a_scan_has_no_ranges():
    with scanner("r1", "laser"):
        text = run_cli("echo", "r1", "--stream", "scan", "--once").stdout
        changed = run_cli("echo", "r1", "--stream", "scan", "--once", "--changed").stdout
    assert "rays: 1081\nvalid: 1081\nnearest: " in text
    assert "ranges" not in text
    assert 'frame: "r1/laser"' in changed


def drive(publisher: TransformPublisher) -> None:
    """One pose of a laser that drives to and fro and turns, at 1.5 rad/s."""
    stamp = time.time_ns()
    angle = 1.5e-9 * (stamp % 10**12)
    rotation = (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))
    publisher.publish([Transform("odom", "laser", (math.sin(angle), 0.5, 0.0), rotation, stamp)])


def test_simulated_scans_hit_the_walls_while_the_robot_drives(hall: str):
    """Placed by the transforms of the network, each point is on a wall, wherever the laser was."""
    with (
        connect() as session,
        TransformPublisher(session, "r1", "odometry") as publisher,
        repeated(lambda: drive(publisher)),
        ScanListener(session, "r1", "odom") as scans,
    ):
        ended, placed = run_until(
            lambda: list(islice(scans, 10)) if len(scans) >= 10 else None,
            *("scan", "r1", "--frame", "laser", "--simulate", hall),
            after="the map stands in r1/odom",
        )
    assert ended.stdout.startswith("r1: scans in laser, 30 Hz, on zstate/r1/scan/scan\n")
    for one in placed:
        # One turn of 1440 rays in each thirtieth of a second.
        assert one.scan.ray_ns == round(1e9 / 30 / 1440)
        assert one.valid.all()
        # From the centre the walls are 3 m away along x or y; ranges are float32, of up to 8 m.
        distances = np.abs(one.points[:, :2]).max(axis=1)
        assert np.abs(distances - WALL_M).max() < 1e-5
    assert len({one.stamp for one in placed}) == 10
    assert scans.dropped == {}


def test_a_laser_that_is_outside_the_map_is_a_warning(hall: str):
    def leave(command: Command) -> None:
        statics.set(Transform.from_rpy("r1/base", "r1/laser", (3.1, 0.0, 0.3), (0.0, 0.0, 0.0)))
        command.line()
        assert scans.get(DEADLINE_S)
        assert "is outside the map" not in command.stderr
        statics.set(Transform.from_rpy("r1/base", "r1/laser", (3.3, 0.0, 0.3), (0.0, 0.0, 0.0)))
        until(lambda: "laser is outside the map, which stands in r1/base" in command.stderr)

    with (
        connect() as session,
        StaticPublisher(session, "r1", "mount") as statics,
        StreamListener(session, "r1", "scan") as scans,
    ):
        run_watched(leave, "scan", "r1", "--frame", "laser", "--simulate", hall)


def test_map_stands_in_its_frame_once_the_robot_has_that(hall: str):
    """The hall's axes are turned by a quarter against the robot's root, and 1 m in front of it."""
    with (
        connect() as session,
        StaticPublisher(session, "r1", "mount") as statics,
        StreamListener(session, "r1", "scan") as scans,
    ):
        statics.set(Transform.from_rpy("hall/map", "r1/base", (1.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2)))
        statics.set(Transform.from_rpy("r1/base", "r1/laser", (0.0, 0.0, 0.3), (0.0, 0.0, 0.0)))
        options = ("--simulate", hall, "--map-frame", "hall/map")
        ended, received = run_until(lambda: scans.get(0.0), "scan", "r1", "--frame", "laser", *options)
    assert "the map stands in hall/map" in ended.stderr
    assert isinstance(received.message, LaserScan)
    ranges = scan_from_message(received.message, "r1").ranges
    # At x = 1 m in the map, the laser's x axis is the map's y axis: the walls are 3 m ahead, 2 m to its right
    # (-90 degrees, ray 180) and 4 m to its left (90 degrees, ray 900).
    assert [ranges[540], ranges[180], ranges[900]] == pytest.approx([3.0, 2.0, 4.0], abs=1e-4)


def test_simulated_scan_waits_for_the_robot_and_its_frame(hall: str):
    def watch(command: Command) -> None:
        until(lambda: "waiting: robot 'rrbot' is not announced" in command.stderr)
        with published_robot():
            until(lambda: "'rrbot/nozzle'" in command.stderr)

    run_watched(watch, "scan", "rrbot", "--frame", "nozzle", "--simulate", hall)
    message = failure("scan", "r9", "--frame", "laser", "--simulate", hall, "--seconds", "1")
    assert "no scan in 1 s: robot 'r9' is not announced" in message


def test_scans_in_a_frame_that_no_robot_places_are_a_finding():
    with published_robot(), scanner("rrbot", "baze", "front"):
        ended = run_cli("doctor", "rrbot", "--json")
    assert ended.code == 1
    first = json.loads(ended.stdout)["first_broken"]
    assert first["name"] == "scan"
    assert "the scan of 'front' is in 'rrbot/baze', which no writer places; 'base'" in first["text"]


def test_commands_that_look_show_scans():
    with published_robot(), scanner("rrbot", "base", "front"):
        (robot,) = json.loads(run_cli("ls", "--json").stdout)
        (writer,) = [one for one in robot["writers"] if one["stream"] == "scan"]
        assert writer["names"] == ["front"]
        assert writer["rate_hz"] == pytest.approx(30.0, rel=0.3)
        assert "rrbot: scan/front (" in run_cli("graph").stdout
        monitored = json.loads(run_cli("monitor", "--robots", "--once", "--json").stdout)
        assert monitored["scan_hz"] == pytest.approx(30.0, rel=0.3)
        assert " scan " in run_cli("monitor", "--robots", "--once").stdout
        ended = run_cli("doctor", "rrbot", "--json")
        checks = [one for one in json.loads(ended.stdout)["checks"] if one["name"] == "scan"]
        assert [one["state"] for one in checks] == ["ok"]


def test_metrics_count_scans():
    def scrape(command: Command) -> None:
        until(lambda: "metrics at " in command.stderr)
        url = re.search(r"metrics at (\S+)", command.stderr)
        assert url is not None

        def has_counts() -> bool:
            with urlopen(url[1], timeout=SOON_S) as reply:
                return 'stream="scan"' in reply.read().decode()

        until(has_counts)

    run_watched(scrape, "scan", "r1", "--frame", "laser", "--dummy", "--metrics", "0")


def test_wrong_usage_is_refused(hall: str):
    both = ("--dummy", "--simulate", hall)
    for options in ((), both):
        assert "give --simulate MAP.yaml or --dummy" in failure(
            "scan", "r1", "--frame", "f", *options, code=2
        )
    assert "--frame" in failure("scan", "r1", "--dummy", code=2)
    assert "'a/b'" in failure("scan", "r1", "--frame", "f", "--dummy", "--sensor", "a/b")


def test_ros_wire_has_scans_on_the_topic_of_the_sensor(ros_router: str):
    with (
        connect(mode="client", endpoints=ros_router) as session,
        StreamListener(session, "r1", "scan", wire="ros2") as scans,
    ):
        ended, received = run_until(lambda: scans.get(0.0), "scan", "r1", "--frame", "laser", "--dummy")
    assert "ROS 2 topic /scan" in ended.stdout
    assert isinstance(received.message, LaserScan)
    scan = scan_from_message(received.message, "r1")
    assert (len(scan.ranges), received.message.frame) == (1081, "laser")


@pytest.mark.usefixtures("ros_router")
def test_scans_of_a_ros_topic_are_in_a_frame_of_ros():
    with scanner("r1", "laser", wire="ros2"):
        found = document()
    assert (found["rays"], found["frame"]) == (1081, "ros/laser")


@pytest.mark.parametrize(("name", "option"), [("dummy_laser", "--dummy"), ("lidar", "--simulate MAP.yaml")])
def test_words_of_ros_lead_here(name: str, option: str):
    assert f"use `zstate scan ROBOT --frame FRAME {option}`" in failure(name, code=2)
