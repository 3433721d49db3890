"""A page with terminals, of the tutorial or a guide: their commands run, and their output is compared."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple

from helpers.pages import terminals
from helpers.processes import until

FOLDER = Path(__file__).parents[2] / "models" / "tutorial"

_DONE = "exercise done: "

# What names this machine, this moment or this process; the first match applies. No figure is among them.
_MASKS = {
    r"pid \d+": "pid N",
    r"@[\w.-]+ pid": "@HOST pid",
    r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d, -?[\d.]+ (ns|us|ms|s)\b": "DATE",
    r"127\.0\.0\.1:\d+": "PORT",
    r"\bzstate \d+\.\d+\.\w+, kernel \w+": "zstate VERSION, kernel KIND",
    r"\b(Pinocchio|Zenoh|Python) \d+\.\d+\.\w+": r"\1 VERSION",
    r"\bby zstate \d+\.\d+\.\w+": "by zstate VERSION",
    r"\b\d{10}\.\d{9}\b|\b\d{19}\b": "STAMP",
    r"(/\S+)+/arm\.urdf": "PATH/arm.urdf",
    r"-USR1 \d+": "-USR1 N",
    r"router [0-9a-f]{1,32}": "router ID",
    r"(ahead of|behind) this": "BESIDE this",
    r"that of [\w-]+@": "that of WRITER@",
    # An unplugged cable is noticed while the driver reads, or while it writes.
    r"\w*([Ee]rror|Exception)\(.*?\)(?=;|$)": "EXCEPTION",
    r"(?<=\S) +": " ",
}

_ORDER = "order"
_VARYING = r"[-+]?\d+(?:\.\d+)?(?: (?:ns|us|ms|s|days)\b)?"
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\d.]*\w)|(?<![\w.])-?\d+\.(?!\w)")


class TerminalStep(NamedTuple):
    """A command in a terminal of the page, and the output below it.

    Without a command: what the last program that runs on in that terminal prints then.
    """

    terminal: str
    command: str
    lines: list[str]
    runs_on: bool
    """Whether it is a program that goes on."""
    varies: tuple[str, ...] = ()
    """Texts of its lines in which ``#`` stands for a number that differs from run to run."""


class TutorialPage:
    """The blocks of a page. In those of terminals, ``$ `` or ``2$ `` is before a command.

    ``2> `` is before a line that a program prints which was started in terminal 2 before. A line ``...``
    stands for any lines. A comment before the block names what differs from run to run, with ``#`` for its
    numbers: ``<!-- varies: # Hz; newest # ago -->``. ``#`` alone is a line that is a number, and ``order``
    the order of the lines, for those of several threads. All other numbers, and the order, are compared.
    """

    def __init__(self, text: str) -> None:
        self._text = text

    def steps(self) -> list[TerminalStep]:
        """All commands of the page, in order, and the output between them."""
        found: list[TerminalStep] = []
        for varies, block in terminals(self._text):
            for line in block.splitlines():
                prompt = re.match(r"(\d?)\$ |(\d)> ", line)
                text = line[prompt.end() :] if prompt else line
                if not prompt:
                    found[-1].lines.append(text)
                elif prompt[2] is None:
                    found.append(TerminalStep(prompt[1], text, [], text.endswith(" &"), varies))
                elif (found[-1].terminal, found[-1].command) == (prompt[2], ""):
                    found[-1].lines.append(text)
                else:
                    _let_run_on(found, prompt[2])
                    found.append(TerminalStep(prompt[2], "", [text], runs_on=True, varies=varies))
        return found

    def unused_marks(self) -> list[str]:
        """The marks that are in no line of their block."""
        return [
            mark
            for varies, block in terminals(self._text)
            for mark in varies
            if mark != _ORDER
            and not any(re.search(_pattern(mark), line) for line in map(_identified, block.splitlines()))
        ]


def _let_run_on(steps: list[TerminalStep], terminal: str) -> None:
    """The program that prints more in ``terminal`` runs on: one in the background, or the last one."""
    commands = [n for n, step in enumerate(steps) if step.terminal == terminal and step.command]
    if not any(steps[n].command.endswith(" &") for n in commands):
        steps[commands[-1]] = steps[commands[-1]]._replace(runs_on=True)


def masked(lines: list[str], varies: Sequence[str] = ()) -> list[str]:
    """The lines without what differs from run to run, and without messages about waiting."""
    found: list[str] = []
    for line in map(_identified, lines):
        for mark in varies:
            line = re.sub(_pattern(mark), lambda _, mark=mark: mark, line)  # noqa: PLW2901 - one after the other
        found.append(line)
    return [
        line
        for line in found
        if line and not line.startswith(("waiting: ", "receiving ", "received zstate/"))
    ]


def _identified(line: str) -> str:
    for pattern, name in _MASKS.items():
        line = re.sub(pattern, name, line)
    return line.rstrip()


def _pattern(mark: str) -> str:
    """Matches the text ``mark`` with a number in place of each ``#``, and any blanks in place of one."""
    if mark == "#":
        return rf"^{_VARYING}$"
    # A number begins where a word does: not in the middle of another one.
    return _VARYING.join(re.escape(part).replace(r"\ ", " +") for part in mark.split("#")).replace(
        _VARYING, rf"(?<![\w.]){_VARYING}"
    )


def is_same(one: str, other: str) -> bool:
    """Whether two lines are the same, except that numbers may differ by one in their last decimal."""
    if _NUMBER.sub("#", one) != _NUMBER.sub("#", other):
        return False
    for a, b in zip(_NUMBER.findall(one), _NUMBER.findall(other), strict=True):
        decimals = max(len(number.partition(".")[2]) for number in (a, b))
        if abs(float(a) - float(b)) > (1.01 * 10.0**-decimals if decimals else 0.0):
            return False
    return True


def shows(output: list[str], expected: list[str]) -> bool:
    """Whether ``expected`` is ``output``, except that a line ``...`` stands for any lines."""
    if not expected:
        return not output
    if expected[0] == "...":
        return any(shows(output[n:], expected[1:]) for n in range(len(output) + 1))
    return bool(output) and is_same(output[0], expected[0]) and shows(output[1:], expected[1:])


def check_page(page: TutorialPage, folder: Path) -> None:
    """Runs all commands of ``page`` in ``folder``, and compares their output."""
    assert page.unused_marks() == []
    with ExitStack() as opened:
        open_terminals: dict[str, Terminal] = {}
        for step in page.steps():
            if step.terminal not in open_terminals:
                open_terminals[step.terminal] = opened.enter_context(
                    closing(Terminal(folder, f".terminal{step.terminal}-"))
                )
            written = open_terminals[step.terminal].run(step)
            output, expected = masked(written, step.varies), masked(step.lines, step.varies)
            if _ORDER in step.varies:
                output, expected = sorted(output), sorted(expected)
            assert shows(output, expected), (step.command, output, expected)


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
