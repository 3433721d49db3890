"""zstate config: the settings in effect, where each comes from, and what is wrong with them.

Precedence: options, environment variables, a Zenoh configuration file, defaults.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, cast

import click
from click.core import ParameterSource

from zstate._util.format import did_you_mean
from zstate.cli import options
from zstate.cli.options import PASSWORD_VARIABLE, build_credentials, build_network
from zstate.cli.output.console import count_text, print_json, print_result, print_status, print_wrapped
from zstate.cli.output.logs import FORMAT_VARIABLE, FORMATS
from zstate.cli.output.text_layout import in_columns
from zstate.cli.output.wire_text import is_ros
from zstate.cli.session import SessionOptions
from zstate.errors import InvalidInput, ZStateError
from zstate.extension import VARIABLE as KERNEL_VARIABLE
from zstate.extension import kernel

_PREFIX = "ZSTATE_"


@click.command("config")
@click.option(
    "--zenoh", "as_zenoh", is_flag=True, help="The Zenoh settings that differ from Zenoh's defaults."
)
@options.json_option("One JSON object.")
@options.wire_option
@options.reading_clock_option
@options.plain_session_options
@click.pass_context
def config_command(context: click.Context, /, *, as_zenoh: bool, as_json: bool, **_: object) -> None:
    """Show the effective settings of commands, and where each value comes from.

    Precedence: options, environment, Zenoh configuration file, defaults. Pass the options of another command
    to see their effect. Every option of every command can be set in the environment as
    ZSTATE_COMMAND_OPTION, for instance ZSTATE_TF_RATE. Passwords are not shown. Exit code 1 if there is a
    problem, such as a variable that nothing reads.

    \b
    zstate config
    zstate config --connect tcp/192.168.1.10:7447 --certs certs --identity desk
    zstate config --zenoh --mode lan
    zstate config --json
    """
    problems = [*_invalid_settings(context), *_contradictions(context.params), *_unused_variables(context)]
    if as_zenoh:
        differences = _zenoh_settings(context)
        rows = [(path, str(value)) for path, value in differences.items()]
        print_json(differences) if as_json else print_result("\n".join(in_columns(rows)))
    elif as_json:
        print_json({"settings": [asdict(one) for one in _settings(context)], "problems": problems})
    else:
        rows = [(one.name, one.text, one.origin) for one in _settings(context)]
        print_wrapped("\n".join(in_columns([("setting", "value", "from"), *rows])))
    for text in problems:
        print_status(f"zstate: {text}", event="problem")
    raise SystemExit(1 if problems else 0)


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting. ``value`` is None if unset; ``origin`` names its option, variable or file."""

    name: str
    value: Any
    origin: str

    @property
    def text(self) -> str:
        """The value as displayed: "-" for none, a list separated by blanks."""
        value: object = self.value
        if isinstance(value, list):
            between = ", " if self.name == "passing" else " "
            return between.join(map(str, cast("list[object]", value))) or "-"
        return "-" if value is None else str(value)


def _settings(context: click.Context) -> Iterator[Setting]:
    """Every setting of the running command. Raises ConfigError if a configuration file cannot be used."""
    from zstate.wire.registry import DOMAIN_VARIABLE, get_wire
    from zstate.wire.ros2.wire import Ros2Wire

    config = _config_file(context)
    yield from _file_settings(context, config.value) if config.value else _option_settings(context)
    yield config
    for name in ("certs", "identity", "user"):
        yield _option(context, name)
    file, password = _option(context, "password_file"), _variable("password", PASSWORD_VARIABLE, None)
    # Passwords are never displayed.
    hidden = Setting("password", "set" if password.value else None, password.origin)
    yield Setting("password", "set", f"file {file.value}, by {file.origin}") if file.value else hidden
    wire = _option(context, "wire")
    yield wire
    if is_ros(wire.value):
        ros_wire = get_wire(wire.value)
        assert isinstance(ros_wire, Ros2Wire)
        has_domain = re.search(r"\bdomain\s*=", wire.value)
        origin = (wire if has_domain else _variable("ros domain", DOMAIN_VARIABLE, 0)).origin
        yield Setting("ros domain", ros_wire.options.domain, origin)
    yield _option(context, "clock")
    yield _variable("log format", FORMAT_VARIABLE, "text")
    selected = _variable("kernel", KERNEL_VARIABLE, None)
    yield Setting(
        "kernel", str(kernel), selected.origin if selected.value or kernel == "c" else kernel.reason
    )


def _option(context: click.Context, name: str) -> Setting:
    value: Any = context.params[name]
    option = next(one for one in context.command.params if one.name == name)
    source = context.get_parameter_source(name)
    origin = "default"
    if source == ParameterSource.COMMANDLINE:
        origin = f"option {option.opts[0]}"
    elif source == ParameterSource.ENVIRONMENT:
        # The variable of the option itself takes precedence over ZSTATE_COMMAND_OPTION.
        variable = option.envvar
        is_set = isinstance(variable, str) and os.environ.get(variable)
        origin = f"environment {variable if is_set else f'{context.auto_envvar_prefix}_{name.upper()}'}"
    if isinstance(value, tuple):
        value = list(cast("tuple[Any, ...]", value))
    return Setting(option.opts[0].lstrip("-"), value, origin)


def _variable(name: str, variable: str, default: Any) -> Setting:
    value = os.environ.get(variable)
    return Setting(name, value, f"environment {variable}") if value else Setting(name, default, "default")


def _config_file(context: click.Context) -> Setting:
    from zstate.net.config import CONFIG_VARIABLE

    option = _option(context, "config")
    return option if option.value else _variable("config", CONFIG_VARIABLE, None)


def _network(context: click.Context) -> SessionOptions:
    """The session options in effect. Raises ConfigError, and UsageError for incomplete credentials."""
    return build_network({**context.params, "config": _config_file(context).value})


def _option_settings(context: click.Context) -> Iterator[Setting]:
    """Mode and endpoints without a Zenoh configuration file."""
    from zstate.net.config import check_mode, listen_endpoints
    from zstate.net.rendezvous import RENDEZVOUS, RENDEZVOUS_VARIABLE

    mode, connect, listen = (_option(context, name) for name in ("mode", "connect", "listen"))
    params, credentials = context.params, None
    effective = check_mode(SessionOptions(mode.value, params["connect"], params["listen"]).joins_as)
    with suppress(InvalidInput, click.UsageError):  # listed as a problem
        credentials = build_credentials(params)
    implied = f"{connect.origin}, which alone means a router" if connect.value else "default"
    yield mode if mode.value else Setting("mode", effective, implied)
    yield connect
    endpoints = listen_endpoints(effective, params["listen"], credentials)
    yield listen if listen.value else Setting("listen", list(endpoints), "default")
    if effective in ("peer", "loopback") and not (connect.value or listen.value):
        yield _variable("rendezvous", RENDEZVOUS_VARIABLE, RENDEZVOUS)


def _file_settings(context: click.Context, file: str) -> Iterator[Setting]:
    """Mode and endpoints with a Zenoh configuration file."""
    from zstate.net.config import check_mode
    from zstate.net.user_config import user_config

    params = context.params
    network = SessionOptions(params["mode"], params["connect"], params["listen"], file)
    config = user_config(file, check_mode(network.joins_as), network.connect, network.listen)
    default = user_config({}, "peer", (), ())
    mode = json.loads(config.get_json("mode"))
    for name, path in (("mode", "mode"), ("connect", "connect/endpoints"), ("listen", "listen/endpoints")):
        option, text = _option(context, name), config.get_json(path)
        from_file = "default of Zenoh" if text == default.get_json(path) else f"file {file}"
        is_used = option.value and option.value != "peer"  # peer keeps the mode of the file
        value = json.loads(text)
        if isinstance(value, dict):  # one value for each mode
            value = cast("dict[str, Any]", value).get(mode)
        yield Setting(option.name, value, option.origin if is_used else from_file)
    yield from _site_settings(json.loads(str(config)), f"file {file}")


def _site_settings(config: Mapping[str, Any], origin: str) -> Iterator[Setting]:
    """The site whose router has this configuration, and what its uplink passes."""
    from zstate.net.sites import UPLINK_OF

    def of_uplink(section: Iterable[dict[str, Any]] | None) -> Iterator[dict[str, Any]]:
        return (one for one in section or () if str(one["id"]).startswith(UPLINK_OF))

    for uplink in of_uplink(config["qos"]["network"]):
        yield Setting("site", uplink["id"].removeprefix(UPLINK_OF), origin)
        yield Setting("uplink", uplink["interfaces"] or uplink["link_protocols"], origin)
        robots: dict[tuple[str, float], int] = {}
        for item in of_uplink(config["downsampling"]):
            for rule in item["rules"]:
                stream = rule["key_expr"].removesuffix("/*").rpartition("/")[2], rule["freq"]
                robots[stream] = robots.get(stream, 0) + 1
        passing = [
            f"{stream} at most {rate_hz:.3g} Hz of {count_text(count, 'robot')}"
            for (stream, rate_hz), count in robots.items()
        ]
        passing += [
            f"nothing larger than {item['size_limit']} B" for item in of_uplink(config["low_pass_filter"])
        ]
        yield Setting("passing", passing or ["no sample"], origin)


def _zenoh_settings(context: click.Context) -> dict[str, Any]:
    """Zenoh settings that differ from Zenoh's defaults, by their path in its configuration."""
    from zstate.net.config import check_mode, default_config, listen_endpoints
    from zstate.net.user_config import user_config

    network = _network(context)
    mode = check_mode(network.joins_as)
    if network.config:
        config = user_config(network.config, mode, network.connect, network.listen, network.credentials)
    else:
        endpoints = listen_endpoints(mode, network.listen, network.credentials)
        config = default_config(mode, network.connect, endpoints, None, network.credentials)
    default = user_config({}, "peer", (), ())
    return dict(_differences("", json.loads(str(config)), json.loads(str(default))))


def _differences(path: str, config: Any, default: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(config, dict) and isinstance(default, dict):
        defaults = cast("dict[str, Any]", default)
        for name, value in cast("dict[str, Any]", config).items():
            yield from _differences(f"{path}/{name}".lstrip("/"), value, defaults.get(name))
    elif config != default:
        yield path, "set" if path.endswith("password") else config


def _invalid_settings(context: click.Context) -> Iterator[str]:
    from zstate.net.config import endpoint_list
    from zstate.net.rendezvous import rendezvous_addresses

    checks: tuple[Callable[[], object], ...] = (
        lambda: endpoint_list((*context.params["connect"], *context.params["listen"])),
        rendezvous_addresses,
        lambda: _network(context),
    )
    for check in checks:
        try:
            check()
        except ZStateError as error:
            yield str(error)
        except click.ClickException as error:
            yield error.format_message()


def _contradictions(params: dict[str, Any]) -> Iterator[str]:
    from zstate.net.config import CONFIG_VARIABLE

    file = params["config"] or os.environ.get(CONFIG_VARIABLE)
    if params["config"] and os.environ.get(CONFIG_VARIABLE):
        yield f"{CONFIG_VARIABLE} also names a file; --config takes precedence"
    if params["mode"] == "loopback" and file:
        yield f"mode 'loopback' stays on this host, but the configuration {file!r} could leave it: choose one"
    if params["mode"] == "client" and not params["connect"] and not file:
        yield "mode 'client' needs --connect, for instance tcp/192.168.1.10:7447"
    log_format = os.environ.get(FORMAT_VARIABLE)
    if log_format and log_format not in FORMATS:
        yield f"{FORMAT_VARIABLE} is {log_format!r}; valid values: {' or '.join(FORMATS)}"


def _unused_variables(context: click.Context) -> Iterator[str]:
    from zstate.net.rendezvous import RENDEZVOUS_VARIABLE

    group = context.find_root().command
    assert isinstance(group, click.Group)
    known = {RENDEZVOUS_VARIABLE, PASSWORD_VARIABLE, KERNEL_VARIABLE, FORMAT_VARIABLE, "ZSTATE_USERS"}
    known |= {str(one.envvar) for one in context.command.params if one.envvar}
    for variable in sorted(os.environ):
        # An option of another command, ZSTATE_COMMAND_OPTION: every option of every command has one.
        name, _, option = variable.removeprefix(_PREFIX).partition("_")
        command = group.get_command(context, name.lower())
        is_option = command and option in {(one.name or "").upper() for one in command.params}
        if variable.startswith(_PREFIX) and variable not in known and not is_option:
            yield f"nothing reads {variable}{did_you_mean(variable, known)}"
