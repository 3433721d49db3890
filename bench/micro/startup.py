"""How soon a command answers: `ls` and `tree` on a running fleet, and light ones beside a bare program.

    python -m bench.micro.startup [--robots 10] [--robot panda] [--rate 50] [--rounds 10]

Each robot is a `zstate publish` of its own, a peer of this host. A command's time is from its start until
it has ended, so all of its answer is there. By turns with the commands that are only help there runs a
program of one command made with click; ratios are of the medians. Modules are compiled before, as those
of an installed package are.
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

from bench.micro.others import meet_nobody_else, running

LOOKING = (("ls",), ("tree",), ("ls", "--json"), ("tree", "--json"))
LIGHT = (("--version",), ("--help",), ("tree", "--help"), ("up", "--help"))

BARE = """\
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
    meet_nobody_else()
    with tempfile.TemporaryDirectory() as folder:
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = folder
        _light_table(options.rounds, Path(folder))
        _looking_table(options)


def _light_table(rounds: int, folder: Path) -> None:
    bare = folder / "bare.py"
    bare.write_text(BARE)
    commands = [(str(bare), "command", "--help"), *(("-m", "zstate", *light) for light in LIGHT)]
    times = _times(commands, rounds)
    print(f"{'light commands':24}{'median ms':>12}{'longest ms':>12}{'ratio':>8}")
    for name, taken in zip(["a bare program", *map(_name, LIGHT)], times, strict=True):
        ratio = median(taken) / median(times[0])
        print(f"{name:24}{median(taken) * 1e3:12.0f}{max(taken) * 1e3:12.0f}{ratio:8.2f}", flush=True)


def _looking_table(options: argparse.Namespace) -> None:
    with ExitStack() as fleet:
        for number in range(options.robots):
            what = ("publish", options.robot, "--source", "sine", "--rate", str(options.rate))
            fleet.enter_context(running(*what, "--name", f"r{number}"))
        times = _times([("-m", "zstate", *command) for command in LOOKING], options.rounds)
    title = f"{options.robots} x {options.robot}, {options.rate:g} Hz"
    print(f"\n{title:24}{'median ms':>12}{'longest ms':>12}")
    for command, taken in zip(LOOKING, times, strict=True):
        print(f"{_name(command):24}{median(taken) * 1e3:12.0f}{max(taken) * 1e3:12.0f}")


def _name(command: Sequence[str]) -> str:
    return " ".join(("zstate", *command))


def _times(commands: Sequence[Sequence[str]], rounds: int) -> list[list[float]]:
    """Seconds of each of ``commands``, by turns, ``rounds`` times after one that does not count."""
    all_rounds = [[_time_s(command) for command in commands] for _ in range(rounds + 1)]
    return [list(times) for times in zip(*all_rounds[1:], strict=True)]


def _time_s(command: Sequence[str]) -> float:
    began = time.perf_counter()
    subprocess.run([sys.executable, *command], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
