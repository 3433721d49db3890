"""Output fits a terminal of 60 columns, and has no colours with NO_COLOR."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, in_terminal, published_robot, run_cli
from helpers.processes import DEADLINE_S

pytestmark = pytest.mark.processes

WIDTH = 60


def run_in_terminal(*arguments: str) -> list[str]:
    """The lines of a command on a terminal with WIDTH columns."""
    received = b""
    with in_terminal(*arguments, columns=WIDTH) as (process, terminal):
        while part := _read(terminal):
            received += part
        process.wait(DEADLINE_S)
    return received.decode().replace("\r\n", "\n").split("\n")


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("COLUMNS", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 65536)
    except OSError:  # Linux reports the closed terminal so
        return b""


def test_commands_about_running_robots_fit_the_width(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NO_COLOR", "1")
    with published_robot("left"), published_robot("right"):
        for command in (
            ("ls",),
            ("tree",),
            ("graph",),
            ("doctor",),
            ("doctor", "left"),
            ("monitor", "--once"),
            ("monitor", "left/base", "left/lower", "--once"),
            ("tf", "left/base", "nothing", "--once", "--timeout", "0.6"),
        ):
            lines = run_in_terminal(*command)
            assert max(map(len, lines)) <= WIDTH + 2 * (command[0] == "tf"), (command, lines)
            assert "\x1b" not in "".join(lines)


def test_settings_models_and_errors_fit_the_width(tmp_path: Path):
    bad = tmp_path / "bad.urdf"
    bad.write_text(Path(RRBOT).read_text().replace('<child link="upper"/>', '<child link="uper"/>'))
    for command in (
        ("config", "--connect", "tcp/192.168.1.10:7447"),
        ("check", RRBOT, "--joints"),
        ("check", "rrbot"),
        ("ls", "--connect", "tcp/127.0.0.1:9"),
    ):
        lines = [line for line in run_in_terminal(*command) if RRBOT not in line]
        assert max(map(len, lines)) <= WIDTH, (command, lines)


def test_comment_of_a_long_example_is_above_it():
    lines = run_in_terminal("tree", "--help")
    place = lines.index("  zstate tree --wire ros2")
    assert lines[place - 1] == "  # reads /tf and /tf_static"
    in_a_pipe = run_cli("tree", "--help").stdout.splitlines()
    assert any(line.startswith("  zstate tree --wire ros2  ") for line in in_a_pipe)
