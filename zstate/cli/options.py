"""Options that several commands share: session, credentials, clock, wire, rates and durations."""

from __future__ import annotations

import functools
import math
import os
import re
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from zstate.cli.output.console import GRACE_S, print_status
from zstate.cli.session import SessionOptions
from zstate.errors import InvalidInput, NoClock

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from zstate.clock import Clock
    from zstate.metrics.endpoint import BindAddress
    from zstate.model.robot import RobotModel
    from zstate.net.security.credentials import Credentials
    from zstate.net.session import Session
    from zstate.streams import Stream

Command = TypeVar("Command", bound=Callable[..., Any])


PASSWORD_VARIABLE = "ZSTATE_PASSWORD"


class Checked(click.types.StringParamType):
    """A parameter type: the value is ``convert(text)``, and InvalidInput from that is wrong usage."""

    def __init__(self, metavar: str, convert: Callable[[Any], Any]) -> None:
        self.name, self._convert = metavar, convert

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return self._convert(value)
        except InvalidInput as error:
            self.fail(str(error), param, ctx)


def number(metavar: str, check: Callable[[float], float]) -> Checked:
    """A number that ``check`` returns unchanged."""
    return Checked(metavar, lambda value: check(click.FLOAT.convert(value, None, None)))


def _parse_time(text: str) -> int:
    """The stamp [ns] of ``text``: UTC in ISO 8601, or itself."""
    if re.fullmatch(r"\d{15,19}", text, re.ASCII):
        return int(text)
    try:
        instant = datetime.fromisoformat(text)
    except ValueError:
        raise InvalidInput(f"{text!r} is no time like 2026-11-20T14:03, and no stamp [ns]") from None
    if instant.tzinfo is None:
        instant = instant.replace(tzinfo=UTC)
    return (instant - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1) * 1000


def _check_rate(rate_hz: float) -> float:
    from zstate.rate import check_rate  # loads numpy, which --help does not need

    return check_rate(rate_hz)


def _check_seconds(seconds: float) -> float:
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise InvalidInput(f"a duration is a positive number of seconds; got {seconds}")
    return seconds


class StreamChoice(click.Choice[str]):
    """The streams that meet ``condition``, of other packages as well: looked up when the choice is used."""

    def __init__(self, condition: Callable[[Stream], bool]) -> None:
        self._condition = condition
        super().__init__(())

    @property
    def choices(self) -> Sequence[str]:
        from zstate.stream_registry import streams_where

        return streams_where(self._condition)

    @choices.setter
    def choices(self, _: object) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """click sets those that it is created with."""


class _Model(click.types.StringParamType):
    """A robot model: the name of a robot, or a file. A shell completes both."""

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        from click.shell_completion import CompletionItem

        from zstate.model.catalog import catalog

        names = [entry.name for entry in catalog() if entry.name.startswith(incomplete)]
        return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


MODEL = _Model()
RATE = number("HZ", _check_rate)
SECONDS = number("S", _check_seconds)

TIME = Checked("TIME", _parse_time)
"""UTC as 2026-11-20T14:03, 2026-11-20T14:03:05.25, or a stamp in nanoseconds; the value is a stamp [ns]."""

_MINUTE_NS = 60 * 10**9
_WINDOW_OPTIONS = (
    click.option("--at", type=TIME, help="Of an archive: the minute from this time (UTC) on."),
    click.option("--from", "start_stamp", type=TIME, help="Of an archive: from this time on."),
    click.option("--to", "end_stamp", type=TIME, help="Of an archive: up to this time."),
)


def window_options(command: Command) -> Command:
    """Add the options of a window of an archive: the command receives ``window``, two stamps or None."""

    @functools.wraps(command)
    def with_window(*, at: int | None, start_stamp: int | None, end_stamp: int | None, **params: Any) -> Any:
        window = None
        if at is not None and start_stamp is None and end_stamp is None:
            window = at, at + _MINUTE_NS
        elif at is None and start_stamp is not None and end_stamp is not None:
            window = start_stamp, end_stamp
        elif (at, start_stamp, end_stamp) != (None, None, None):
            raise click.UsageError("name the window by --at TIME, or by --from TIME --to TIME")
        return command(window=window, **params)

    return _with_options(with_window, _WINDOW_OPTIONS)


EXISTING_FILE = click.Path(exists=True, dir_okay=False)


_IDENTITY_OPTIONS = (
    click.option(
        "--certs",
        envvar="ZSTATE_CERTS",
        type=click.Path(exists=True, file_okay=False),
        metavar="DIR",
        help="Encrypt with ca.pem, NAME.pem and NAME.key of this folder (`zstate certs` makes them).",
    ),
    click.option(
        "--identity",
        envvar="ZSTATE_IDENTITY",
        metavar="NAME",
        help="The certificate in --certs to use; access control identifies this command by it.",
    ),
    click.option(
        "--user",
        envvar="ZSTATE_USER",
        metavar="NAME",
        help=f"User name for a router; its password is in {PASSWORD_VARIABLE}, or in --password-file.",
    ),
    click.option(
        "--password-file",
        envvar="ZSTATE_PASSWORD_FILE",
        type=EXISTING_FILE,
        help="A file that only you can read; its first line is the password of --user.",
    ),
)
_USERS_OPTION = click.option(
    "--users",
    envvar="ZSTATE_USERS",
    type=EXISTING_FILE,
    help="The users that may connect: user:password lines in a file that only you can read; default: all.",
)
_CREDENTIALS = ("certs", "identity", "user", "password_file", "users")
NETWORK = (*_CREDENTIALS, "mode", "connect", "listen", "config")
"""The parameters that ``network`` is made of."""


def session_options(command: Command) -> Command:
    """Add the session and credential options to a command, which receives ``network``, a SessionOptions."""

    @functools.wraps(command)
    def with_network(**params: Any) -> Any:
        own = {name: value for name, value in params.items() if name not in NETWORK}
        return command(network=build_network(params), **own)

    return plain_session_options(with_network)


def plain_session_options(command: Any) -> Any:
    """The session and credential options, each passed on unchanged."""
    return _with_options(command, (*_SESSION_OPTIONS, *_IDENTITY_OPTIONS))


def router_identity_options(command: Command) -> Command:
    """Add the credential options and ``--users`` to a command, which receives ``credentials``."""

    @functools.wraps(command)
    def with_credentials(**params: Any) -> Any:
        own = {name: value for name, value in params.items() if name not in _CREDENTIALS}
        return command(credentials=build_credentials(params), **own)

    return _with_options(with_credentials, (*_IDENTITY_OPTIONS, _USERS_OPTION))


def _with_options(command: Any, options: Sequence[Callable[[Any], Any]]) -> Any:
    for option in reversed(options):
        command = option(command)
    return command


def build_network(params: Mapping[str, Any]) -> SessionOptions:
    """The session options among the ``params`` of a command. Raises as ``build_credentials`` does."""
    mode, connect, listen, config = (params[name] for name in ("mode", "connect", "listen", "config"))
    return SessionOptions(mode, connect, listen, config, build_credentials(params))


def build_credentials(params: Mapping[str, Any]) -> Credentials | None:
    """Credentials from ``params``. Raises UsageError for half a pair, ConfigError for unusable files."""
    certs, identity, user, password_file, users = map(params.get, _CREDENTIALS)
    if (certs is None) != (identity is None):
        has, lacks = ("--certs", "--identity NAME") if identity is None else ("--identity", "--certs DIR")
        raise click.UsageError(f"{has} needs {lacks}")
    if password_file is not None and user is None:
        raise click.UsageError("--password-file needs --user NAME")
    if certs is None and user is None and users is None:
        return None
    from zstate.net.security.credentials import Credentials

    password = None if user is None else _password(user, password_file)
    if certs is None or identity is None:
        return Credentials(user=user, password=password, users=users)
    return Credentials.from_folder(certs, identity, user=user, password=password, users=users)


def _password(user: str, file: str | None) -> str:
    # Never from the command line, which every user of the machine can read.
    if file is not None:
        from zstate.net.security.credentials import password_in

        return password_in(file)
    password = os.environ.get(PASSWORD_VARIABLE)
    if not password:
        raise click.UsageError(
            f"the password of {user!r} is missing; put it into {PASSWORD_VARIABLE} or a --password-file"
        )
    return password


config_option = click.option(
    "--config",
    envvar="ZSTATE_CONFIG",
    type=EXISTING_FILE,
    help="A Zenoh configuration (JSON5); default: the file that ZENOH_CONFIG names.",
)
_SESSION_OPTIONS = (
    click.option(
        "--mode",
        envvar="ZSTATE_MODE",
        type=click.Choice(["peer", "loopback", "lan", "client", "router"]),
        help="How to join the network: loopback never leaves this host, lan is open to the local network and "
        "found by multicast; default: client with --connect alone, client of tcp/127.0.0.1:7447 for a ROS "
        "wire alone, else peer.",
    ),
    click.option(
        "--connect",
        envvar="ZSTATE_CONNECT",
        multiple=True,
        metavar="ENDPOINT",
        help="An endpoint to connect to, such as tcp/192.168.1.10:7447; may be repeated.",
    ),
    click.option(
        "--listen",
        envvar="ZSTATE_LISTEN",
        multiple=True,
        metavar="ENDPOINT",
        help="An endpoint to listen on, such as tcp/0.0.0.0:7448; may be repeated.",
    ),
    config_option,
)


def _check_wire(wire: str) -> str:
    from zstate.wire.registry import get_wire

    get_wire(wire)
    return wire


_WIRE = Checked("WIRE", _check_wire)

wire_option = click.option(
    "--wire",
    envvar="ZSTATE_WIRE",
    type=_WIRE,
    default="native",
    show_default=True,
    help="The wire format: native, ros2 (for rmw_zenoh nodes) or ros2dds (through its bridge); with "
    "options, such as ros2:domain=5,namespace=r1.",
)
wires_option = click.option(
    "--wire",
    "wires",
    envvar="ZSTATE_WIRE",
    type=_WIRE,
    multiple=True,
    default=("native",),
    show_default=True,
    help="The wire format, as in `--wire native --wire ros2:domain=5,namespace=r1`; may be repeated.",
)


def _bind_address(text: str) -> BindAddress:
    from zstate.metrics.endpoint import BindAddress, check_library

    check_library()  # before anything runs
    return BindAddress.parse(text)


takeover_option = click.option(
    "--takeover",
    is_flag=True,
    help="Publish even if another writer is active; listeners use the newest writer.",
)
metrics_option = click.option(
    "--metrics",
    type=Checked("[HOST:]PORT", _bind_address),
    help="Serve metrics for Prometheus over HTTP, by default on this host only; 0 is a free port.",
)


_POSE_OPTIONS = (
    click.option("--xyz", type=float, nargs=3, metavar="X Y Z", help="Position of SOURCE in TARGET [m]."),
    click.option(
        "--rpy-deg", type=float, nargs=3, metavar="R P Y", help="Rotation as in URDF, but in degrees."
    ),
    click.option("--rpy", type=float, nargs=3, metavar="R P Y", help="Rotation as in URDF, in radians."),
    click.option(
        "--quat-xyzw", type=float, nargs=4, metavar="X Y Z W", help="Rotation as a unit quaternion."
    ),
)


def pose_options(command: Command) -> Command:
    """``--xyz`` and three forms of a rotation, under the names of the fields of ``StaticSection``."""
    return _with_options(command, _POSE_OPTIONS)


def json_option(what: str = "One JSON object a line.") -> Callable[[Command], Command]:
    """``--json``, as ``as_json``; ``what`` describes the output."""
    return click.option("--json", "as_json", is_flag=True, help=what)


def form_options(json: str, svg: str) -> Callable[[Command], Command]:
    """``--json`` and picture formats, as ``form``: None for text. The texts describe the output."""

    def with_forms(command: Command) -> Command:
        helps = {"json": json, "svg": svg, "dot": "For Graphviz.", "mermaid": "For Markdown."}
        for form, text in reversed(helps.items()):
            command = click.option(f"--{form}", "form", flag_value=form, help=text)(command)
        return command

    return with_forms


def timeout_option(what: str, default_s: float = 10.0) -> Callable[[Command], Command]:
    """``--timeout`` [s]; ``what`` is its help."""
    return click.option("--timeout", type=SECONDS, default=default_s, show_default=True, help=what)


def named_robot(session: Session, robot: str | None, wire: str) -> str:
    """``robot`` if set, else the only one that ``wire`` can mean or that is announced."""
    from zstate.cli.output.wire_text import is_ros, messages_for
    from zstate.cli.robot_directory import only_robot

    name = robot or messages_for(wire).robot
    if name is not None:
        return name
    if is_ros(wire):
        raise click.UsageError(
            "Missing argument 'ROBOT'; on this wire each robot has a namespace of its name."
        )
    return only_robot(session)


def refuse_topic(robot: str | None, wire: str) -> None:
    """Raise UsageError if ``robot`` is a ROS topic on the native wire."""
    if robot is not None and robot.startswith("/") and wire == "native":
        command = click.get_current_context().command_path
        raise click.UsageError(
            f"{robot!r} is a ROS topic, not a robot; `{command} --wire ros2` reads /joint_states"
        )


def parse_xacro_args(texts: Iterable[str]) -> dict[str, str]:
    """``NAME:=VALUE`` arguments by name. Raises UsageError for any other."""
    arguments: dict[str, str] = {}
    for text in texts:
        name, sign, value = text.partition(":=")
        if not (name and sign):
            raise click.UsageError(f"Got unexpected extra argument ({text}).", click.get_current_context())
        arguments[name] = value
    return arguments


def _parsed_xacro_args(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> dict[str, str]:
    return parse_xacro_args(texts)


xacro_arguments = click.argument(
    "xacro_args", nargs=-1, callback=_parsed_xacro_args, metavar="[NAME:=VALUE]..."
)


def parse_models(texts: Iterable[str]) -> dict[str, dict[str, str]]:
    """Models in their order, each with the xacro arguments that follow it."""
    models: dict[str, dict[str, str]] = {}
    for text in texts:
        if ":=" in text and models:
            models[next(reversed(models))].update(parse_xacro_args([text]))
        else:
            models.setdefault(text, {})
    return models


def load_robot(
    source: str, name: str | None, xacro_args: Mapping[str, str] | None = None
) -> tuple[RobotModel, str]:
    """The model behind a ROBOT argument, and the robot's name on the network.

    The name is ``name`` if set, else the catalog name, else the model's own name.
    """
    from zstate.model.catalog import find_entry
    from zstate.model.load import is_path, load_model
    from zstate.wire.keys import check_robot

    if ":=" in source and not is_path(source):
        raise click.UsageError(f"{source!r} is a xacro argument; name the model before it")
    model = load_model(source, xacro_args=xacro_args or None)
    robot = name or (model.name if is_path(source) or "<" in source else find_entry(source).name)
    try:
        return model, check_robot(robot)
    except InvalidInput as error:
        raise InvalidInput(f"{error}; choose another name with --name") from None


def place_name(file: str) -> str:
    """The name of the place whose map is ``file``: that of the file, as a robot may be named."""
    return re.sub(r"[^\w.-]+", "_", Path(file).stem)


_CLOCKS = click.Choice(["system", "sim"])

clock_option = click.option(
    "--clock",
    envvar="ZSTATE_CLOCK",
    type=_CLOCKS,
    default="system",
    show_default=True,
    help="The clock for stamps and rates: the system's, or the simulated time on zstate/clock or /clock.",
)
reading_clock_option = click.option(
    "--clock",
    envvar="ZSTATE_CLOCK",
    type=_CLOCKS,
    help="The clock that ages are measured with, and that is preferred if robots have different clocks.",
)
rate_option = click.option("--rate", type=RATE, default=100.0, show_default=True, help="Samples a second.")
seconds_option = click.option("--seconds", type=SECONDS, metavar="N", help="End after N seconds.")


def check_end(seconds: float | None, *, once: bool) -> None:
    """Refuse --seconds of a command that ends by itself with --once."""
    if once and seconds is not None:
        raise click.UsageError("--seconds is for output that goes on; --timeout limits the wait for one")


def _check_placer(name: str) -> str:
    from zstate.wire.keys import check_robot

    return check_robot(name)


def _all_placers_if_none(_: click.Context, __: click.Parameter, names: tuple[str, ...]) -> Any:
    return names or None


placer_option = click.option(
    "--placer",
    "placers",
    type=Checked("NAME", _check_placer),
    multiple=True,
    callback=_all_placers_if_none,
    help="Only robot NAME may place the roots of other robots; may be repeated. Default: every robot may.",
)
robot_filter_option = click.option(
    "--robot", default="*", metavar="NAME", help="Subscribe to this robot only; default: all robots."
)
name_option = click.option(
    "--name", metavar="NAME", help="The robot's name on the network; default: the model's name."
)


@contextmanager
def open_clock(
    session: Session, kind: str | None, wire: str, *, timeout_s: float | None = None
) -> Generator[Clock | None]:
    """The clock that ``--clock`` selects; None without the option.

    A simulated clock subscribes on ``wire`` and is yielded once it has received its first message.
    Raises NoClock if none arrives within ``timeout_s``.
    """
    from zstate.clock import SYSTEM, SystemClock, format_stamp  # loads numpy, which --help does not need

    if kind is None or kind == SYSTEM:
        yield None if kind is None else SystemClock()
        return
    from zstate.nodes.clock import SimulatedClock

    with SimulatedClock(session, wire) as clock:
        try:
            clock.wait(GRACE_S if timeout_s is None else min(timeout_s, GRACE_S))
        except NoClock:
            print_status(f"waiting for the simulated time on {clock.key} ...")
            clock.wait(timeout_s)
            print_status(f"received {clock.key}: it is {format_stamp(clock.now())}")
        yield clock
