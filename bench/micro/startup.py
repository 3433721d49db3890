"""Duration of commands: `ls` and `tree` on a running fleet, and light ones compared with a minimal program.

    python -m bench.micro.startup [--robots 10] [--robot panda] [--rate 50] [--rounds 10]

Each robot is a `zstate publish` of its own, a peer of this host. A command's time is from its start to
its exit. The light commands are interleaved with a click program of one command; ratios are of the medians.
Modules are compiled beforehand, as in an installed package.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median

from bench.micro.processes import running_command, use_own_rendezvous

NETWORK = (("ls",), ("tree",), ("ls", "--json"), ("tree", "--json"))
LIGHT = (("--version",), ("--help",), ("tree", "--help"), ("up", "--help"))

MINIMAL = """\
import click

@click.group()
def group():
    "A program."

@group.command()
@click.option("--number", type=int)
def command(number):
    "A command."

group()
"""


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--rounds", type=int, default=10)
    options = parser.parse_args()
    use_own_rendezvous()
    with tempfile.TemporaryDirectory() as folder:
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = folder
        _light_table(options.rounds, Path(folder))
        _network_table(options)


def _light_table(rounds: int, folder: Path) -> None:
    minimal = folder / "minimal.py"
    minimal.write_text(MINIMAL)
    commands = [(str(minimal), "command", "--help"), *(("-m", "zstate", *light) for light in LIGHT)]
    times = _times(commands, rounds)
    print(f"{'light commands':24}{'median ms':>12}{'longest ms':>12}{'ratio':>8}")
    for name, durations in zip(["minimal program", *map(_name, LIGHT)], times, strict=True):
        ratio = median(durations) / median(times[0])
        print(f"{name:24}{median(durations) * 1e3:12.0f}{max(durations) * 1e3:12.0f}{ratio:8.2f}", flush=True)


def _network_table(options: argparse.Namespace) -> None:
    with ExitStack() as fleet:
        for number in range(options.robots):
            publish = ("publish", options.robot, "--source", "sine", "--rate", str(options.rate))
            fleet.enter_context(running_command(*publish, "--name", f"r{number}"))
        times = _times([("-m", "zstate", *command) for command in NETWORK], options.rounds)
    title = f"{options.robots} x {options.robot}, {options.rate:g} Hz"
    print(f"\n{title:24}{'median ms':>12}{'longest ms':>12}")
    for command, durations in zip(NETWORK, times, strict=True):
        print(f"{_name(command):24}{median(durations) * 1e3:12.0f}{max(durations) * 1e3:12.0f}")


def _name(command: Sequence[str]) -> str:
    return " ".join(("zstate", *command))


def _times(commands: Sequence[Sequence[str]], rounds: int) -> list[list[float]]:
    """Durations [s] of each of ``commands``, interleaved; one more round comes first and is not counted."""
    all_rounds = [[_time_s(command) for command in commands] for _ in range(rounds + 1)]
    return [list(times) for times in zip(*all_rounds[1:], strict=True)]


def _time_s(command: Sequence[str]) -> float:
    began = time.perf_counter()
    subprocess.run([sys.executable, *command], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
