"""The tutorial's exercise, from an empty folder and without ROS: build, inspect and break a robot."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from runpy import run_path
from typing import Any

import pytest
from helpers.cli_runner import Spawn, failure, run_cli, started
from helpers.pages import blocks
from helpers.processes import Child
from helpers.tutorial_terminal import FOLDER, TutorialPage, check_page

from zstate.errors import ModelError

DOCS = FOLDER.parents[1] / "docs"
ARM, SWING, CELL = ((FOLDER / name).read_text() for name in ("arm.urdf", "swing.py", "cell.toml"))
"""A robot; its driver, which publishes only joint states; and a cell that computes its transforms."""

XACRO = """\
<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="length" value="0.4"/>
  <link name="base"/>
  <link name="upper"/>
  <joint name="shoulder" type="continuous">
    <parent link="base"/><child link="upper"/>
    <origin xyz="0 0 ${length}"/>
  </joint>
</robot>
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the exercise, with its three files only."""
    monkeypatch.chdir(tmp_path)
    for name, text in (("arm.urdf", ARM), ("swing.py", SWING), ("cell.toml", CELL)):
        Path(name).write_text(text)
    return tmp_path


@pytest.fixture
def cell(folder: Path, spawn: Spawn) -> Child:
    """`zstate up cell.toml`, which waits for the driver."""
    child = started(spawn, "up", "cell.toml")
    ready(child, "publishing 'arm'")
    return child


@pytest.fixture
def driver(folder: Path) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Starts `python swing.py` in the folder."""
    running: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        running.append(subprocess.Popen([sys.executable, "swing.py"], stderr=subprocess.PIPE))
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.communicate()


def ready(child: Child, text: str) -> None:
    while text not in child.line():
        pass


@pytest.fixture
def without_xacro(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An environment without an xacro expander."""
    (folder / ".without").mkdir()
    for name in ("xacro", "xacrodoc"):
        (folder / ".without" / f"{name}.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(folder / ".without")
    monkeypatch.setenv("PYTHONPATH", str(folder / ".without"), prepend=os.pathsep)


def stamped(stamp: str) -> None:
    """Changes the driver to stamp its samples with the expression ``stamp``."""
    Path("swing.py").write_text(SWING.replace("-angle})", f"-angle}}, stamp={stamp})"))


def doctor(*arguments: str, code: int) -> dict[str, Any]:
    ended = run_cli("doctor", *arguments, "--json")
    assert ended.code == code, ended.stdout
    return json.loads(ended.stdout)


def test_the_driver_is_a_dozen_lines():
    assert len(SWING.splitlines()) <= 12


@pytest.mark.parametrize(
    ("page", "files"),
    [
        ("tutorial.md", {"xml": "arm.urdf", "python": "swing.py", "toml": "cell.toml"}),
        ("driving.md", {"xml": "arm.urdf", "python": "wave.py"}),
    ],
)
def test_the_pages_show_the_files_of_the_tutorial(page: str, files: dict[str, str]):
    for language, name in files.items():
        assert blocks(language, (DOCS / page).read_text()) == [(FOLDER / name).read_text()]


@pytest.mark.long
def test_the_terminal_blocks_match_real_output(folder: Path, without_xacro: None):
    check_page(TutorialPage((DOCS / "tutorial.md").read_text()), folder)


@pytest.mark.long
def test_the_terminals_of_driving_match_real_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("tutorial", "drivers"):
        shutil.copytree(FOLDER.parent / name, tmp_path / name)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    check_page(TutorialPage((DOCS / "driving.md").read_text()), tmp_path / "tutorial")


@pytest.mark.processes
def test_the_robot_runs_and_can_be_inspected(cell: Child, driver):
    driver()
    assert run_cli("wait", "robot", "arm").stdout == "ready: 'arm' (3 frames)\n"
    (robot,) = json.loads(run_cli("ls", "--json").stdout)
    writers = {writer["stream"]: writer["program"] for writer in robot["writers"]}
    assert writers == {
        "joint_states": "swing",
        "robot_description": "zstate-publish",
        "tf": "zstate-publish",
        "tf_static": "zstate-publish",
    }
    pose = json.loads(run_cli("tf", "base", "lower", "--once", "--json").stdout)
    # The elbow undoes what the shoulder does: the lower link stays upright on a circle of 0.4 m.
    x, y, z = pose["translation"]
    assert math.isclose(math.hypot(x, z - 0.5), 0.4, abs_tol=1e-9)
    assert abs(y) < 1e-9
    assert math.isclose(abs(pose["rotation"][3]), 1.0, abs_tol=1e-9)
    tree = run_cli("tree").stdout
    assert all(frame in tree for frame in ("base", "upper", "lower"))
    assert doctor("arm", code=0)["sound"]


@pytest.mark.processes
def test_1_dead_driver_is_reported(cell: Child, driver):
    process = driver()
    assert run_cli("wait", "robot", "arm").code == 0
    process.kill()
    process.wait()
    found = doctor(code=1)["first_broken"]
    assert (found["name"], found["robot"]) == ("joint_states", "arm")
    assert "'arm' has no writer of joint_states, which zstate-publish@" in found["text"]
    assert "its driver is not running" in found["text"]


def test_1_without_a_publisher_the_robot_is_missing(folder: Path):
    found = doctor("arm", code=1)["first_broken"]
    assert (found["name"], found["next"]) == ("robots", "zstate publish FILE --name arm")
    assert "its publisher is not running" in found["text"]


@pytest.mark.processes
def test_2_a_path_with_a_space_works_and_missing_quotes_are_reported(folder: Path, spawn: Spawn):
    place = folder / "my robot"
    place.mkdir()
    for name in ("arm.urdf", "cell.toml"):
        (place / name).write_bytes((folder / name).read_bytes())
    ready(started(spawn, "up", "my robot/cell.toml"), "publishing 'arm'")
    assert run_cli("check", "my robot/arm.urdf").code == 0
    for command in ("check", "publish"):
        message = failure(command, "my", "robot/arm.urdf", code=2)
        assert "is one path with a space in it; write it in quotes: 'my robot/arm.urdf'" in message


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ('child link="lower"', 'child link="lowr"', "its child 'lowr' is not a link; did you mean 'lower'?"),
        ("</joint>\n</robot>", "</robot>", "</robot> closes <joint>, which was opened in line 10"),
        (ARM, "", "the text is empty"),
    ],
)
def test_3_bad_urdf_is_refused_by_every_reader(folder: Path, right: str, wrong: str, message: str):
    Path("arm.urdf").write_text(ARM.replace(right, wrong))
    assert message in run_cli("check", "arm.urdf").stdout
    assert message in failure("publish", "arm.urdf")
    assert message in failure("up", "cell.toml")
    with pytest.raises(ModelError, match=re.escape(message)):
        run_path("swing.py")


@pytest.mark.processes
@pytest.mark.parametrize(
    ("stamp", "cause"),
    [
        ("time.time_ns() + 3_600_000_000_000", "3600.0 s after the time here"),
        pytest.param("time.time_ns() + 2_000_000_000", "in the future", marks=pytest.mark.soak),
        ("time.monotonic_ns()", "1970 and after"),
        pytest.param("0", "1970 and after", marks=pytest.mark.soak),
    ],
)
def test_4_stamps_of_the_future_and_of_1970_are_used_and_reported(
    cell: Child, driver, stamp: str, cause: str
):
    stamped(stamp)
    process = driver()
    assert run_cli("wait", "robot", "arm").code == 0
    report = doctor("arm", code=1)
    found = report["first_broken"]
    assert found["name"] == "stamps"
    assert cause in found["text"]
    assert f"swing@{os.uname().nodename} pid {process.pid}" in found["text"]
    # Nothing is dropped for it: the pose is known.
    assert [check["state"] for check in report["checks"] if check["name"] == "poses"] == ["ok"]


def test_5_unexpanded_xacro_is_recognised(folder: Path, without_xacro: None):
    Path("arm.urdf").write_text(XACRO)
    message = "this is a xacro file, which must be expanded: pip install 'zstate[xacro]'"
    assert message in run_cli("check", "arm.urdf").stdout
    assert message in failure("publish", "arm.urdf")
    assert message in failure("up", "cell.toml")


def test_5_a_leftover_xacro_expression_is_recognised(folder: Path):
    lines = XACRO.splitlines(keepends=True)
    Path("arm.urdf").write_text('<robot name="arm">\n' + "".join(lines[2:]))
    message = failure("publish", "arm.urdf")
    assert "line 6" in message
    assert "'0 0 ${length}' is a xacro expression, not a number" in message
