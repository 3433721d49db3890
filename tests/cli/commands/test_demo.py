from __future__ import annotations

import json
import os
import re
import signal

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, missing_library, run_cli, started
from helpers.processes import Child, until

from zstate import Kinematics, load_model
from zstate.model import catalog
from zstate.odometry import DiffDrive, WheelNoise
from zstate.odometry.cli.rover import ROVER_BASE, ROVER_JOINTS, ROVER_MODEL, ROVER_WHEELS, settings_file
from zstate.odometry.cli.settings_file import read_settings


def publisher_of(demo: Child) -> int:
    match = re.search(r"process (\d+) publishes it", demo.line())
    assert match
    return int(match[1])


def is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.processes
def test_it_shows_transforms_and_ends_with_a_summary():
    output = run_cli("demo", RRBOT, "--seconds", "1.5", "--rate", "50").stdout
    first, *lines, summary = output.splitlines()
    assert first.startswith("rrbot (2 joints, 7 links): process ")
    assert "lower in world: xyz [" in lines[0]
    summary_match = re.fullmatch(
        r"(?P<count>\d+) samples received in (?P<seconds>\d+\.\d\d) s: (?P<rate>[\d.]+) Hz, \d+ missed, "
        r"median latency [\d.]+ [mu]s from stamp to lookup",
        summary,
    )
    assert summary_match
    assert float(summary_match["seconds"]) >= 1.5  # and not before, but a busy machine may come to it later
    # The three numbers agree to the last digit shown.
    rounded = 0.05 * float(summary_match["seconds"]) + 0.005 * float(summary_match["rate"])
    assert float(summary_match["rate"]) * float(summary_match["seconds"]) == pytest.approx(
        int(summary_match["count"]), abs=rounded + 1e-6
    )
    assert "\x1b" not in output


@pytest.mark.processes
def test_without_panda_demo_shows_rrbot_and_prints_how_to_install_more(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(catalog._COLLECTIONS, "example-robot-data")
    ended = run_cli("demo", "--seconds", "0.5")
    assert ended.code == 0, ended.stderr
    assert "'panda' is not installed (pip install 'zstate[robots]'), so this shows 'rrbot'" in ended.stderr
    assert "samples received" in ended.stdout


@pytest.mark.processes
def test_ctrl_c_ends_both_processes_with_the_summary(spawn: Spawn):
    demo = started(spawn, "demo", RRBOT)
    publisher = publisher_of(demo)
    demo.line()
    interrupted(demo)
    assert "received in" in demo.line()
    until(lambda: is_gone(publisher))


@pytest.mark.processes
def test_a_publisher_that_dies_ends_the_demo(spawn: Spawn):
    demo = started(spawn, "demo", RRBOT)
    publisher = publisher_of(demo)
    demo.line()
    os.kill(publisher, signal.SIGKILL)
    assert demo.wait() == 1
    assert "the process 'publisher' ended with exit code -9" in demo.stderr


@pytest.mark.processes
def test_a_publisher_does_not_outlive_a_demo_that_is_killed(spawn: Spawn):
    demo = started(spawn, "demo", RRBOT)
    publisher = publisher_of(demo)
    demo.line()
    demo.kill()
    until(lambda: is_gone(publisher))


def rover_programs(demo: Child) -> list[int]:
    """The process ids of the wheels and of the odometry."""
    match = re.fullmatch(
        r"rover \(2 joints, 7 links\): processes (\d+) \(wheels\) and (\d+) \(odometry\) publish it at "
        r"100 Hz, this one looks it up",
        demo.line(),
    )
    assert match
    return [int(pid) for pid in match.groups()]


@pytest.mark.processes
def test_rover_shows_its_odometry_and_places_the_scans_of_its_room(spawn: Spawn):
    demo = started(spawn, "demo", "rover")
    programs = rover_programs(demo)
    room = re.fullmatch(
        r"process (\d+) \(map\) publishes the map of a room, which lidar_link measures", demo.line()
    )
    assert room
    line = demo.line()
    pattern = (
        r"joint states [\d.]+ Hz, odometry samples [\d.]+ Hz, .*; lidar_link in odom: xyz \[.* 0\.\d+\] m, .*"
    )
    assert re.fullmatch(pattern, line)
    assert "it drives a square until it is commanded: zstate move rover --keys --connect tcp/" in demo.stderr
    interrupted(demo)
    pattern = (
        r"\d+ joint states and \d+ odometry samples received in [\d.]+ s: [\d.]+ and [\d.]+ Hz, 0 missed, .*"
    )
    until(lambda: re.fullmatch(pattern, demo.line()))
    assert re.match(r"[1-9]\d* scans? with [1-9]\d* points? placed in odom", demo.line())
    until(lambda: all(map(is_gone, [*programs, int(room[1])])))


@pytest.mark.processes
@pytest.mark.parametrize("number, name", [(0, "wheels"), (1, "odometry")])
def test_a_program_of_the_rover_that_dies_ends_the_demo(spawn: Spawn, number: int, name: str):
    demo = started(spawn, "demo", "rover")
    programs = rover_programs(demo)
    demo.line()
    os.kill(programs[number], signal.SIGKILL)
    assert demo.wait() == 1
    assert f"the process {name!r} ended with exit code -9" in demo.stderr
    until(lambda: all(map(is_gone, programs)))


@pytest.mark.processes
def test_other_commands_follow_the_rover_at_the_printed_address(spawn: Spawn):
    demo = started(spawn, "demo", "rover")
    until(lambda: "--connect " in demo.stderr)
    address = re.search(r"--connect (\S+);", demo.stderr)
    assert address
    robots = json.loads(run_cli("ls", "--json", "--connect", address[1]).stdout)
    room, rover = robots
    writers = {(one["stream"], one["program"]) for one in rover["writers"]}
    assert (room["robot"], rover["robot"]) == ("room", "rover")
    assert {("joint_states", "rover-wheels"), ("imu", "rover-imu"), ("scan", "rover-laser")} <= writers
    assert "odometry" in {stream for stream, _ in writers}
    interrupted(demo)


@pytest.mark.processes
@pytest.mark.long
def test_rover_without_the_libraries_of_maps_has_no_room():
    with missing_library("PIL"):
        ended = run_cli("demo", "rover", "--seconds", "0.5")
    assert ended.code == 0, ended.stderr
    assert "without a room and its laser, which need pip install 'zstate[maps]'" in ended.stderr
    assert "(map)" not in ended.stdout
    assert "joint states and" in ended.stdout


def test_rover_takes_no_xacro_arguments():
    assert "'rover' takes no xacro arguments; got side" in failure("demo", "rover", "side:=2", code=2)


def test_the_wheels_of_the_rover_have_the_measures_of_its_model():
    model = load_model(ROVER_MODEL)
    assert model.joint_names == ROVER_JOINTS
    poses = dict(zip(model.links, Kinematics(model).link_poses([0.0, 0.0]), strict=True))
    radius, track = ROVER_WHEELS
    left, right = model.joint_names
    wheels = DiffDrive(left, right, radius, track, noise=WheelNoise(slip=0.05))
    assert read_settings(str(settings_file())).wheels == wheels
    assert model.root == ROVER_BASE
    assert poses["left_wheel"][:3] == pytest.approx([0.0, track / 2, radius])
    assert poses["right_wheel"][:3] == pytest.approx([0.0, -track / 2, radius])


@pytest.mark.processes
def test_laser_of_the_arm_sweeps_a_room(spawn: Spawn):
    demo = started(spawn, "demo", "rrbot", "--world")
    demo.line()
    match = re.fullmatch(
        r"processes (\d+) \(map\) and (\d+) \(laser\) publish the map of a room and the scans of laser_link "
        r"in it",
        demo.line(),
    )
    assert match
    demo.line()
    address = re.search(r"--connect (\S+);", demo.stderr)
    assert address

    def streams() -> set[tuple[str, str]]:
        robots = json.loads(run_cli("ls", "--json", "--connect", address[1]).stdout)
        return {(robot["robot"], one["stream"]) for robot in robots for one in robot["writers"]}

    until(lambda: {("rrbot", "scan"), ("rrbot", "joint_states"), ("room", "map")} <= streams())
    interrupted(demo)
    summary = (
        r"[1-9]\d* scans? with [1-9]\d* points? placed in world, each point by the pose at its own instant; "
        r"\d+ dropped"
    )
    until(lambda: re.fullmatch(summary, demo.line()))
    until(lambda: all(is_gone(int(pid)) for pid in match.groups()))


def test_only_the_arm_has_a_room():
    assert "--world is for 'rrbot' alone; got 'rover'" in failure("demo", "rover", "--world", code=2)


@pytest.mark.processes
def test_demo_is_isolated_with_its_publisher_in_any_environment(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZENOH_CONFIG", "/nowhere.json5")
    monkeypatch.setenv("ZSTATE_MODE", "client")
    assert run_cli("demo", RRBOT, "--seconds", "0.5").code == 0


def test_unknown_robot_error_names_one_that_always_works():
    assert "`zstate demo rrbot`" in failure("demo", "no_such_robot")
