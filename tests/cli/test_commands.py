from __future__ import annotations

from pathlib import Path

import click
from click.testing import CliRunner

from zstate.cli.main import group

COMMANDS = {path.stem for path in (Path(__file__).parents[2] / "zstate/cli/commands").glob("[a-z]*.py")}


def test_every_file_of_commands_is_a_command():
    of_two = {"stop"}  # in the file of `zstate move`
    assert set(group.list_commands(click.Context(group))) - of_two == COMMANDS


def test_network_options_follow_the_options_of_the_command():
    text = CliRunner().invoke(group, ["tf", "--help"]).output
    own, _, network = text.partition("Network, the same for every command:")
    assert "--once" in own
    assert "--help" in own
    assert "--connect ENDPOINT" in network
    assert "--connect ENDPOINT" not in own
    for command in ("check", "router", "certs"):
        assert "Network," not in CliRunner().invoke(group, [command, "--help"]).output
