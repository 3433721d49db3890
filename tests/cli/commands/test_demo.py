from __future__ import annotations

import json
import math
import os
import re
import signal

import numpy as np
import pytest
from helpers.cli_runner import (
    RRBOT,
    Spawn,
    failure,
    interrupted,
    missing_library,
    published_robot,
    run_cli,
    started,
)
from helpers.processes import DEADLINE_S, Child, until

from zstate import Kinematics, TransformListener, connect, load_model
from zstate.cameras import CameraListener
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
    assert "it drives a square until it is commanded: zstate move rover --keys\n" in demo.stderr
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
def test_the_camera_of_the_rover_sees_its_lidar_where_its_transforms_put_it(spawn: Spawn):
    """Against the odometry nothing is compared: the mount of the camera and the lidar are on the base."""
    demo = started(spawn, "demo", "rover", "--camera")
    with (
        connect() as session,
        TransformListener(session, "rover") as listener,
        CameraListener(session, "rover", "front") as pictures,
    ):
        picture = next(one for one in pictures if one.camera is not None)
        listener.buffer.wait("rover/base_link", picture.frame, timeout_s=DEADLINE_S)
        corner = 0.04 / math.sqrt(2.0)  # inside of the lidar, a dark cylinder of 0.04 x 0.05 m
        places = [(x, y, 0.02) for x in (-corner, corner) for y in (-corner, corner)]
        pixels, valid = listener.buffer.project(places, "rover/lidar_link", picture.camera, picture.stamp)
        assert valid.all()
        u, v = np.rint(pixels.mean(axis=0)).astype(int).tolist()
        brightness = picture.decode().max(axis=2)
    assert brightness[v, u] < 80
    left, right = (int(edge) for edge in (pixels[:, 0].min() - 40, pixels[:, 0].max() + 40))
    assert min(brightness[v, left], brightness[v, right]) > 100  # the base or the floor beside it
    until(lambda: "its camera is image/front: zstate view, zstate echo rover --stream image" in demo.stderr)
    interrupted(demo)


@pytest.mark.processes
def test_only_the_rover_has_a_camera():
    assert "--camera is for 'rover' alone; got 'rrbot'" in failure("demo", "rrbot", "--camera", code=2)
    with missing_library("simplejpeg"):
        assert "pip install 'zstate[cameras]'" in failure("demo", "rover", "--camera")


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

    def streams() -> set[tuple[str, str]]:
        robots = json.loads(run_cli("ls", "--json").stdout)
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
def test_pose_of_the_demo_is_that_of_its_joints_for_a_listener_of_the_same_network(spawn: Spawn):
    demo = started(spawn, "demo", RRBOT)
    demo.line()
    with connect() as session, TransformListener(session, "rrbot") as listener:
        pose = listener.buffer.lookup("world", "tool", timeout_s=DEADLINE_S)
        assert pose.stamp is not None
        joints, _ = listener.buffer.joint_positions("rrbot", pose.stamp)
    links = Kinematics(load_model(RRBOT)).link_poses(joints)
    expected = links[load_model(RRBOT).links.index("tool")]
    assert pose.translation == pytest.approx(expected[:3], abs=1e-9)
    interrupted(demo)


@pytest.mark.processes
def test_a_demo_takes_another_name_than_a_robot_that_is_published(spawn: Spawn):
    with published_robot("rrbot"):
        demo = started(spawn, "demo", RRBOT)
        assert demo.line().startswith("rrbot-2 (2 joints, 7 links): process ")
        assert "lower in world" in demo.line()
        assert (
            "'rrbot' is announced by another program already; that of this demo is 'rrbot-2'" in demo.stderr
        )
        interrupted(demo)


@pytest.mark.processes
def test_demos_that_start_at_once_take_names_of_their_own(spawn: Spawn):
    demos = [started(spawn, "demo", RRBOT) for _ in range(3)]
    first_lines = sorted(demo.line() for demo in demos)
    assert [line.partition(" ")[0] for line in first_lines] == ["rrbot", "rrbot-2", "rrbot-3"]
    for demo in demos:
        assert "lower in world" in demo.line()
        interrupted(demo)


@pytest.mark.processes
def test_other_commands_see_two_rovers_and_their_rooms_by_names_of_their_own(spawn: Spawn):
    demos = [started(spawn, "demo", "rover") for _ in range(2)]
    for demo in demos:
        until(lambda demo=demo: "it drives a square" in demo.stderr)
    programs = {"joint_states": "rover-wheels", "imu": "rover-imu", "scan": "rover-laser"}

    def are_all_listed() -> bool:  # on a busy machine some of the programs may still be discovered
        robots = {robot["robot"]: robot for robot in json.loads(run_cli("ls", "--json").stdout)}
        writers = {
            name: {one["stream"]: one["program"] for one in robots[name]["writers"]} for name in robots
        }
        return writers.keys() == {"rover", "rover-2", "room", "room-2"} and all(
            "odometry" in writers[rover] and programs.items() <= writers[rover].items()
            for rover in ("rover", "rover-2")
        )

    until(are_all_listed)
    for demo in demos:
        interrupted(demo)


@pytest.mark.processes
def test_demo_joins_the_network_of_its_options_and_of_the_environment(
    spawn: Spawn, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    router = f"tcp/127.0.0.1:{free_port}"
    monkeypatch.setenv("ZSTATE_WIRE", "ros2")  # a demo is on the native wire
    with connect(mode="router", listen=router):
        assert run_cli("demo", RRBOT, "--seconds", "0.5", "--connect", router).code == 0
        monkeypatch.setenv("ZSTATE_CONNECT", router)
        demo = started(spawn, "demo", RRBOT)
        demo.line()
        demo.line()
        assert [
            robot["robot"] for robot in json.loads(run_cli("ls", "--json", "--wire", "native").stdout)
        ] == ["rrbot"]
        monkeypatch.delenv("ZSTATE_CONNECT")
        assert run_cli("ls", "--json", "--wire", "native").stdout == "[]\n"
        interrupted(demo)


def test_unknown_robot_error_names_one_that_always_works():
    assert "`zstate demo rrbot`" in failure("demo", "no_such_robot")
