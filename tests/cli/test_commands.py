from __future__ import annotations

from pathlib import Path

import click
from click.testing import CliRunner

from zstate.cli.commands import own_commands
from zstate.cli.main import group

FILES = {path.stem for path in (Path(__file__).parents[2] / "zstate/cli/commands").glob("[a-z]*.py")}


def test_every_file_of_commands_is_a_command():
    core = {name for name, one in own_commands().items() if one.reference.startswith("zstate.cli.commands.")}
    assert core == FILES


def test_the_help_lists_the_commands_of_plugins_as_well():
    assert {"demo", "scan", "record", "bridge"} <= set(group.list_commands(click.Context(group)))


def test_network_options_follow_the_options_of_the_command():
    text = CliRunner().invoke(group, ["tf", "--help"]).output
    own, _, network = text.partition("Network, the same for every command:")
    assert "--once" in own
    assert "--help" in own
    assert "--connect ENDPOINT" in network
    assert "--connect ENDPOINT" not in own
    for command in ("check", "router", "certs"):
        assert "Network," not in CliRunner().invoke(group, [command, "--help"]).output
