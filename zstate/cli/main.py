"""Entry point of the command line: loads and completes commands, handles signals and exit codes.

The error of an invalid command line has a hint: names and forms of ROS tools, unquoted paths, misspelled
options.
"""

from __future__ import annotations

import gc
import os
import re
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import combinations
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zstate.cli.commands import SECTIONS, load_command, load_other_command, own_commands
from zstate.cli.output import logs
from zstate.cli.signals import Ending
from zstate.errors import ZStateError
from zstate.other_plugins import other_plugins
from zstate.plugins import built_in_plugins

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from zstate.net.session import Session

# Commands of other tools, and the equivalent ones of the core; see ``Plugin.synonyms``.
_SYNONYMS = {
    "check_urdf": "check",
    "dummy_joint_states": "joints",
    "info_urdf": "check",
    "joint_state_publisher": "joints",
    "launch": "up FILE.toml",
    "list": "ls",
    "models": "robots",
    "node": "ls",
    "node_list": "ls",
    "nodes": "ls",
    "param": "config",
    "pub": "joints | publish | static",
    "rate": "hz",
    "robot_state_publisher": "publish",
    "roslaunch": "up FILE.toml",
    "rostopic": "ls | echo | hz",
    "rqt": "graph",
    "rqt_graph": "graph",
    "rqt_tf_tree": "tree",
    "run": "up FILE.toml",
    "start": "up FILE.toml | publish | demo",
    "state_publisher": "publish",
    "static_transform_publisher": "static",
    "status": "doctor",
    "tf2": "tf",
    "tf2_echo": "tf",
    "tf2_monitor": "monitor",
    "tf2_tools": "tree",
    "tf_echo": "tf",
    "topic": "ls | echo | hz",
    "topics": "ls",
    "transform_broadcaster": "transform",
    "view_frames": "tree --svg",
    "wtf": "doctor",
}

COMPLETION_VARIABLE = "_ZSTATE_COMPLETE"
"""Set by the completion function of a shell."""

# Robots on this host are discovered in a fraction of this; a longer delay is annoying at a prompt.
_ROBOTS_WITHIN_S = 0.4
# Columns that click leaves free at the right.
_MARGIN = 2
# An example and its comment, in columns.
_EXAMPLE = re.compile(r"( *)(\S.*?) {2,}(# .*)")
# Options of every command that joins the network.
_NETWORK = frozenset(
    ("--mode", "--connect", "--listen", "--config", "--certs", "--identity", "--user", "--password-file")
)


# The least similarity of a suggested option; click's own limit is 0.6.
_NEAR = 0.75

_XYZ = ("--x", "--y", "--z")
_RPY = ("--roll", "--pitch", "--yaw")
_QUATERNION = ("--qx", "--qy", "--qz", "--qw")


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
        return list(own_commands())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        is_own = cmd_name in own_commands()
        command = load_command(cmd_name) if is_own else load_other_command(cmd_name)
        if command is None:
            return None
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
        found = {name: one for name, one in own_commands().items() if name.startswith(incomplete)}
        commands = [CompletionItem(name, help=one.summary) for name, one in found.items()]
        return commands + click.Command.shell_complete(self, ctx, incomplete)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] == "help":
            args = [*args[1:2], "--help"]
            if len(args) == 1:
                click.echo(ctx.get_help())
                ctx.exit()
        is_command = args[0] in own_commands() or args[0].startswith("-")
        if not is_command and load_other_command(args[0]) is None:
            ctx.fail(
                _ros_static_hint(args)
                or f"there is no command {args[0]!r}; {command_hint(args[0], own_commands())}"
            )
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        commands = own_commands()
        width = max(map(len, commands))
        for section in SECTIONS:
            rows = [
                (name.ljust(width), one.summary) for name, one in commands.items() if one.section == section
            ]
            if rows:  # its plugins may be removed
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
    from zstate.cli.options import MODEL

    if argument.type is MODEL:
        return MODEL
    if argument.name == "driver":
        return _Completed(lambda _, incomplete: ["sim"] if "sim".startswith(incomplete) else [], or_file=True)
    if command == "move" and argument.name == "positions":
        return _Completed(_driven_joints, or_file=False)
    if command == "up" and argument.name == "parameters":
        return _Completed(_settings, or_file=False)
    if argument.name in ("robot", "robots"):
        return _Completed(_announced_names, or_file=False)
    return click.Path() if argument.name in ("file", "folder") else argument.type


def _announced_names(ctx: click.Context, incomplete: str) -> Iterator[str]:
    from zstate.net.discovery import discover

    with suppress(ZStateError), _opened_session(ctx) as session:  # the command reports errors
        robots = discover(session, _ROBOTS_WITHIN_S, wire=ctx.params.get("wire") or "native")
        yield from (robot.name for robot in robots if robot.name.startswith(incomplete))


def _driven_joints(ctx: click.Context, incomplete: str) -> Iterator[str]:
    """JOINT= for each joint of the driver of the robot on the command line."""
    from zstate.driving.stops import wait_for_state

    with suppress(ZStateError), _opened_session(ctx) as session:
        state = wait_for_state(session, str(ctx.params.get("robot")), lambda _: True, _ROBOTS_WITHIN_S)
        names = () if state is None else state.joint_names
        yield from (f"{name}=" for name in names if name.startswith(incomplete))


def _opened_session(ctx: click.Context) -> Session:
    """A session with the options of the command line that is completed."""
    from zstate.cli.session import SessionOptions

    get = ctx.params.get
    network = SessionOptions(get("mode"), get("connect") or (), get("listen") or (), get("config"))
    return network.open(_ROBOTS_WITHIN_S)


def _settings(ctx: click.Context, incomplete: str) -> Iterator[str]:
    """KEY=VALUE with the parameters of the file of `zstate up` and their current values."""
    from zstate.cli.up.template import TomlFile

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


def command_hint(name: str, commands: Iterable[str]) -> str:
    """A suggestion for ``name``, which is none of ``commands``."""
    word = name.lower().replace("-", "_")
    tables = [_SYNONYMS, *(plugin.synonyms for plugin in (*built_in_plugins(), *other_plugins()))]
    same = [command for table in tables if word in table for command in table[word].split(" | ")]
    if same:
        return "use " + " or ".join(f"`zstate {command}`" for command in same)
    from difflib import get_close_matches

    near = get_close_matches(name, list(commands), n=1)
    return f"did you mean {near[0]!r}?" if near else "`zstate help` lists the commands"


def usage_hint(arguments: Sequence[str], error: click.UsageError) -> str:
    """The cause of ``error`` and the correction; empty if click's own message is as good."""
    hint = _unquoted_path(arguments) or _ros_static_hint(arguments)
    if hint or not isinstance(error, click.NoSuchOption) or not error.possibilities:
        return hint
    from difflib import SequenceMatcher

    # An unknown option, with suggestions only if they are similar.
    name = error.option_name
    near = [option for option in error.possibilities if SequenceMatcher(None, name, option).ratio() >= _NEAR]
    return f"{error.message} Did you mean {' or '.join(map(repr, near))}?" if near else error.message


def _unquoted_path(arguments: Sequence[str]) -> str:
    """A hint for a path with a space, which the shell has split into several arguments."""
    for first, end in combinations(range(len(arguments) + 1), 2):
        path = " ".join(arguments[first:end])
        with suppress(OSError, ValueError):  # no path
            if end - first > 1 and not path.startswith("-") and Path(path).exists():
                return f"{path!r} is one path with a space in it; write it in quotes: {shlex.quote(path)}"
    return ""


def _ros_static_hint(arguments: Sequence[str]) -> str:
    """Arguments of ROS's static_transform_publisher, in either form, as arguments of `zstate static`."""
    if not arguments or arguments[0] not in ("static", "static_transform_publisher"):
        return ""
    static = _from_options(arguments[1:]) or _from_positions(arguments[1:])
    form = "that is the form of ROS's static_transform_publisher; here it is"
    return f"{form}\n  zstate static {static}" if static else ""


def _from_positions(arguments: Sequence[str]) -> str:
    """``x y z yaw pitch roll parent child``, or with ``qx qy qz qw`` for the angles."""
    numbers, frames = arguments[:-2], arguments[-2:]
    if len(numbers) not in (6, 7) or not all(map(_is_number, numbers)) or any(map(_is_number, frames)):
        return ""
    rotation = ("--quat-xyzw", *numbers[3:]) if len(numbers) == 7 else ("--rpy", *numbers[:2:-1])
    return f"{shlex.join(frames)} --xyz {' '.join((*numbers[:3], *rotation))}"


def _from_options(arguments: Sequence[str]) -> str:
    """``--x 1 ... --frame-id parent --child-frame-id child``."""
    options = {*_XYZ, *_RPY, *_QUATERNION, "--frame-id", "--child-frame-id"}
    parts = [part for argument in arguments for part in argument.split("=", 1)]
    values = {name: value for name, value in zip(parts[::2], parts[1::2], strict=False) if name in options}
    if not values or 2 * len(values) != len(parts):
        return ""
    frames = values.get("--frame-id", "TARGET"), values.get("--child-frame-id", "SOURCE")
    static = [shlex.join(frames)]
    for option, names, default in (
        ("--xyz", _XYZ, "0 0 0"),
        ("--rpy", _RPY, "0 0 0"),
        ("--quat-xyzw", _QUATERNION, "0 0 0 1"),
    ):
        if any(name in values for name in names):
            numbers = [values.get(name, zero) for name, zero in zip(names, default.split(), strict=True)]
            static.append(f"{option} {' '.join(numbers)}")
    return " ".join(static)


def _is_number(text: str) -> bool:
    with suppress(ValueError):
        float(text)
        return True
    return False


def main() -> NoReturn:
    """Run the command line and exit: 0, 1 for a failure, 2 for wrong usage, 130 after Ctrl-C."""
    logs.use_environment_format()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _end)
    _exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> str | int:
    """Run a command; what it raises for users is written to standard error. Returns the exit code."""
    try:
        return group.main(list(arguments), prog_name="zstate", standalone_mode=False) or 0
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 0
    except click.UsageError as error:
        text = usage_hint(arguments, error) or error.format_message()
        text += f"\nSee `{error.ctx.command_path} --help`." if error.ctx else ""
        code = error.exit_code
    except click.ClickException as error:
        text, code = error.format_message(), error.exit_code
    except ZStateError as error:
        text, code = str(error), 1
    except SystemExit as leaving:
        return leaving.code or 0
    finally:
        _ending.close()
    logs.write(text, level="error", event="failed")
    return code


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


_ending = Ending()


def _end(number: int, _: FrameType | None) -> None:
    # An orderly exit takes well under a second; a second signal ends it at once.
    if _ending.is_repeated(number):
        return
    if _ending.has_begun:
        os._exit(128 + number)
    _ending.begin(number)
