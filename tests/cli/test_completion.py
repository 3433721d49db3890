from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from looking import failure, standing, zstate

pytestmark = pytest.mark.processes


def offered(*words: str) -> list[str]:
    """What bash would be offered for the last of ``words``."""
    line = ["zstate", *words]
    asked = {"_ZSTATE_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(line), "COMP_CWORD": str(len(words))}
    answer = subprocess.run(
        [sys.executable, "-m", "zstate"],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=True,
        timeout=15.0,
    )
    assert answer.stderr == ""
    return answer.stdout.split()


def test_commands_and_their_options_are_offered():
    assert offered("sn") == ["plain,snapshot"]
    assert offered("snapshot", "l") == ["plain,load"]
    assert "plain,--fix-hints" in offered("check", "--f")


def test_models_are_offered_by_name_and_files_besides():
    assert "plain,rrbot" in offered("publish", "rr")
    assert offered("check", "./models/rr") == ["file,./models/rr"]


def test_robots_are_offered_that_are_announced():
    with standing("left"), standing("right"):
        assert offered("tree", "le") == ["plain,left"]
        assert offered("snapshot", "save", "a.toml", "r") == ["plain,right"]


def test_where_nobody_is_announced_nothing_is_offered_and_nothing_said():
    assert offered("echo", "l") == []


def test_parameters_of_a_file_are_offered(tmp_path: Path):
    file = tmp_path / "cell.toml"
    file.write_text("[parameters]\nspeed = 1\nsite = 'lab'\n")
    assert offered("up", str(file), "s") == ["plain,speed=1", "plain,site=lab"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_function_of_a_shell_is_one_that_it_understands(shell: str):
    said = zstate("completion", shell)
    assert said.returncode == 0
    assert b"_ZSTATE_COMPLETE" in said.stdout
    if path := shutil.which(shell):
        assert subprocess.run([path, "-n"], input=said.stdout, check=False).returncode == 0


def test_another_shell_is_told_which_there_are():
    assert "'bash', 'zsh', 'fish'" in failure("completion", "tcsh", code=2)
