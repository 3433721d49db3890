from __future__ import annotations

import json
import os
import socket
from typing import Any

import pytest
from helpers.cli_runner import (
    ALL_STREAMS,
    RRBOT,
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_watched,
    started,
)
from helpers.processes import find_free_port, until
from helpers.programs import moving_edge

from zstate import StaticPublisher, connect
from zstate.cli.commands.ls import robots_text
from zstate.net.discovery import RobotInfo
from zstate.net.topic_statistics import TopicStatistics
from zstate.wire.identity import WriterId
from zstate.wire.registry import get_wire


def test_each_stream_is_listed_with_its_writer():
    with published_robot():
        robot, *streams = run_cli("ls").stdout.splitlines()
    assert robot == "rrbot"
    assert sorted(line.split()[0] for line in streams) == sorted(ALL_STREAMS)
    for line in streams:
        assert f"@{socket.gethostname()} pid {os.getpid()}" in line
        assert "since 20" in line


def test_json_names_robots_and_writers():
    with published_robot("left", streams=("joint_states",)), published_robot("right"):
        robots = json.loads(run_cli("ls", "--json").stdout)
    assert [robot["robot"] for robot in robots] == ["left", "right"]
    (writer,) = robots[0]["writers"]
    assert (writer["stream"], writer["pid"]) == ("joint_states", os.getpid())


def test_static_edges_are_listed_with_the_name_of_their_writer():
    with connect() as session, StaticPublisher(session, "arm", "mount"):
        lines = run_cli("ls").stdout.splitlines()
        (robot,) = json.loads(run_cli("ls", "--json").stdout)
    assert lines[0] == "arm"
    assert lines[1].split()[0] == "tf_static/mount"
    assert [writer["names"] for writer in robot["writers"]] == [["mount"]]


def test_empty_network_is_no_error():
    ended = run_cli("ls")
    assert (ended.code, ended.stdout) == (0, "")
    assert "no robot is announced" in ended.stderr
    assert "robots of other hosts: --mode lan, or --connect" in ended.stderr
    assert json.loads(run_cli("ls", "--json").stdout) == []


@pytest.mark.processes
@pytest.mark.parametrize("command", [("ls",), ("ls", "--json"), ("graph", "--json")], ids=" ".join)
def test_no_robot_beside_a_stopped_program_is_no_empty_fleet(
    spawn: Spawn, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
):
    """The first command after Ctrl-Z of the program where the others meet."""
    addresses = " ".join(f"127.0.0.1:{find_free_port()}" for _ in range(3))
    monkeypatch.setenv("ZSTATE_RENDEZVOUS", addresses)
    owner = started(spawn, "publish", RRBOT, "--source", "sine")
    owner.line()
    owner.freeze()
    message = failure(*command)
    assert "no robot is found, and discovery is incomplete" in message
    assert f"process {owner.process.pid} " in message


def test_invalid_endpoint_is_named():
    assert "nonsense" in failure("ls", "--connect", "nonsense")


def test_ls_measures_joint_states_and_starts_no_other_stream():
    with published_robot():
        lines = {line.split()[0]: line for line in run_cli("ls").stdout.splitlines()}
        (robot,) = json.loads(run_cli("ls", "--json").stdout)
    assert " Hz  " in lines["joint_states"]
    assert " Hz  " not in lines["tf"]
    (joints,) = [writer for writer in robot["writers"] if writer["stream"] == "joint_states"]
    assert 20.0 < joints["rate_hz"] < 200.0
    assert 0.0 <= joints["silent_s"] < 1.0


@pytest.mark.processes
def test_watch_prints_the_list_again_after_each_change(spawn: Spawn):
    command = started(spawn, "ls", "--watch")
    assert command.line().startswith("no robot is announced")
    with published_robot(streams=("joint_states",)):
        until(lambda: command.line() == "rrbot")
        assert command.line().split()[0] == "joint_states"
    until(lambda: command.line().startswith("no robot is announced"))
    interrupted(command)


def test_watch_as_json_prints_a_document_a_second():
    with published_robot():
        ended = run_watched(lambda command: [command.line() for _ in range(2)], "ls", "--watch", "--json")
    documents = [json.loads(line) for line in ended.stdout.splitlines()]
    assert [robot["robot"] for robot in documents[1]] == ["rrbot"]


def test_narrow_terminal_abbreviates_start_times_and_ages():
    writer = WriterId("driver", "jetson", 412, 0, 7)
    robots = (RobotInfo("arm", (("joint_states", writer),)),)
    with connect() as session, TopicStatistics(session, get_wire("native")) as statistics:
        wide = robots_text(robots, statistics).splitlines()[1]
        headings, robot, narrow = robots_text(robots, statistics, width=55).splitlines()
        narrowest = robots_text(robots, statistics, width=40).splitlines()[1]
    assert (robot, headings.split()) == ("arm", ["robot,", "stream", "rate", "age", "writer"])
    assert headings.index("writer") == narrow.index("driver@")
    assert "since 1970-01-01" in wide
    assert "since" not in narrow
    assert len(narrow) <= 55
    assert narrowest.split() == ["joint_states", "driver@jetson", "pid", "412"]


def test_on_ros_side_the_list_is_watched_too(ros_router: str):
    def watch(command: Command) -> None:
        assert command.line().startswith("no ROS 2 node")
        with published_robot(wire="ros2", router=ros_router):
            until(lambda: "/joint_states" in command.line())

    run_watched(watch, "ls", "--watch")


def test_writers_of_transforms_have_their_names_and_rates():
    usual = pytest.approx(50.0, rel=0.2)  # not while a busy machine publishes several at once after a pause
    with moving_edge("r1", "odom", "base", writer="odometry"):

        def document(*arguments: str) -> Any:
            return json.loads(run_cli(*arguments, "--json").stdout)

        until(lambda: document("ls")[0]["writers"][0]["rate_hz"] == usual)
        until(lambda: [edge["rate_hz"] for edge in document("monitor", "--once")["edges"]] == [usual])
        (robot,), text, graph = document("ls"), run_cli("ls").stdout, run_cli("graph").stdout
        robots = run_cli("monitor", "--robots", "--once").stdout
    (writer,) = robot["writers"]
    assert (robot["robot"], writer["stream"], writer["names"]) == ("r1", "transforms", ["odometry"])
    assert "transforms/odometry" in text
    assert "r1: transforms/odometry (" in graph
    assert robots.startswith("r1  ")
