"""Entry point of the command line: loads and completes commands, handles signals and exit codes."""

from __future__ import annotations

import gc
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zstate.cli.output import logs
from zstate.errors import ZStateError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

# name: (section of the help, summary); zstate.cli.commands.<name> holds the command <name>_command.
_COMMANDS = {
    "demo": ("Start here", "A robot that moves, its state over Zenoh, and a live table of it."),
    "publish": ("Write", "Publish a robot's state: its model, fixed edges, and transforms."),
    "joints": ("Write", "Publish a sine on every joint, and nothing else."),
    "static": ("Write", "Publish one edge that never moves, until Ctrl-C."),
    "transform": ("Write", "Publish moving edges: one pose at a rate, or lines of JSON."),
    "tf": ("Look", "The pose of one frame in another."),
    "monitor": ("Look", "How samples come in, by edge or by robot: rates, latencies, losses."),
    "tree": ("Look", "The frames of the announced robots, as a tree."),
    "ls": ("Look", "The announced robots and their writers."),
    "graph": ("Look", "The writers and readers of each stream."),
    "echo": ("Look", "Joint states, one document each."),
    "hz": ("Look", "The rate at which samples come in."),
    "doctor": ("Look", "What is wrong, and what to do next."),
    "wait": ("Look", "Wait until a robot, a pose or a router is there."),
    "config": ("Look", "The settings in effect, and where each comes from."),
    "view": ("Look", "The robots, drawn in a browser, and moved from there."),
    "plot": ("Look", "Joint positions, or the path of a frame, over time."),
    "check": ("Look", "The contents and findings of a robot model."),
    "robots": ("Look", "The robots that are known by name, such as panda."),
    "record": ("Record", "Record robots into MCAP files."),
    "replay": ("Record", "Publish a recording again."),
    "recover": ("Record", "A complete file of a recording that was cut off."),
    "info": ("Record", "The contents of a recording."),
    "export": ("Record", "The joint states and poses of a recording as a table."),
    "snapshot": ("Record", "Save the state of robots to a file, and publish it again."),
    "bridge": ("Run", "Carry robots between zstate and ROS 2, both ways."),
    "router": ("Run", "A Zenoh router."),
    "acl": ("Run", "Access control for the configuration of a router."),
    "certs": ("Run", "Certificates for tests: an authority and identities."),
    "ros1": ("Run", "A bridge to ROS 1, in either direction."),
    "up": ("Run", "Start several processes from one file."),
    "init": ("Run", "Write a commented file for `zstate up`."),
    "completion": ("Run", "Set up completion in a shell."),
}


COMPLETION_VARIABLE = "_ZSTATE_COMPLETE"
"""Set by the completion function of a shell."""

# Robots on this host are discovered in a fraction of this; a longer delay is annoying at a prompt.
_ROBOTS_WITHIN_S = 0.4
# The arguments that are models, by command.
_MODELS = {"check": "file", "demo": "robot", "init": "robot", "joints": "robot", "publish": "robot"}

# Columns that click leaves free at the right.
_MARGIN = 2
# An example and its comment, in columns.
_EXAMPLE = re.compile(r"( *)(\S.*?) {2,}(# .*)")
# Options of every command that joins the network.
_NETWORK = frozenset(
    ("--mode", "--connect", "--listen", "--config", "--certs", "--identity", "--user", "--password-file")
)


class HelpFormatter(click.HelpFormatter):
    """click's formatter with two changes.

    The network options, equal for every command, get a section of their own below the other options.
    An example stays on one line; a comment that does not fit goes on the line above.
    """

    def write_dl(self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2) -> None:
        rows = list(rows)
        network = [row for row in rows if row[0].split(" ")[0] in _NETWORK]
        if len(network) < len(_NETWORK):
            super().write_dl(rows, col_max, col_spacing)
            return
        super().write_dl([row for row in rows if row not in network], col_max, col_spacing)
        self.dedent()
        with self.section("Network, the same for every command"):
            super().write_dl(network, col_max, col_spacing)
        self.indent()

    def getvalue(self) -> str:
        lines: list[str] = []
        for line in super().getvalue().split("\n"):
            example = _EXAMPLE.fullmatch(line)
            if example is None or len(line) <= self.width + _MARGIN:
                lines.append(line)
            else:
                indent, command, comment = example.groups()
                lines += [indent + comment, indent + command]
        return "\n".join(lines)


class HelpContext(click.Context):
    """The context of every command: help is written by ``HelpFormatter``."""

    formatter_class = HelpFormatter


class Commands(click.Group):
    """The commands; ``--help`` imports none of them."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        command = getattr(import_module(f"zstate.cli.commands.{cmd_name}"), f"{cmd_name}_command")
        assert isinstance(command, click.Command)
        for one in (command, *(command.commands.values() if isinstance(command, click.Group) else ())):
            one.context_class = HelpContext
            for parameter in one.params if COMPLETION_VARIABLE in os.environ else ():
                if isinstance(parameter, click.Argument):
                    parameter.type = _completed_type(one.name or "", parameter)
        if logs.log_format_option not in command.params:
            command.params.append(logs.log_format_option)
        return command

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        from click.shell_completion import CompletionItem

        # As click's own groups do, which import every command for its help.
        names = [name for name in _COMMANDS if name.startswith(incomplete)]
        commands = [CompletionItem(name, help=_COMMANDS[name][1]) for name in names]
        return commands + click.Command.shell_complete(self, ctx, incomplete)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] == "help":
            args = [*args[1:2], "--help"]
            if len(args) == 1:
                click.echo(ctx.get_help())
                ctx.exit()
        if args[0] not in _COMMANDS and not args[0].startswith("-"):
            from zstate.cli.usage_hints import command_hint

            ctx.fail(f"there is no command {args[0]!r}; {command_hint(args[0], _COMMANDS)}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, _COMMANDS))
        for section in dict.fromkeys(section for section, _ in _COMMANDS.values()):
            rows = [
                (name.ljust(width), text) for name, (where, text) in _COMMANDS.items() if where == section
            ]
            with formatter.section(section):
                formatter.write_dl(rows)


class _Completed(click.types.StringParamType):
    """Text that a shell completes with the names of ``complete(context, incomplete)``, or else as a file."""

    def __init__(self, complete: Callable[[click.Context, str], Iterable[str]], *, or_file: bool) -> None:
        self._complete, self._or_file = complete, or_file

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        from click.shell_completion import CompletionItem

        found = [CompletionItem(name) for name in self._complete(ctx, incomplete)]
        return [CompletionItem(incomplete, type="file")] if self._or_file and not found else found


def _completed_type(command: str, argument: click.Argument) -> Any:
    """The type of an argument while a shell completes: robots, models, files and parameters."""
    if _MODELS.get(command) == argument.name:
        return _Completed(_catalog_names, or_file=True)
    if command == "up" and argument.name == "parameters":
        return _Completed(_settings, or_file=False)
    if argument.name in ("robot", "robots"):
        return _Completed(_announced_names, or_file=False)
    return click.Path() if argument.name in ("file", "folder") else argument.type


def _catalog_names(_: click.Context, incomplete: str) -> Iterator[str]:
    from zstate.model.catalog import catalog

    return (entry.name for entry in catalog() if entry.name.startswith(incomplete))


def _announced_names(ctx: click.Context, incomplete: str) -> Iterator[str]:
    from zstate.cli.session import SessionOptions
    from zstate.net.presence import discover

    get = ctx.params.get
    network = SessionOptions(get("mode"), get("connect") or (), get("listen") or (), get("config"))
    with suppress(ZStateError), network.open(_ROBOTS_WITHIN_S) as session:  # the command reports errors
        robots = discover(session, _ROBOTS_WITHIN_S, wire=get("wire") or "native")
        yield from (robot.name for robot in robots if robot.name.startswith(incomplete))


def _settings(ctx: click.Context, incomplete: str) -> Iterator[str]:
    """KEY=VALUE with the parameters of the file of `zstate up` and their current values."""
    from zstate.cli.up.toml_file import TomlFile

    with suppress(ZStateError):
        parameters = TomlFile(Path(str(ctx.params.get("file")))).tables.get("parameters", {})
        yield from (f"{key}={value}" for key, value in parameters.items() if key.startswith(incomplete))


def _print_version(ctx: click.Context, _: click.Parameter, is_set: bool) -> None:
    if is_set:
        from zstate import __version__, kernel
        from zstate.model.pinocchio_solver import select_engine

        click.echo(
            f"zstate {__version__} (kernel: {kernel}, transforms of publishers: {select_engine().name})"
        )
        ctx.exit()


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "auto_envvar_prefix": "ZSTATE"},
    epilog="Try `zstate demo`, then `zstate COMMAND --help`. Ctrl-C ends every command.",
)
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version)
@click.option("--until-eof", is_flag=True, hidden=True)
@click.pass_context
def group(ctx: click.Context, until_eof: bool) -> None:
    """A robot's state wherever Zenoh reaches, without ROS."""
    # The program name in announcements of this process.
    sys.argv[0] = f"zstate-{ctx.invoked_subcommand}"
    if until_eof:
        from zstate.cli.processes import end_with_parent

        end_with_parent()


def main() -> NoReturn:
    """Run the command line and exit: 0, 1 for a failure, 2 for wrong usage, 130 after Ctrl-C."""
    logs.use_environment_format()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _end)
    text: str | None = None
    code: str | int | None = 0
    try:
        code = group.main(prog_name="zstate", standalone_mode=False)
    except getattr(click.exceptions, "NoArgsIsHelpError", ()) as error:
        click.echo(error.format_message())  # click before 8.2 prints the help itself
    except click.UsageError as error:
        from zstate.cli.usage_hints import usage_hint

        text = usage_hint(sys.argv[1:], error) or error.format_message()
        text += f"\nSee `{error.ctx.command_path} --help`." if error.ctx else ""
        code = error.exit_code
    except click.ClickException as error:
        text, code = error.format_message(), error.exit_code
    except ZStateError as error:
        text, code = str(error), 1
    except SystemExit as leaving:
        code = leaving.code
    if text is not None:
        logs.write(text, level="error", event="failed")
    _exit(code or 0)


def _exit(code: str | int) -> NoReturn:
    # A thread inside Zenoh during Python's shutdown, such as one still connecting, aborts the process. The
    # thread "zstate exit" is idle if all sessions are closed.
    is_busy = any(thread.daemon and thread.name != "zstate exit" for thread in threading.enumerate())
    if isinstance(code, int) and is_busy:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(code)
    # Python's garbage collection at exit takes 0.1 s after receiving a large fleet.
    gc.freeze()
    sys.exit(code)


def _end(number: int, _: FrameType | None) -> None:
    # An orderly exit takes well under a second; a second signal ends it at once.
    signal.signal(number, lambda number, _: os._exit(128 + number))
    raise SystemExit(128 + number)
