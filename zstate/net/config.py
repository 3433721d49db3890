"""Session settings: modes, checked endpoints, and the zenoh.Config they make."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import socket
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

import zenoh

from zstate._util.endpoint import parse_endpoint, parse_host_port
from zstate.errors import ConfigError, InvalidInput

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials

Mode = Literal["peer", "loopback", "lan", "client", "router"]
ConfigSource: TypeAlias = "str | os.PathLike[str] | Mapping[str, object] | zenoh.Config"

CONFIG_VARIABLE = "ZENOH_CONFIG"
MODE, CONNECT, LISTEN, FILE = "ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"
"""The variables of the arguments of ``connect``; ``zstate.net.environment`` reads them."""

ANY_LOOPBACK_PORT = "tcp/127.0.0.1:0"
ROUTER_ENDPOINT = "tcp/127.0.0.1:7447"

SETTINGS: dict[str, object] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    # How long opening waits for peers known from gossip. Gossip includes peers that have just left.
    "scouting/delay": 20,
    "timestamping/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/lease": 3000,
    # A connection that was cut is back within a second of the repair: TCP retries after one second, then a
    # new attempt follows. Two round trips and those of TLS must fit into one attempt.
    "transport/unicast/open_timeout": 1800,
    # By default 100 connections that send nothing keep all others out for 10 s each time.
    "transport/unicast/accept_timeout": 3000,
    "transport/unicast/accept_pending": 1000,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 2},
}


ADDRESSED = {"tcp", "udp", "tls", "quic", "ws"}
LOCAL = {"unixsock-stream", "unixpipe", "vsock", "serial"}


def endpoint_list(endpoints: str | Sequence[str]) -> tuple[str, ...]:
    """Checked endpoints, from one or several. Raises InvalidInput with the correct form."""
    checked = (endpoints,) if isinstance(endpoints, str) else tuple(endpoints)
    for endpoint in checked:
        protocol, slash, location = endpoint.partition("/")
        if not slash or protocol not in ADDRESSED | LOCAL:
            raise InvalidInput(f"{endpoint!r} is not an endpoint; {_advice(endpoint)}")
        address = re.split(r"[?#]", location, maxsplit=1)[0]
        if protocol in ADDRESSED and parse_endpoint(endpoint) is None:
            raise InvalidInput(f"{endpoint!r} has no host and port; {_advice(address, protocol)}")
        if not address:
            raise InvalidInput(f"{endpoint!r} has no address after {protocol + '/'!r}")
    return checked


def _advice(address: str, protocol: str = "tcp") -> str:
    if parse_host_port(address):
        return f"write '{protocol}/{address}'"
    if re.fullmatch(r"[\w.-]+", address):
        return f"write '{protocol}/{address}:7447'"
    return f"write '{protocol}/host:port', for instance 'tcp/192.168.1.10:7447'"


def default_config(
    mode: Mode,
    endpoints: Sequence[str],
    listen: Sequence[str],
    timeout_s: float | None = None,
    credentials: Credentials | None = None,
) -> zenoh.Config:
    """The default settings. Without ``timeout_s`` connecting is retried for ever and opening never fails."""
    settings = {**SETTINGS, **mode_settings(mode), **(credentials.settings() if credentials else {})}
    # A peer found by multicast or gossip may accept plain TCP: with certificates only these are used.
    # Routers search for no peers, and may serve the programs of their host without certificates.
    if mode != "router" and credentials is not None and credentials.ca is not None:
        settings["transport/link/protocols"] = ["tls", "quic"]
    settings["connect/endpoints"] = list(endpoints)
    settings["listen/endpoints"] = list(listen)
    settings["connect/timeout_ms"] = -1 if timeout_s is None else round(timeout_s * 1000)
    settings["connect/exit_on_failure"] = timeout_s is not None
    return apply_settings(zenoh.Config(), settings)


def mode_settings(mode: Mode) -> dict[str, object]:
    """The settings of ``mode``, by path."""
    if mode == "lan":
        return {
            "mode": "peer",
            "scouting/multicast/enabled": True,
            "scouting/gossip/enabled": True,
            "scouting/delay": 200,  # multicast discovery takes a while
        }
    return {"mode": "peer" if mode == "loopback" else mode}


def apply_settings(config: zenoh.Config, settings: Mapping[str, object]) -> zenoh.Config:
    """``config``, changed by ``settings``, which are values by path."""
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def scouts_by_multicast(config: zenoh.Config) -> bool:
    """Whether a session with ``config`` searches for others by multicast, in whatever mode."""
    return json.loads(config.get_json("scouting/multicast/enabled")) is True


def check_mode(mode: str) -> Mode:
    """``mode`` if it is one. Raises InvalidInput with all modes."""
    for allowed in get_args(Mode):
        if mode == allowed:
            return allowed
    raise InvalidInput(f"{mode!r} is not a mode; the modes are {', '.join(map(repr, get_args(Mode)))}")


def listen_endpoints(mode: Mode, listen: Sequence[str], credentials: Credentials | None) -> tuple[str, ...]:
    """The endpoints to listen at: ``listen``, or the default of ``mode``."""
    if listen or mode == "client":
        return tuple(listen)
    # If IPv6 is switched off, Zenoh cannot listen at its own default.
    any_port = "tcp/[::]:0" if socket.has_dualstack_ipv6() else "tcp/0.0.0.0:0"
    default = {"router": ROUTER_ENDPOINT, "lan": any_port}.get(mode, ANY_LOOPBACK_PORT)
    is_encrypted = credentials is not None and credentials.ca is not None
    return (default.replace("tcp/", "tls/", 1) if is_encrypted else default,)


def check_loopback_only(endpoints: Iterable[str]) -> None:
    """Raise InvalidInput for an endpoint that is reachable from, or leads to, another host."""
    for endpoint in endpoints:
        parsed = parse_endpoint(endpoint)
        is_local = endpoint.startswith(("unixsock-stream/", "unixpipe/"))
        if parsed and not is_local:
            with suppress(ValueError):  # a host name, which may get another address later
                is_local = parsed.host == "localhost" or ipaddress.ip_address(parsed.host).is_loopback
        if not is_local:
            raise InvalidInput(
                f"{endpoint!r} leaves this host, which mode 'loopback' forbids; write an address in "
                "127.0.0.0/8, '[::1]' or 'localhost', or choose mode 'peer', 'lan' or 'client'"
            )


def check_credentials(mode: Mode, credentials: Credentials | None, listen: Iterable[str]) -> None:
    """Raise ConfigError for settings that would refuse every connection."""
    if credentials is None:
        for endpoint in listen:
            if endpoint.startswith(("tls/", "quic/")):
                raise ConfigError(
                    f"listening at {endpoint!r} needs a certificate; give credentials= (--certs DIR "
                    "--identity NAME); `zstate certs DIR --server NAME` makes one for tests",
                    path=endpoint,
                )
    elif mode == "router" and credentials.user is not None and credentials.users is None:
        raise ConfigError(
            "a router with a user and no users refuses every connection; give users= (--users FILE), a file "
            "of user:password lines",
            path="users",
        )
