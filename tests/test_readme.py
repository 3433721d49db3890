"""The blocks of the README and of the first pages run here or in .ci/run; links in a clone lead somewhere."""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, Spawn, run_cli, started
from helpers.pages import commands, programs, section
from helpers.processes import DEADLINE_S, Child

from zstate import TransformListener, connect

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
README, START, VIEW = ((ROOT / name).read_text() for name in ("README.md", "docs/start.md", "docs/view.md"))
PROGRAMS = programs(README) | programs(START)


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
    assert set(PROGRAMS) == {"pose.py", "publish.py", "lookup.py", "buffer.py"}


@pytest.mark.processes
def test_program_of_the_readme_publishes_and_looks_up(spawn: Callable[..., Child]) -> None:
    pose = spawn(PROGRAMS["pose.py"])
    assert pose.line().startswith("<pose of tool in world at ")
    assert pose.wait() == 0, pose.stderr


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
    joints, publish, tf = commands(section(START, "## Three terminals"))
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
    _, sliders, _ = commands(VIEW)
    view = start([*sliders, "--port", "0"])
    assert view.stdout is not None
    assert view.stdout.readline().startswith("the view is at http://127.0.0.1:")


@pytest.mark.processes
@pytest.mark.robots
@pytest.mark.long
def test_robots_of_the_picture_are_published_in_the_hall(
    start: Callable[[list[str]], subprocess.Popen[str]],
) -> None:
    (command,) = re.findall(r"`(zstate up docs/\S+)`", VIEW)
    *up, file = command.split()
    hall = start([*up, str(ROOT / file)])
    with connect() as session, TransformListener(session) as listener:
        for frame in ("panda/panda_hand", "talos/gripper_right_base_link"):
            listener.buffer.wait("hall/floor", frame, timeout_s=DEADLINE_S)
    hall.send_signal(signal.SIGINT)
    assert hall.wait(DEADLINE_S) == 130, hall.communicate()[1]


@pytest.mark.processes
def test_commands_of_the_three_ways_in_work(
    spawn: Spawn, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(RRBOT, "arm.urdf")
    urdf = commands(section(README, "### My robot has a URDF"))
    ros = commands(section(README, "### I come from ROS 2"))
    recordings = commands(section(README, "### I have recordings"))
    assert [command[1] for command in urdf + ros + recordings] == [
        *("check", "publish", "view", "tf", "tree", "doctor", "info", "view", "export"),
    ]
    check, publish, view = urdf
    assert run_cli(*check[1:]).code == 0
    started(spawn, *publish[1:])
    assert run_cli("wait", "robot", "rrbot").code == 0
    tf, *others = ros
    for command in ([*tf, "--once"], *others):
        assert run_cli(*command[1:]).code == 0, command
    assert run_cli("record", "run.mcap", "rrbot", "--seconds", "0.5").code == 0
    info, view_recording, export = recordings
    assert run_cli(*info[1:]).code == 0
    assert run_cli(*export[1:]).code == 0
    assert Path("run.parquet").exists()
    for command in (view, view_recording):
        page = started(spawn, *command[1:], "--port", "0")
        assert page.line().startswith("the view is at http://127.0.0.1:")


PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.rglob("*.md"), *(ROOT / ".github").glob("*.md")]
PAGES += [ROOT / folder / "README.md" for folder in ("bench", "deploy", "models/drivers")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_files_of_a_clone(page: Path) -> None:
    """And to text: a page that only includes another file shows none in a clone."""
    text = re.sub(r"`[^`\n]*`", "", page.read_text())  # a signature looks like a link
    for target in re.findall(r"\]\((?!\w+:|#)([^()\s#]+)", text):
        path = (page.parent / target).resolve()
        assert path.exists(), target
        assert path.suffix != ".md" or "# " in path.read_text().partition("```{include}")[0], target


def test_every_command_named_exists() -> None:
    pages = "".join(path.read_text() for path in DOCS.rglob("*.md"))
    named = set(re.findall(r"`zstate ([a-z]\w*)", README + pages))
    known = set(re.findall(r"^  (\w+) ", run_cli("--help").stdout, re.MULTILINE))
    assert named <= known, named - known
