"""A light command is there about as soon as any program with click: the rest is loaded when it is needed.

Time is that of the processor, the least of several runs by turns: so a busy machine is no slower.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bench.micro.startup import MINIMAL
from zstate.cli.main import group

pytestmark = pytest.mark.processes

ROUNDS = 5
AT_MOST = 2.5


def processor_s(*command: str) -> float:
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0
    return used.ru_utime + used.ru_stime


@pytest.mark.parametrize("arguments", [("--help",), ("tree", "--help"), ("up", "--help")])
def test_a_light_command_takes_at_most_two_and_a_half_times_a_bare_program(
    tmp_path: Path, arguments: tuple[str, ...]
):
    bare = tmp_path / "bare.py"
    bare.write_text(MINIMAL)
    rounds = [
        (processor_s(str(bare), "command", "--help"), processor_s("-m", "zstate", *arguments))
        for _ in range(ROUNDS)
    ]
    bare_s, ours_s = map(min, zip(*rounds, strict=True))
    assert ours_s < AT_MOST * bare_s


@pytest.mark.parametrize(
    "command", group.list_commands(group.make_context("zstate", [], resilient_parsing=True))
)
def test_the_help_of_a_command_loads_no_library(command: str):
    heavy = {"numpy", "zenoh", "pinocchio", "msgspec", "rich", "mcap", "yaml"}
    ask = (
        f"import sys\nsys.argv = ['zstate', {command!r}, '--help']\n"
        "from zstate.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit:\n"
        f"    print('loaded', *({heavy!r} & set(sys.modules)), file=sys.stderr)\n"
    )
    ended = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=False)
    assert ended.stderr.split() == ["loaded"]
