"""A page with terminals, of the tutorial or a guide: their commands run, and their output is compared."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple

from helpers.pages import blocks
from helpers.processes import until

FOLDER = Path(__file__).parents[2] / "models" / "tutorial"

_DONE = "exercise done: "

# Patterns of text that differs from run to run; the first match applies.
_MASKS = {
    r"pid \d+": "pid N",
    r"@[\w.-]+ pid": "@HOST pid",
    r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d": "DATE",
    r"127\.0\.0\.1:\d+": "PORT",
    r"\b(rate_hz|ticks|skipped|late)=[\d.]+": r"\1=COUNT",
    r"\d+\.\d+\.\d+\w*": "VERSION",
    r"\(\d+\.\d{9}\)": "(STAMP)",
    # Ten digits are 1 s: in one exercise, the stamp is the machine's uptime [ns].
    r"\d+\.\d{9}|\b\d{10,}\b": "STAMP",
    r"\d+\.\d+ Hz": "RATE",
    r"-?\d+(\.\d+)? (ns|us|ms|s|days)\b": "TIME",
    r"-?\d+\.\d{3,4}\b": "NUMBER",
    r"(ahead of|behind) this": "BESIDE this",
    r"(/\S+)+/arm\.urdf": "PATH/arm.urdf",
    r"kernel \w+": "kernel KIND",
    r"-USR1 \d+": "-USR1 N",
    r"\d+(\.\d+)?(?= (k|M|G)?B\b)": "SIZE",
    r"router [0-9a-f]+": "router ID",
    r"(?<=skipped )\d+|\d+(?= (messages|rows|samples|setpoints|stopped)\b)": "COUNT",
    # An unplugged cable is noticed while the driver reads, or while it writes.
    r"\w*([Ee]rror|Exception)\(.*?\)(?=;|$)": "EXCEPTION",
    r"that of [\w-]+@": "that of WRITER@",
    r"(?<=\S) +": " ",
    r" (0|\+?TIME) ([\w-]+@HOST)": r" CLOCK \2",
}


class TerminalStep(NamedTuple):
    """A command in a terminal of the page, and the output below it.

    Without a command: what the last program that runs on in that terminal prints then.
    """

    terminal: str
    command: str
    lines: list[str]
    runs_on: bool
    """Whether it is a program that goes on; its lines may come in another order."""


class TutorialPage:
    """The blocks of a page. In those of terminals, ``$ `` or ``2$ `` is before a command.

    ``2> `` is before a line that a program prints which was started in terminal 2 before. A line ``...``
    stands for any lines.
    """

    def __init__(self, text: str) -> None:
        self._text = text

    def steps(self) -> list[TerminalStep]:
        """All commands of the page, in order, and the output between them."""
        found: list[TerminalStep] = []
        for line in "".join(blocks("console", self._text)).splitlines():
            prompt = re.match(r"(\d?)\$ |(\d)> ", line)
            text = line[prompt.end() :] if prompt else line
            if not prompt:
                found[-1].lines.append(text)
            elif prompt[2] is None:
                found.append(TerminalStep(prompt[1], text, [], text.endswith(" &")))
            elif (found[-1].terminal, found[-1].command) == (prompt[2], ""):
                found[-1].lines.append(text)
            else:
                _let_run_on(found, prompt[2])
                found.append(TerminalStep(prompt[2], "", [text], runs_on=True))
        return found


def _let_run_on(steps: list[TerminalStep], terminal: str) -> None:
    """The program that prints more in ``terminal`` runs on: one in the background, or the last one."""
    commands = [n for n, step in enumerate(steps) if step.terminal == terminal and step.command]
    if not any(steps[n].command.endswith(" &") for n in commands):
        steps[commands[-1]] = steps[commands[-1]]._replace(runs_on=True)


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


def shows(output: list[str], expected: list[str]) -> bool:
    """Whether ``expected`` is ``output``, except that a line ``...`` stands for any lines."""
    if not expected:
        return not output
    if expected[0] == "...":
        return any(shows(output[n:], expected[1:]) for n in range(len(output) + 1))
    return output[:1] == expected[:1] and shows(output[1:], expected[1:])


def check_page(page: TutorialPage, folder: Path) -> None:
    """Runs all commands of ``page`` in ``folder``, and compares their output."""
    with ExitStack() as opened:
        terminals: dict[str, Terminal] = {}
        for step in page.steps():
            if step.terminal not in terminals:
                terminals[step.terminal] = opened.enter_context(
                    closing(Terminal(folder, f".terminal{step.terminal}-"))
                )
            output, expected = masked(terminals[step.terminal].run(step)), masked(step.lines)
            same = shows(output, expected) or (step.runs_on and sorted(output) == sorted(expected))
            assert same, (step.command, output, expected)


class Terminal:
    """A bash process in the folder of the exercise; ``log`` begins the names of its files there."""

    def __init__(self, folder: Path, log: str) -> None:
        self._folder = folder
        self._log = log
        self._logs: list[Path] = []
        self._lines_read = 0
        self._in_foreground = False
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

    def run(self, step: TerminalStep) -> list[str]:
        """The output of a command; of a program that runs on, once it has the expected number of lines."""
        if not step.command:
            return self._next_lines(len(step.lines))
        end = "wait $!; " if self._in_foreground else ""
        self._in_foreground = step.runs_on and not step.command.endswith(" &")
        if not step.runs_on:
            return self._done(f"{end}{{ {step.command}; }} </dev/null")
        self._logs.append(self._folder / f"{self._log}{len(self._logs)}")
        self._logs[-1].touch()
        self._lines_read = 0
        self._done(f"{end}{step.command.removesuffix(' &')} >{self._logs[-1]} 2>&1 </dev/null &")
        return self._next_lines(len(step.lines))

    def _next_lines(self, count: int) -> list[str]:
        """The next ``count`` lines of the last program that runs on."""
        first, end = self._lines_read, self._lines_read + count
        log = self._logs[-1]
        until(lambda: len(log.read_text().splitlines()) >= end)
        self._lines_read = end
        return log.read_text().splitlines()[first:end]

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
