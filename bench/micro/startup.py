"""Duration of commands: on a running fleet, and light ones compared with a minimal click program.

Each robot is a `zstate publish` of its own, a peer of this host. A command's time is from its start to its
exit, with commands interleaved. Modules are compiled beforehand, as in an installed package.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from bench.micro.form import Row, compared, use_own_rendezvous
from bench.process import running_command

NETWORK = ("ls", "tree", "ls --json", "tree --json")
LIGHT = ("--version", "--help", "tree --help", "up --help")
MINIMAL = "import click\n@click.command()\n@click.option('--number')\ndef command(number): 'A.'\ncommand()\n"


def measure(robots: int = 10, robot: str = "panda", rate: float = 50.0, rounds: int = 10) -> Iterator[Row]:
    """Rows of the light commands, then of those that read the network."""
    use_own_rendezvous()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PYTHONPYCACHEPREFIX"] = folder
        minimal = Path(folder) / "minimal.py"
        minimal.write_text(MINIMAL)
        light = {"a minimal program": [str(minimal), "--help"]}
        light |= {f"zstate {one}": ["-m", "zstate", *one.split()] for one in LIGHT}
        yield from compared("light commands", "s", times_s(light, rounds))
        with ExitStack() as fleet:
            for number in range(robots):
                publish = ("publish", robot, "--source", "sine", "--rate", str(rate), "--name", f"r{number}")
                fleet.enter_context(running_command(*publish))
            times = times_s({f"zstate {one}": ["-m", "zstate", *one.split()] for one in NETWORK}, rounds)
        for name, values in times.items():
            yield Row(f"{robots} x {robot}, {rate:g} Hz: {name}", "s", values)


def times_s(commands: Mapping[str, Sequence[str]], rounds: int) -> dict[str, list[float]]:
    """Durations [s] of each command of this Python; one more round comes first and is not counted."""
    times: dict[str, list[float]] = {name: [] for name in commands}
    for _ in range(rounds + 1):
        for name, command in commands.items():
            begin = time.perf_counter()
            subprocess.run([sys.executable, *command], stdout=subprocess.DEVNULL, check=True)
            times[name].append(time.perf_counter() - begin)
    return {name: values[1:] for name, values in times.items()}
