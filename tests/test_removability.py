"""Folders that can be removed: without one, the rest imports, starts, and shows and examines a robot."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.processes import DEADLINE_S

from zstate.plugins import built_in_plugins

PLUGINS = {plugin.name: plugin for plugin in built_in_plugins()}

# Modules of one plugin that are for another one, and are loaded when both are used.
FOR_ANOTHER = {"zstate.odometry.cli.replay": "recording"}

PROGRAM = """
import json, pkgutil, sys, threading
from importlib import import_module

removed = sys.argv[1]

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name == removed or name.startswith(f"{removed}."):
            raise ModuleNotFoundError(f"{name} is removed", name=name)

sys.meta_path.insert(0, Hidden())
import zstate
broken = set()
for module in pkgutil.walk_packages(zstate.__path__, "zstate.", lambda name: None):
    try:
        if not module.name.endswith("__main__"):
            import_module(module.name)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("zstate."):
            broken.add(module.name)
from zstate.cli.commands import load_command, own_commands
for name in own_commands():
    load_command(name)
from zstate.cli.main import run
from zstate.sources import SineSource
model = zstate.load_model("rrbot")
with zstate.connect() as session, zstate.StatePublisher(session, model) as publisher:
    moving = threading.Thread(target=lambda: publisher.run(SineSource(model), 50.0))
    moving.start()
    codes = {}
    commands = ["ls", "hz rrbot --once", "echo rrbot --once", "doctor rrbot", "monitor --robots --once"]
    commands += ["record run.mcap rrbot --seconds 1"] if "record" in own_commands() else []
    for command in ("--help", *commands):
        codes[command] = run(command.split())
    publisher.close()
    moving.join()
codes["demo"] = run(["demo", "rrbot", "--seconds", "1"])
print("\\n" + json.dumps([sorted(broken), list(own_commands()), codes]))
"""


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.parametrize("folder", PLUGINS)
def test_without_a_folder_the_rest_starts_and_shows_a_robot(folder: str, tmp_path: Path):
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, f"zstate.{folder}"],
        capture_output=True,
        text=True,
        timeout=8 * DEADLINE_S,
        cwd=tmp_path,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    broken, commands, codes = json.loads(ended.stdout.splitlines()[-1])
    gone = {name for name, one in PLUGINS.items() if name == folder or folder in one.needs}
    of_the_rest = [
        name for name in broken if name.split(".")[1] not in gone and FOR_ANOTHER.get(name) != folder
    ]
    assert of_the_rest == []
    assert not set(commands) & {name for one in gone for name in PLUGINS[one].commands}
    assert set(commands) >= {name for one in PLUGINS.keys() - gone for name in PLUGINS[one].commands}
    assert set(codes.values()) == {0}, (codes, ended.stdout, ended.stderr)
