"""The tutorial's page: its files, and the commands and output of its terminal."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from helpers.processes import until

FOLDER = Path(__file__).parents[2] / "models" / "tutorial"
TEXT = (FOLDER / "README.md").read_text()
FILES = {"xml": "arm.urdf", "python": "swing.py", "toml": "cell.toml"}

_DONE = "exercise done: "

# Patterns of text that differs from run to run; the first match applies.
_MASKS = {
    r"pid \d+": "pid N",
    r"@[\w.-]+ pid": "@HOST pid",
    r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d": "DATE",
    r"127\.0\.0\.1:\d+": "PORT",
    r"\d+\.\d+\.\d+\w*": "VERSION",
    r"\(\d+\.\d{9}\)": "(STAMP)",
    # Ten digits are 1 s: in one exercise, the stamp is the machine's uptime [ns].
    r"\d+\.\d{9}|\b\d{10,}\b": "STAMP",
    r"\d+\.\d Hz": "RATE",
    r"-?\d+(\.\d+)? (ns|us|ms|s|days)\b": "TIME",
    r"-?\d+\.\d{3}\b": "NUMBER",
    r"(ahead of|behind) this": "BESIDE this",
    r"(/\S+)+/arm\.urdf": "PATH/arm.urdf",
    r"kernel \w+": "kernel KIND",
    r"that of [\w-]+@": "that of WRITER@",
    r"(?<=\S) +": " ",
    r" (0|\+?TIME) ([\w-]+@HOST)": r" CLOCK \2",
}


class TerminalStep(NamedTuple):
    """A command, and the output below it on the page."""

    command: str
    lines: list[str]

    @property
    def is_background(self) -> bool:
        """Whether it runs in the background; its lines may come in another order."""
        return self.command.endswith(" &")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)


def terminal_steps() -> Iterator[TerminalStep]:
    """All commands of the page, in order."""
    for block in blocks("console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, *lines = part.splitlines()
            yield TerminalStep(command, lines)


def masked(lines: list[str]) -> list[str]:
    """The lines, with masks for text that differs from run to run, and without messages about waiting."""
    found: list[str] = []
    for line in lines:
        for pattern, name in _MASKS.items():
            line = re.sub(pattern, name, line)  # noqa: PLW2901 - one mask after the other
        found.append(line.rstrip())
    return [
        line
        for line in found
        if line and not line.startswith(("waiting: ", "receiving ", "received zstate/"))
    ]


class Terminal:
    """A bash process in the folder of the exercise."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._background = 0
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self._bash = subprocess.Popen(
            ["bash"],
            cwd=folder,
            env={**os.environ, "PATH": path, "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def run(self, one: TerminalStep) -> list[str]:
        """The output of a command; of a background program, once it has the expected number of lines."""
        command = one.command.removesuffix(" &")
        if not one.is_background:
            return self._done(f"{{ {command}; }} </dev/null")
        self._background += 1
        log = self._folder / f".log{self._background}"
        log.touch()
        self._done(f"{command} >{log} 2>&1 </dev/null &")
        until(lambda: len(log.read_text().splitlines()) >= len(one.lines))
        return log.read_text().splitlines()[: len(one.lines)]

    def _done(self, command: str) -> list[str]:
        assert self._bash.stdin
        assert self._bash.stdout
        self._bash.stdin.write(f"{command}\necho '{_DONE}'\n")
        self._bash.stdin.flush()
        return [line.rstrip("\n") for line in iter(self._bash.stdout.readline, f"{_DONE}\n")]

    def close(self) -> None:
        """Kills bash and all processes that it has started."""
        os.killpg(self._bash.pid, 9)
        self._bash.communicate()


@contextmanager
def terminal(folder: Path) -> Iterator[Terminal]:
    opened = Terminal(folder)
    try:
        yield opened
    finally:
        opened.close()
