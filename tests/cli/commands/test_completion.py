from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from helpers.cli_runner import MAIN, failure, published_robot, run_cli
from helpers.processes import DEADLINE_S, Child, until
from helpers.programs import driver

CLEARED = "\x15"
"""Ctrl-U, which empties the line."""


def offered(*words: str) -> list[str]:
    """What bash would be offered for the last of ``words``."""
    line = ["zstate", *words]
    with pytest.MonkeyPatch.context() as shell:
        shell.setenv("_ZSTATE_COMPLETE", "bash_complete")
        shell.setenv("COMP_WORDS", " ".join(line))
        shell.setenv("COMP_CWORD", str(len(words)))
        answer = Child(MAIN)
    assert answer.wait() == 0
    assert answer.stderr == ""
    return answer.rest().split()


def test_commands_and_their_options_are_offered():
    assert offered("sn") == ["plain,snapshot"]
    assert offered("snapshot", "l") == ["plain,load"]
    assert "plain,--fix-hints" in offered("check", "--f")


def test_completion_offers_models_by_name_and_files():
    assert "plain,rrbot" in offered("publish", "rr")
    assert offered("check", "./models/rr") == ["file,./models/rr"]


def test_announced_robots_are_offered():
    with published_robot("left"), published_robot("right"):
        assert offered("tree", "le") == ["plain,left"]
        assert offered("snapshot", "save", "a.toml", "r") == ["plain,right"]


@pytest.mark.processes
def test_drivers_and_the_joints_of_a_driver_are_offered():
    assert offered("drive", "s") == ["plain,sim"]
    assert offered("drive", "sim", "rr") == ["plain,rrbot"]
    with driver():
        until(lambda: offered("move", "rrbot", "sh") == ["plain,shoulder="])


def test_completion_without_robots_offers_and_prints_nothing():
    assert offered("echo", "l") == []


def test_parameters_of_a_file_are_offered(tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text("[parameters]\nspeed = 1\nsite = 'lab'\n")
    assert offered("up", str(file), "s") == ["plain,speed=1", "plain,site=lab"]


class Typist:
    """Sits at a shell that has been taught, and types."""

    def __init__(self, *shell: str) -> None:
        self._terminal, theirs = pty.openpty()
        self._shell = subprocess.Popen(
            shell, stdin=theirs, stdout=theirs, stderr=theirs, env=with_zstate(), start_new_session=True
        )
        os.close(theirs)
        os.set_blocking(self._terminal, False)
        self._screen = ""
        # Wide, because shells redraw a line that reaches the edge.
        self.type("stty columns 200\r")
        self.type(f'eval "$(zstate completion {Path(shell[0]).name})" && echo taught $((40 + 2))\r')
        self.sees("taught 42")

    def __enter__(self) -> Typist:
        return self

    def __exit__(self, *_: object) -> None:
        self._shell.kill()
        self._shell.wait()
        os.close(self._terminal)

    def type(self, text: str) -> None:
        self._screen = ""
        os.write(self._terminal, text.encode())

    def completed(self, line: str, whole: str) -> None:
        """Tab makes ``whole`` of ``line``."""
        self.type(line + "\t")
        self.sees(whole)
        self.type(CLEARED)

    def sees(self, text: str) -> None:
        until(lambda: text in self._looked())

    def _looked(self) -> str:
        with suppress(BlockingIOError):
            self._screen += os.read(self._terminal, 65536).decode(errors="replace")
        return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]|[\x00-\x1f]", "", self._screen)


def with_zstate() -> dict[str, str]:
    """An environment where `zstate` is this one, and terminals are plain."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "TERM": "dumb", "PS1": "$ "}


@pytest.mark.processes
@pytest.mark.parametrize(
    "shell",
    [
        pytest.param(("bash", "--norc", "--noprofile", "-i"), id="bash"),
        pytest.param(("zsh", "-f", "-i"), id="zsh", marks=pytest.mark.shells),
    ],
)
def test_tab_completes_commands_options_robots_and_files(
    shell: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "cell.toml").touch()
    monkeypatch.chdir(tmp_path)
    with published_robot("lefty"), Typist(*shell) as typist:
        typist.completed("zstate sn", "zstate snapshot ")
        typist.completed("zstate check --f", "zstate check --fix-hints ")
        typist.completed("zstate tree le", "zstate tree lefty ")
        typist.completed("zstate publish rr", "zstate publish rrbot ")
        typist.completed("zstate up ce", "zstate up cell.toml ")


@pytest.mark.processes
@pytest.mark.shells
def test_fish_is_offered_the_same_with_all_of_the_help(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "cell.toml").touch()
    monkeypatch.chdir(tmp_path)
    lines = ("sn", "check --f", "tree le", "publish rr", "up ce")
    asked = "; ".join(f"complete -C 'zstate {line}'" for line in lines)

    def completed() -> list[str]:
        command = ["fish", "--no-config", "-c", f"zstate completion fish | source; {asked}"]
        return subprocess.run(
            command, env=with_zstate(), capture_output=True, text=True, check=True, timeout=DEADLINE_S
        ).stdout.splitlines()

    with published_robot("lefty"):
        until(lambda: "lefty" in completed(), 60.0)  # a busy machine finds no robot in the time of a Tab
        snapshot, fix_hints, *others = completed()
    assert snapshot.split("\t") == ["snapshot", group_help("snapshot")]
    assert fix_hints.startswith("--fix-hints\t")
    assert set(others) - {"lefty"} == {"rrbot", "cell.toml"}


def group_help(command: str) -> str:
    """The description of ``command`` in `zstate --help`; it has a comma."""
    (line,) = (line for line in run_cli("--help").stdout.splitlines() if line.split()[:1] == [command])
    text = line.split(maxsplit=1)[1]
    assert "," in text
    return text


def test_unsupported_shell_error_lists_the_supported_ones():
    assert "'bash', 'zsh', 'fish'" in failure("completion", "tcsh", code=2)
