"""Settings: what a looking command would go by if it were called as `zstate config` is."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, cast

import click

from zstate.cli.config.setting import Setting, of_option, of_variable
from zstate.cli.logs import FORMAT_VARIABLE
from zstate.cli.network import Network
from zstate.cli.options import PASSWORD_VARIABLE, credentials_of
from zstate.cli.words import is_ros
from zstate.errors import InvalidInput
from zstate.extension import VARIABLE as KERNEL_VARIABLE
from zstate.extension import kernel
from zstate.net.config import CONFIG_VARIABLE, given_config, our_config
from zstate.net.modes import check_mode, listening
from zstate.net.rendezvous import RENDEZVOUS, RENDEZVOUS_VARIABLE
from zstate.net.security import Credentials
from zstate.net.wires import DOMAIN_VARIABLE


def settings(context: click.Context) -> list[Setting]:
    """Each value with its origin. Raises ConfigError for a configuration file that cannot be used."""
    return [*_of_network(context), *_of_identity(context), *_of_the_rest(context)]


def network_of(context: click.Context) -> Network:
    """How a command would join the network. Raises ConfigError and UsageError for half an identity."""
    said = context.params
    return Network(said["mode"], said["connect"], said["listen"], _file(context).value, _credentials(context))


def _file(context: click.Context) -> Setting:
    said = of_option(context, "config")
    return said if said.value else of_variable("config", CONFIG_VARIABLE, None)


def _credentials(context: click.Context) -> Credentials | None:
    said = context.params
    return credentials_of(said["certs"], said["identity"], said["user"], said["password_file"], None)


def _of_network(context: click.Context) -> Iterator[Setting]:
    said = [of_option(context, name) for name in ("mode", "connect", "listen")]
    file = _file(context)
    network = Network(context.params["mode"], context.params["connect"], context.params["listen"], file.value)
    yield from _of_file(network, said, file) if file.value else _of_ours(context, network, said)
    yield file


def _of_ours(context: click.Context, network: Network, said: list[Setting]) -> Iterator[Setting]:
    mode, connect, listen = said
    credentials = None
    with suppress(InvalidInput, click.UsageError):  # the problems tell
        credentials = _credentials(context)
    derived = f"{connect.origin}, which alone means a router" if network.connect else "default"
    yield mode if mode.value else Setting("mode", network.joins_as, derived)
    yield connect
    places = listening(check_mode(network.joins_as), network.listen, credentials)
    yield listen if listen.value else Setting("listen", list(places), "default")
    if network.joins_as in ("peer", "loopback") and not (network.connect or network.listen):
        yield of_variable("rendezvous", RENDEZVOUS_VARIABLE, RENDEZVOUS)


def _of_file(network: Network, said: list[Setting], file: Setting) -> Iterator[Setting]:
    assert isinstance(file.value, str)
    mode, connect, listen = check_mode(network.joins_as), network.connect, network.listen
    config, bare = given_config(file.value, mode, connect, listen), given_config({}, "peer", (), ())
    for one, place in zip(said, ("mode", "connect/endpoints", "listen/endpoints"), strict=True):
        text = config.get_json(place)
        from_file = "default of Zenoh" if text == bare.get_json(place) else f"file {file.value}"
        is_said = one.value and one.value != "peer"  # that leaves the mode of the file
        value = _of_mode(json.loads(text), json.loads(config.get_json("mode")))
        yield Setting(one.name, value, one.origin if is_said else from_file)


def _of_mode(value: Any, mode: str) -> Any:
    """What a setting says that may say something else for each mode."""
    return cast("dict[str, Any]", value).get(mode) if isinstance(value, dict) else value


def _of_identity(context: click.Context) -> Iterator[Setting]:
    for name in ("certs", "identity", "user"):
        yield of_option(context, name)
    file = of_option(context, "password_file")
    password = of_variable("password", PASSWORD_VARIABLE, None)
    # Whatever it is: it is not for the screen.
    hidden = Setting("password", "set" if password.value else None, password.origin)
    yield Setting("password", "set", f"file {file.value}, by {file.origin}") if file.value else hidden


def _of_the_rest(context: click.Context) -> Iterator[Setting]:
    wire = of_option(context, "wire")
    yield wire
    if is_ros(wire.value):
        yield _domain(wire)
    yield of_option(context, "clock")
    yield of_variable("log format", FORMAT_VARIABLE, "text")
    chosen = of_variable("kernel", KERNEL_VARIABLE, None)
    yield Setting("kernel", str(kernel), chosen.origin if chosen.value or kernel == "c" else kernel.reason)


def _domain(wire: Setting) -> Setting:
    from zstate.net.wires import wire_named
    from zstate.wire.ros2.wire import Ros2Wire

    spoken = wire_named(wire.value)
    assert isinstance(spoken, Ros2Wire)
    variable = of_variable("ros domain", DOMAIN_VARIABLE, 0)
    origin = wire.origin if re.search(r"\bdomain\s*=", wire.value) else variable.origin
    return Setting("ros domain", spoken.options.domain, origin)


def zenoh_settings(context: click.Context) -> dict[str, Any]:
    """What Zenoh is told beyond its own defaults, by the path in its configuration."""
    network = network_of(context)
    mode = check_mode(network.joins_as)
    if network.config:
        told = given_config(network.config, mode, network.connect, network.listen, network.credentials)
    else:
        places = listening(mode, network.listen, network.credentials)
        told = our_config(mode, network.connect, places, None, network.credentials)
    bare = given_config({}, "peer", (), ())
    return dict(_differing("", json.loads(str(told)), json.loads(str(bare))))


def _differing(path: str, told: Any, bare: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(told, dict) and isinstance(bare, dict):
        for name, value in told.items():  # pyright: ignore[reportUnknownVariableType]
            yield from _differing(f"{path}/{name}".lstrip("/"), value, bare.get(name))  # pyright: ignore[reportUnknownArgumentType,reportUnknownMemberType]
    elif told != bare:
        yield path, "set" if path.endswith("password") else told
