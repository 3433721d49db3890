from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from zstate.cli.main import group

COMMANDS = sorted(path.stem for path in (Path(__file__).parents[2] / "zstate/cli/commands").glob("[a-z]*.py"))


def test_help_names_every_command_and_imports_nothing_heavy():
    code = (
        "import sys, contextlib\n"
        "from zstate.cli.main import group\n"
        "group.main(['--help'], standalone_mode=False)\n"
        "print({'numpy', 'zenoh', 'pinocchio', 'rich', 'msgspec'} & set(sys.modules))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "set()"
    for command in COMMANDS:
        assert f"  {command} " in output


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help(command: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", sys.argv.copy())
    outcome = CliRunner().invoke(group, [command, "--help"])
    assert outcome.exit_code == 0
    assert "--help" in outcome.output


def test_network_options_follow_the_options_of_the_command():
    text = CliRunner().invoke(group, ["tf", "--help"]).output
    own, _, network = text.partition("Network, the same for every command:")
    assert "--once" in own
    assert "--help" in own
    assert "--connect ENDPOINT" in network
    assert "--connect ENDPOINT" not in own
    for command in ("check", "router", "certs"):
        assert "Network," not in CliRunner().invoke(group, [command, "--help"]).output
