"""zstate snapshot: robots as they are, into a file and out of it again."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from zstate.cli import logs
from zstate.cli.network import Network, open_session
from zstate.cli.options import (
    checked_rate,
    seconds_option,
    session_options,
    takeover_option,
    timeout_option,
    wire_option,
    wires_option,
)
from zstate.cli.output.console import count_text, fail, print_result, print_status

if TYPE_CHECKING:
    from zstate.cli.snapshot.snapshot import Configuration

_RATE_HZ = 10.0


@click.group("snapshot")
def snapshot_command() -> None:
    """Save robots as they are now, and say it again: models, static edges, joints, configuration.

    \b
    zstate snapshot save cell.toml                     # all robots; or cell.json
    zstate snapshot save arm.toml panda
    zstate snapshot load cell.toml                     # until Ctrl-C
    """


@snapshot_command.command("save")
@click.argument("file", metavar="FILE")
@click.argument("robots", nargs=-1, metavar="[ROBOT]...")
@click.option("--force", is_flag=True, help="Also where there is such a file already.")
@timeout_option("How long to wait for what is announced.", 3.0)
@wire_option
@session_options
def save_command(
    *, file: str, robots: tuple[str, ...], force: bool, timeout: float, wire: str, network: Network
) -> None:
    """Write the announced robots, or the named ones, to FILE: TOML, or JSON for a name in .json.

    That is the model of each, its static edges by their writers, where its joints are now, who writes for
    it, and how this command joined the network. FILE may be "-" for standard output.

    \b
    zstate snapshot save cell.toml
    zstate snapshot save - panda | less
    """
    from zstate.cli.snapshot.taking import taken
    from zstate.cli.snapshot.text import json_text, toml_text

    path = Path(file)
    if file != "-" and path.exists() and not force:
        fail(f"{file!r} exists; --force replaces it")
    with open_session(network, (wire,)) as session:
        snapshot = taken(session, network, robots, wire, timeout)
    text = json_text(snapshot) if path.suffix == ".json" else toml_text(snapshot)
    if file == "-":
        print_result(text.rstrip("\n"))
        return
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        fail(f"{file!r} cannot be written: {error.strerror}")
    size = f"{count_text(len(snapshot.robot), 'robot')}, {count_text(len(snapshot.static), 'static edge')}"
    print_status(f"wrote {file} ({size}); `zstate snapshot load {shlex.quote(file)}` says it again")


@snapshot_command.command("load")
@click.argument("file", type=click.Path(exists=True, dir_okay=False))
@click.argument("robots", nargs=-1, metavar="[ROBOT]...")
@click.option(
    "--rate",
    type=float,
    callback=checked_rate,
    default=_RATE_HZ,
    show_default=True,
    metavar="HZ",
    help="How often the joints are said.",
)
@click.option(
    "--as-saved",
    is_flag=True,
    help="Join the network, and speak the wire, as whoever saved FILE; the options below come first.",
)
@seconds_option
@takeover_option
@wires_option
@session_options
def load_command(
    *,
    file: str,
    robots: tuple[str, ...],
    rate: float,
    as_saved: bool,
    seconds: float | None,
    takeover: bool,
    wires: tuple[str, ...],
    network: Network,
) -> None:
    """Publish the robots of FILE, or the named ones, until Ctrl-C: they stand as they stood.

    Their joints are stamped with the time it is now. Nothing leaves this host, wherever the robots of FILE
    were, unless options or --as-saved say so. Passwords and certificates are not in FILE.

    \b
    zstate snapshot load cell.toml
    zstate snapshot load cell.toml --as-saved          # back to where it was taken
    zstate snapshot load cell.toml panda --wire ros2
    """
    from zstate.cli.snapshot.loading import Standing, chosen
    from zstate.cli.snapshot.snapshot import read_snapshot

    snapshot = read_snapshot(Path(file))
    shots, statics = chosen(snapshot, robots)
    if not shots and not statics:
        fail(f"{file!r} has no robot in it")
    network, wires = _joining(snapshot.configuration, network, wires, as_saved=as_saved)
    with (
        open_session(network, wires) as session,
        Standing(session, shots, statics, wires, takeover=takeover) as standing,
    ):
        standing.run(rate, seconds)


def _joining(
    saved: Configuration, network: Network, wires: tuple[str, ...], *, as_saved: bool
) -> tuple[Network, tuple[str, ...]]:
    """How to join the network, and what to speak; says where that is not as it was saved, or is as saved."""
    is_wire_said = click.get_current_context().get_parameter_source("wires") != ParameterSource.DEFAULT
    if as_saved:
        if not saved.is_plain:
            print_status(f"as saved on {saved.host!r}: {saved.options()}")
        return saved.network(network), wires if is_wire_said else (saved.wire,)
    if not (saved.is_plain or network.is_given or is_wire_said):
        print_status(f"it was saved on {saved.host!r} with {saved.options()}; --as-saved does the same here")
    return network, wires


for command in snapshot_command.commands.values():
    command.params.append(logs.log_format_option)
