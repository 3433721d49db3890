"""Folders that can be removed: without one, the rest imports, starts and shows a robot."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.processes import DEADLINE_S

from zstate.cli.commands import own_commands
from zstate.plugins import built_in_plugins

PLUGINS = {plugin.name: plugin for plugin in built_in_plugins()}

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
from zstate.cli.commands import load_command, own_commands
broken = set(sys.argv[2:]) - own_commands().keys()
for name in own_commands():
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
@pytest.mark.parametrize("folder", PLUGINS)
def test_without_a_folder_the_rest_starts_and_shows_a_robot(folder: str):
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, f"zstate.{folder}", *own_commands()],
        capture_output=True,
        text=True,
        timeout=8 * DEADLINE_S,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    broken = set(ended.stdout.splitlines()[0].split())
    assert broken == PLUGINS[folder].commands.keys()
    assert "rrbot" in ended.stdout
