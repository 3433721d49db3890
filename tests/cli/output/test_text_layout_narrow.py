"""On sixty columns nothing is wider, but for a word, and nobody who wants no colours gets any."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from helpers.cli_runner import RRBOT, published_robot, zstate

pytestmark = pytest.mark.processes

WIDTH = 60


def seen(*arguments: str, **environment: str) -> list[str]:
    """The lines of a command on a terminal that is so narrow."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, WIDTH, 0, 0))
    plain = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR")}
    with subprocess.Popen(
        [sys.executable, "-m", "zstate", *arguments],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env={**plain, **environment},
    ):
        os.close(theirs)
        said = b""
        while part := _read(ours):
            said += part
    os.close(ours)
    return said.decode().replace("\r\n", "\n").split("\n")


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 65536)
    except OSError:  # so Linux says that nobody is at the other end any more
        return b""


def test_what_runs_is_told_within_the_width():
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
            said = seen(*command, NO_COLOR="1")
            assert max(map(len, said)) <= WIDTH + 2 * (command[0] == "tf"), (command, said)
            assert "\x1b" not in "".join(said)


def test_settings_models_and_errors_are_told_within_the_width(tmp_path: Path):
    bad = tmp_path / "bad.urdf"
    bad.write_text(Path(RRBOT).read_text().replace('<child link="upper"/>', '<child link="uper"/>'))
    for command in (
        ("config", "--connect", "tcp/192.168.1.10:7447"),
        ("check", RRBOT, "--joints"),
        ("check", "rrbot"),
        ("ls", "--connect", "tcp/127.0.0.1:9"),
    ):
        said = [line for line in seen(*command) if RRBOT not in line]
        assert max(map(len, said)) <= WIDTH, (command, said)


def test_the_comment_of_a_long_example_stands_above_it():
    lines = seen("tree", "--help")
    place = lines.index("  zstate tree --wire ros2")
    assert lines[place - 1] == "  # hears /tf and /tf_static"
    in_a_pipe = zstate("tree", "--help").stdout.decode().splitlines()
    assert any(line.startswith("  zstate tree --wire ros2  ") for line in in_a_pipe)
