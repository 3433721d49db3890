"""zstate up: several commands from one file, which live and end together."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli import logs
from zstate.cli.console import fail, say

if TYPE_CHECKING:
    from zstate.cli.up.starts import Start

_COLORS = ("cyan", "green", "magenta", "yellow", "blue", "bright_cyan", "bright_green", "bright_magenta")


@click.command("up")
@click.argument("file", type=click.Path(exists=True, dir_okay=False))
@click.argument("parameters", nargs=-1, metavar="[KEY=VALUE]...")
@click.option("--check", "only_check", is_flag=True, help="Say what would start, and start nothing.")
def up_command(file: str, parameters: tuple[str, ...], only_check: bool) -> None:
    """Start what FILE says, and end all of it with Ctrl-C, or when one part fails.

    Each part is a process, its lines begin with its name. `zstate init panda` writes a file to begin with.
    KEY=VALUE changes one of its [parameters].

    \b
    zstate up cell.toml
    zstate up cell.toml rate=500 site=lab
    zstate up cell.toml --check

    With a [router] the rest starts when it is ready, and comes to it unless [network] says otherwise.
    FILE is TOML:

    \b
    include = ["network.toml"]         # more such files, beside this one
    [parameters]                       # "${rate}" anywhere below; then the environment is asked
    rate = 100.0
    robots = "${ROBOTS:-left right}"   # with what holds where ROBOTS is not set
    [router]                           # as `zstate router`; also acl, users, certs, identity, metrics
    listen = ["tcp/0.0.0.0:7447"]
    ros2 = true                        # in the place of rmw_zenohd; false unless given
    [network]                          # session options of all that follows
    mode = "peer"                      # or loopback, lan, client
    connect = ["tcp/192.168.1.10:7447"]
    certs = "fleet"                    # with identity, here or with each robot; user, password_file
    [[robot]]                          # as `zstate publish`
    model = "panda"                    # a name, or a file beside this one
    names = "${robots}"                # one robot for each, "${name}" is its name; or count = 3, and then
                                       # name = "arm${number}"; just name = "left" for one
    source = "sine"                    # "joints", which is the default, or a recording
    rate = "${rate}"
    wires = ["native", "ros2"]         # "native" unless given
    metrics = 9100                     # for Prometheus; the next robot of a loop has the next port
    when = "${SITE:-lab} == lab"       # or true and false; also clock = "sim", takeover = true
    restart = "on-failure"             # or "always"; else a failure ends everything
    [[static]]                         # as `zstate static`
    robot = "l*"                       # whose: a name, a pattern, a list; not needed for one robot
    target = "panda_hand"
    source = "camera"
    xyz = [0.05, 0.0, 0.04]
    rpy_deg = [0.0, -90.0, 0.0]        # or rpy, or quat_xyzw; left out: not turned
    wires = ["native", "ros2"]
    [[static]]
    file = "handeye.yaml"              # of easy_handeye, or printed by `ros2 topic echo /tf_static`
    [[program]]                        # anything else; starts beside this file
    run = "python driver.py ${rate}"   # or a command such as "zstate record run.mcap"
    after = "left"                     # starts when that is ready: a robot, "router", "static", a program
    ready = "driver runs"              # a line with this says it is ready itself; else when it runs
    """
    from zstate.cli.up.cell import read_cell
    from zstate.cli.up.parameters import parsed_settings
    from zstate.cli.up.starts import planned

    settings = parsed_settings(parameters)
    starts = planned(read_cell(file, settings), Path(file), settings)
    if only_check:
        say(_plan_text(starts))
    else:
        _run(starts)


def _plan_text(starts: Sequence[Start]) -> str:
    from zstate.cli.layout import in_columns

    rows = [
        (start.name, shlex.join(start.arguments if start.is_program else ("zstate", *start.arguments)))
        for start in starts
    ]
    return "\n".join(in_columns(rows))


def _run(starts: Sequence[Start]) -> None:
    from zstate.cli.up.supervisor import Supervisor

    failure = Supervisor(starts, _line_printer([start.name for start in starts])).run()
    if failure:
        fail(failure)


def _line_printer(names: Sequence[str]) -> Callable[[str, str, bool], None]:
    width = max(map(len, names))
    prefixes = {name: f"{name:<{width}} | " for name in names}
    if not os.environ.get("NO_COLOR"):
        for number, name in enumerate(names):
            prefixes[name] = click.style(prefixes[name], fg=_COLORS[number % len(_COLORS)])

    def show(name: str, line: str, is_error: bool) -> None:
        if is_error and logs.is_json():
            logs.pass_on(line, part=name)
        else:
            say(prefixes[name] + line)

    return show
