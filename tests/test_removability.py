"""Folders that can be removed: without one, the rest imports, starts, and shows and examines a robot."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.processes import DEADLINE_S, find_free_port

from zstate.plugins import built_in_plugins

PLUGINS = {plugin.name: plugin for plugin in built_in_plugins()}

# Modules of one plugin that are for another one, and are loaded when both are used.
FOR_ANOTHER = {"zstate.odometry.cli.replay": "recording"}

PROGRAM = """
import gc, json, os, pkgutil, sys, threading
from importlib import import_module

def modules_of(package):
    found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.", lambda name: None)
    return [module.name for module in found if not module.name.endswith("__main__")]

# The other libraries are imported once, for all of the processes.
import zstate
for name in modules_of(zstate):
    import_module(name)
for name in [name for name in sys.modules if name.partition(".")[0] == "zstate"]:
    del sys.modules[name]
# A search for garbage in all that was imported takes a third of the time, and copies it for each process.
gc.disable()
gc.freeze()
folders = dict(name.split("=") for name in sys.argv[1:])
running = 0
while folders or running:
    if folders and running < 4:  # they wait more than they compute
        folder, os.environ["ZSTATE_RENDEZVOUS"] = folders.popitem()
        if not os.fork():
            break
        running += 1
    else:
        os.wait()
        running -= 1
else:
    sys.exit()
removed = f"zstate.{folder}"
with open(f"{folder}.txt", "w") as file:
    os.dup2(file.fileno(), 1)
    os.dup2(1, 2)

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name == removed or name.startswith(f"{removed}."):
            raise ModuleNotFoundError(f"{name} is removed", name=name)

sys.meta_path.insert(0, Hidden())
import zstate
broken = set()
for name in modules_of(zstate):
    try:
        import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("zstate."):
            broken.add(name)
gc.enable()
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
    commands += [f"record {folder}.mcap rrbot --seconds 1"] if "record" in own_commands() else []
    for command in ("--help", *commands):
        codes[command] = run(command.split())
    publisher.close()
    moving.join()
codes["demo"] = run(["demo", "rrbot", "--seconds", "1"])
found = {"broken": sorted(broken), "commands": list(own_commands()), "codes": codes}
print("\\n" + json.dumps(found))
"""


@pytest.mark.long
@pytest.mark.processes
def test_without_a_folder_the_rest_starts_and_shows_a_robot(tmp_path: Path):
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, *(f"{folder}=127.0.0.1:{find_free_port()}" for folder in PLUGINS)],
        capture_output=True,
        text=True,
        timeout=len(PLUGINS) * 8 * DEADLINE_S,
        cwd=tmp_path,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    for folder in PLUGINS:
        output = (tmp_path / f"{folder}.txt").read_text()
        assert output.startswith("{", output.rfind("\n", 0, -1) + 1), (folder, output)
        found = json.loads(output.splitlines()[-1])
        broken, commands, codes = found["broken"], found["commands"], found["codes"]
        gone = {name for name, one in PLUGINS.items() if name == folder or folder in one.needs}
        of_the_rest = [
            name for name in broken if name.split(".")[1] not in gone and FOR_ANOTHER.get(name) != folder
        ]
        assert of_the_rest == [], folder
        assert not set(commands) & {name for one in gone for name in PLUGINS[one].commands}, folder
        assert set(commands) >= {name for one in PLUGINS.keys() - gone for name in PLUGINS[one].commands}
        assert set(codes.values()) == {0}, (folder, codes, output)
