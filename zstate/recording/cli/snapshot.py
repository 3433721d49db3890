"""zstate snapshot: robots saved to a file and published from it."""

from __future__ import annotations

import shlex
from pathlib import Path

import click
from click.core import ParameterSource

from zstate.cli import options
from zstate.cli.output import logs
from zstate.cli.output.console import count_text, fail, print_result, print_status
from zstate.cli.session import SessionOptions, open_session


@click.group("snapshot")
def snapshot_command() -> None:
    """Save the current state of robots and publish it again: models, static edges, joints, configuration.

    \b
    zstate snapshot save cell.toml                     # all robots; or cell.json
    zstate snapshot save arm.toml panda
    zstate snapshot load cell.toml                     # until Ctrl-C
    """


@snapshot_command.command("save")
@click.argument("file", metavar="FILE")
@click.argument("robots", nargs=-1, metavar="[ROBOT]...")
@click.option("--force", is_flag=True, help="Replace an existing FILE.")
@options.timeout_option("How long to wait for announced streams [s].", 3.0)
@options.wire_option
@options.session_options
def save_command(
    *, file: str, robots: tuple[str, ...], force: bool, timeout: float, wire: str, network: SessionOptions
) -> None:
    """Write the announced robots, or the named ones, to FILE: TOML, or JSON for a name in .json.

    Saves the model of each, its static edges by writer, its joint positions, its publishers, and the session
    options of this command. FILE may be "-" for standard output.

    \b
    zstate snapshot save cell.toml
    zstate snapshot save - panda | less
    """
    from zstate.recording.cli.snapshot_capture import capture

    path = Path(file)
    if file != "-" and path.exists() and not force:
        fail(f"{file!r} exists; --force replaces it")
    with open_session(network, (wire,)) as session:
        snapshot = capture(session, network, robots, wire, timeout)
    text = snapshot.as_json() if path.suffix == ".json" else snapshot.as_toml()
    if file == "-":
        print_result(text.rstrip("\n"))
        return
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        fail(f"{file!r} cannot be written: {error.strerror}")
    size = f"{count_text(len(snapshot.robot), 'robot')}, {count_text(len(snapshot.static), 'static edge')}"
    print_status(f"wrote {file} ({size}); `zstate snapshot load {shlex.quote(file)}` publishes it again")


@snapshot_command.command("load")
@click.argument("file", type=options.EXISTING_FILE)
@click.argument("robots", nargs=-1, metavar="[ROBOT]...")
@click.option("--rate", type=options.RATE, default=10.0, show_default=True, help="Rate of the joint states.")
@click.option(
    "--as-saved",
    is_flag=True,
    help="Use the session options and the wire with which FILE was saved; options below take precedence.",
)
@options.seconds_option
@options.takeover_option
@options.wires_option
@options.session_options
def load_command(
    *,
    file: str,
    robots: tuple[str, ...],
    rate: float,
    as_saved: bool,
    seconds: float | None,
    takeover: bool,
    wires: tuple[str, ...],
    network: SessionOptions,
) -> None:
    """Publish the robots of FILE, or the named ones, until Ctrl-C, with the saved joint positions.

    Joint states are stamped with the current time. Nothing leaves this host unless you pass session options
    or --as-saved. Passwords and certificates are not in FILE.

    \b
    zstate snapshot load cell.toml
    zstate snapshot load cell.toml --as-saved          # with the session options it was saved with
    zstate snapshot load cell.toml panda --wire ros2
    """
    from zstate.recording.cli.snapshot_file import publish_snapshot, read_snapshot

    snapshot = read_snapshot(Path(file))
    selected, edges = snapshot.select(robots)
    if not selected and not edges:
        fail(f"{file!r} contains no robot")
    saved, source = snapshot.configuration, click.get_current_context().get_parameter_source("wires")
    has_wire_option = source != ParameterSource.DEFAULT
    if as_saved:
        network, wires = saved.network(network), wires if has_wire_option else (saved.wire,)
        if not saved.is_default:
            print_status(f"as saved on {saved.host!r}: {saved.options()}")
    elif not (saved.is_default or network.is_explicit or has_wire_option):
        print_status(f"saved on {saved.host!r} with {saved.options()}; --as-saved uses the same options")
    with open_session(network, wires) as session:
        publish_snapshot(session, selected, edges, wires, takeover=takeover, rate_hz=rate, seconds=seconds)


for command in snapshot_command.commands.values():
    command.params.append(logs.log_format_option)
