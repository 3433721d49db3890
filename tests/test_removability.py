"""Folders that can be removed: without one, the rest imports, starts and shows a robot."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.processes import DEADLINE_S

# Each with the commands that are its own, or need it.
REMOVABLE = {
    "bridges": {"bridge", "ros1"},
    "driving": {"drive", "move", "stop"},
    "foxglove": {"foxglove"},
    "odometry": {"odometry"},
    "recording": {"export", "foxglove", "info", "plot", "record", "recover", "replay", "snapshot"},
    "scans": {"map", "scan"},
    "view": {"view"},
}

PROGRAM = """
import sys

removed = sys.argv[1]

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name == removed or name.startswith(f"{removed}."):
            raise ModuleNotFoundError(f"{name} is removed", name=name)

sys.meta_path.insert(0, Hidden())
import zstate
for name in zstate.__all__:
    if not f"zstate.{zstate._HOMES.get(name)}".startswith(f"{removed}."):
        getattr(zstate, name)
from zstate.cli.commands import command_names, load_command
broken = set()
for name in sorted(command_names()):
    try:
        load_command(name)
    except ModuleNotFoundError:
        broken.add(name)
print(*sorted(broken))
from zstate.cli.main import run
raise SystemExit(run(["demo", "rrbot", "--seconds", "1"]))
"""


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("folder", REMOVABLE)
def test_without_a_folder_the_rest_starts_and_shows_a_robot(folder: str):
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, f"zstate.{folder}"],
        capture_output=True,
        text=True,
        timeout=8 * DEADLINE_S,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    broken = set(ended.stdout.splitlines()[0].split())
    assert broken <= REMOVABLE[folder]
    assert "rrbot" in ended.stdout
