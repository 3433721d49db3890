"""The README's blocks run here or in .ci/run."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.cli_runner import run_cli
from helpers.pages import commands, programs, section
from helpers.processes import DEADLINE_S, Child

from zstate import TransformListener, connect

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
    assert set(PROGRAMS) == {"publish.py", "lookup.py", "buffer.py"}


@pytest.mark.processes
def test_publisher_and_lookup_connect_from_two_processes(
    spawn: Callable[..., Child],
) -> None:
    spawn(PROGRAMS["publish.py"])
    lookup = spawn(PROGRAMS["lookup.py"])
    assert lookup.line().startswith("<pose of tool in world at ")
    assert lookup.wait() == 0, lookup.stderr


@pytest.mark.processes
def test_buffer_works_without_a_network(spawn: Callable[..., Child]) -> None:
    buffer = spawn(PROGRAMS["buffer.py"])
    assert "500.0 ms after the newest sample of 'map' -> 'base'" in buffer.line()
    assert buffer.wait() == 0, buffer.stderr


@pytest.mark.processes
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


@pytest.mark.processes
@pytest.mark.robots
@pytest.mark.long
def test_view_with_sliders_prints_its_address(start: Callable[[list[str]], subprocess.Popen[str]]) -> None:
    _, sliders, _ = commands(section(TEXT, "## See it"))
    view = start([*sliders, "--port", "0"])
    assert view.stdout is not None
    assert view.stdout.readline().startswith("the view is at http://127.0.0.1:")


@pytest.mark.processes
@pytest.mark.robots
@pytest.mark.long
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
    pages = "".join(path.read_text() for path in (ROOT / "docs").rglob("*.md"))
    named = set(re.findall(r"`zstate (\w+)", TEXT + pages))
    known = set(re.findall(r"^  (\w+) ", run_cli("--help").stdout, re.MULTILINE))
    assert named <= known, named - known
