"""The README's blocks run here or in .ci/run; files named in docs/architecture.md exist."""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.pages import commands, programs, section
from helpers.processes import DEADLINE_S, Child
from helpers.recording_builder import MS, START, RecordingBuilder, pose

from zstate import TransformListener, connect
from zstate.wire.messages import LaserScan, OccupancyGrid, to_block, to_float32_block

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
TEXT = README.read_text()


PROGRAMS = programs(TEXT)


@pytest.fixture
def start() -> Iterator[Callable[[list[str]], subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []

    def run(command: list[str]) -> subprocess.Popen[str]:
        assert command[0] == "zstate"
        arguments = [sys.executable, "-u", "-m", "zstate", *command[1:]]
        started.append(subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.communicate()


def test_every_python_block_is_a_program_tested_here() -> None:
    assert set(PROGRAMS) == {
        "publish.py",
        "lookup.py",
        "driver.py",
        "gripper.py",
        "odometry.py",
        "teleop.py",
        "estimator.py",
        "buffer.py",
        "place.py",
        "recording.py",
        "scans.py",
        "joints.py",
    }


def test_publisher_and_lookup_connect_from_two_processes(
    spawn: Callable[..., Child],
) -> None:
    spawn(PROGRAMS["publish.py"])
    lookup = spawn(PROGRAMS["lookup.py"])
    assert lookup.line().startswith("<pose of tool in world at ")
    assert lookup.wait() == 0, lookup.stderr


def test_publisher_has_twelve_lines_and_lookup_five() -> None:
    def lines_of(name: str) -> int:
        return sum(1 for line in PROGRAMS[name].splitlines() if line.strip() and not line.startswith("#"))

    assert lines_of("publish.py") <= 12
    assert lines_of("lookup.py") <= 5


def test_driver_keeps_its_rate(spawn: Callable[..., Child]) -> None:
    driver = spawn(PROGRAMS["driver.py"])
    assert "commanded_hz=500.0" in driver.line()
    assert driver.wait() == 0, driver.stderr


def test_driver_of_the_gripper_publishes_its_joints(spawn: Callable[..., Child]) -> None:
    gripper = spawn(PROGRAMS["gripper.py"])
    assert "commanded_hz=100.0" in gripper.line()
    assert gripper.wait() == 0, gripper.stderr


def test_odometry_is_looked_up_from_another_process(spawn: Callable[..., Child]) -> None:
    spawn(PROGRAMS["odometry.py"])
    with connect() as session, TransformListener(session, "rover") as listener:
        assert listener.buffer.lookup("odom", "base_link", timeout_s=DEADLINE_S).translation[2] == 0.0


def test_buffer_works_without_a_network(spawn: Callable[..., Child]) -> None:
    buffer = spawn(PROGRAMS["buffer.py"])
    assert "500.0 ms after the newest sample of 'map' -> 'base'" in buffer.line()
    assert buffer.wait() == 0, buffer.stderr


def test_scan_is_placed_and_its_end_explained(spawn: Callable[..., Child]) -> None:
    place = spawn(PROGRAMS["place.py"])
    assert "after the newest sample of 'odom' -> 'base'" in place.line()
    assert place.wait() == 0, place.stderr


@pytest.mark.robots
def test_three_terminals_print_the_pose_of_the_hand(
    start: Callable[[list[str]], subprocess.Popen[str]],
) -> None:
    joints, publish, tf = commands(section(TEXT, "## Three terminals"))
    first, second, third = start(joints), start(publish), start(tf)
    lines: list[str] = []
    assert third.stdout
    for line in third.stdout:
        lines.append(line)
        if "Translation" in line:
            break
    assert any(line.startswith("At time ") for line in lines), lines
    for process in (third, second, first):
        process.send_signal(signal.SIGINT)
        process.wait(DEADLINE_S)
        assert "Traceback" not in process.communicate()[1]


def test_a_simulated_robot_is_driven_stopped_and_released(
    start: Callable[[list[str]], subprocess.Popen[str]],
    spawn: Callable[..., Child],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    drive, *others = commands(section(TEXT, "## Drive"))
    host = start(drive)
    assert host.stdout
    assert host.stdout.readline().startswith("driving 'rrbot' (2 joints, sim)")
    for command in others:
        ended = start(command)
        assert ended.wait(DEADLINE_S) == 0, ended.communicate()[1]
    teleop = spawn(PROGRAMS["teleop.py"])
    assert teleop.line() == "('shoulder', 'elbow')"
    lines = iter(host.stdout.readline, "")
    assert any(line.startswith("active, commanded by ") for line in lines)


def test_estimator_of_a_base_needs_no_network(spawn: Callable[..., Child]) -> None:
    estimator = spawn(PROGRAMS["estimator.py"])
    assert estimator.line().startswith("<pose of base_link in odom at ")
    assert estimator.wait() == 0, estimator.stderr


@pytest.mark.robots
def test_view_with_sliders_prints_its_address(start: Callable[[list[str]], subprocess.Popen[str]]) -> None:
    _, sliders, _ = commands(section(TEXT, "## See it"))
    view = start([*sliders, "--port", "0"])
    assert view.stdout is not None
    assert view.stdout.readline().startswith("the view is at http://127.0.0.1:")


def test_router_commands_work_with_this_host_as_the_other(
    start: Callable[[list[str]], subprocess.Popen[str]], free_port: int
) -> None:
    router, publish, tf = (
        [re.sub(r"tcp/[\d.]+:\d+", f"tcp/127.0.0.1:{free_port}", word) for word in command]
        for command in commands(section(TEXT, "## Behind routers"))[:3]
    )
    running = start(router)
    assert running.stdout
    assert str(free_port) in running.stdout.readline()
    start(publish)
    once = start([*tf, "--once"])
    output, errors = once.communicate(timeout=DEADLINE_S)
    assert once.returncode == 0, errors
    assert "At time " in output


@pytest.mark.robots
def test_ros_commands_work_with_another_router_address(
    start: Callable[[list[str]], subprocess.Popen[str]], free_port: int
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router, publish, tf = commands(section(TEXT, "## With ROS 2, without ROS"))[:3]
    running = start([*router, "--listen", endpoint])
    assert running.stdout
    assert str(free_port) in running.stdout.readline()
    start([*publish, "--connect", endpoint])
    once = start([*tf, "--once", "--connect", endpoint])
    output, errors = once.communicate(timeout=DEADLINE_S)
    assert once.returncode == 0, errors
    assert "At time " in output


@pytest.mark.robots
def test_recording_commands_record_describe_look_up_and_replay(
    start: Callable[[list[str]], subprocess.Popen[str]],
    spawn: Callable[..., Child],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    record, info, replay = commands(section(TEXT, "## Recordings"))[:3]
    robot = start(["zstate", "publish", "panda", "--source", "sine"])
    recorder = start(record)
    assert recorder.wait(DEADLINE_S) == 0, recorder.communicate()[1]
    robot.send_signal(signal.SIGINT)
    robot.wait(DEADLINE_S)
    described = start(info)
    assert "panda" in described.communicate(timeout=DEADLINE_S)[0]
    lookup = spawn(PROGRAMS["recording.py"])
    assert lookup.line().startswith("<pose of panda_hand in panda_link0 at ")
    assert lookup.line() == "(1000, 7)"
    assert lookup.wait() == 0, lookup.stderr
    joints = spawn(PROGRAMS["joints.py"])
    assert joints.line().startswith("panda_joint1 (")
    assert joints.wait() == 0, joints.stderr
    replayed = start(replay)
    assert replayed.wait(DEADLINE_S) == 0, replayed.communicate()[1]


def test_recorded_scans_are_placed(
    spawn: Callable[..., Child], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ranges = to_float32_block([1.0, math.inf, 2.0])
    with RecordingBuilder(tmp_path / "run.mcap", "rover") as builder:
        for n in range(3):
            builder.edges("rover", START + n * MS, {("odom", "laser"): pose(n)})
        scan = LaserScan(START, 0, 1, "laser", -1.0, 0.5, 1000, 0, 0.1, 10.0, ranges)
        builder.encoder.write_message("rover", scan, START, "front")
        grid = OccupancyGrid(1, START, "map", 0.5, 2, 1, to_block(pose()), b"\0\x64")
        builder.encoder.write_message("hall", grid, START, "floor")
    scans = spawn(PROGRAMS["scans.py"])
    assert scans.line() == "(2, 3)"
    assert scans.line() == "<Grid of 2 x 1 cells of 0.5 m in 'hall/map'>"
    assert scans.wait() == 0, scans.stderr


@pytest.mark.robots
def test_robots_of_the_picture_are_published_in_the_hall(
    start: Callable[[list[str]], subprocess.Popen[str]],
) -> None:
    (command,) = re.findall(r"`(zstate up docs/\S+)`", TEXT)
    *up, file = command.split()
    hall = start([*up, str(README.parent / file)])
    with connect() as session, TransformListener(session) as listener:
        for frame in ("panda/panda_hand", "talos/gripper_right_base_link"):
            listener.buffer.wait("hall/floor", frame, timeout_s=DEADLINE_S)
    hall.send_signal(signal.SIGINT)
    assert hall.wait(DEADLINE_S) == 130, hall.communicate()[1]


def test_every_command_named_exists() -> None:
    named = set(re.findall(r"`zstate (\w+)", TEXT))
    listed = subprocess.run(
        [sys.executable, "-m", "zstate", "--help"], capture_output=True, text=True, check=True
    ).stdout
    known = set(re.findall(r"^  (\w+) ", listed, re.MULTILINE))
    assert named <= known, named - known


def test_every_file_named_in_the_architecture_page_exists() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"`((?:\w+/)*\w+\.(?:py|c)|(?:\w+/)+)`", text))
    assert len(named) > 50
    assert (
        sorted(name for name in named if not any((top / name).exists() for top in (ROOT / "zstate", ROOT)))
        == []
    )
