"""What a session is told: endpoints checked, settings chosen, one zenoh.Config out."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import zenoh

from zstate._util.endpoint import parse_endpoint, parse_host_port
from zstate.errors import ConfigError, InvalidInput
from zstate.net.security import Credentials

Mode = Literal["peer", "loopback", "lan", "client", "router"]
ConfigSource: TypeAlias = "str | os.PathLike[str] | Mapping[str, object] | zenoh.Config"

CONFIG_VARIABLE = "ZENOH_CONFIG"
ANY_LOOPBACK_PORT = "tcp/127.0.0.1:0"
ROUTER_ENDPOINT = "tcp/127.0.0.1:7447"

SETTINGS: dict[str, object] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    # How long opening waits for those it is told of. Who has just gone is told of, too, and never answers.
    "scouting/delay": 20,
    "timestamping/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/lease": 3000,
    # A connection that was cut comes back within a second of the heal: TCP asks again after one second,
    # then a new attempt follows. Two round trips and those of TLS must fit into one.
    "transport/unicast/open_timeout": 1800,
    # By default 100 connections that send nothing keep everybody else out for 10 s each time.
    "transport/unicast/accept_timeout": 3000,
    "transport/unicast/accept_pending": 1000,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 2},
}

ROS_ROUTER: dict[str, object] = {
    "mode": "router",
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
    "routing": {"router": {"peers_failover_brokering": False}},
    "timestamping": {"enabled": True},
    # Many nodes start at once, and are busy with that for a while.
    "queries_default_timeout": 600_000,
    "transport": {
        "unicast": {
            "open_timeout": 60_000,
            "accept_timeout": 60_000,
            "accept_pending": 10_000,
            "max_sessions": 10_000,
        },
        "link": {"tx": {"lease": 60_000, "keep_alive": 2}},
        "shared_memory": {"enabled": False},
    },
}
"""What rmw_zenohd sets, but for where it listens: tcp/[::]:7447, which is open to the network.

ROS nodes are peers. They find each other through the router's gossip, and data goes between them
directly; the router passes on what is said between peers and clients.
"""

_ADDRESSED = {"tcp", "udp", "tls", "quic", "ws"}
_LOCAL = {"unixsock-stream", "unixpipe", "vsock", "serial"}


def endpoint_list(endpoints: str | Sequence[str]) -> tuple[str, ...]:
    """Checked endpoints, from one or several. Raises InvalidInput saying the right form."""
    given = [endpoints] if isinstance(endpoints, str) else endpoints
    return tuple(_check_endpoint(endpoint) for endpoint in given)


def _check_endpoint(endpoint: str) -> str:
    protocol, slash, rest = endpoint.partition("/")
    if not slash or not protocol.isascii() or protocol not in _ADDRESSED | _LOCAL:
        raise InvalidInput(f"{endpoint!r} is not an endpoint; {_advice(endpoint)}")
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if protocol in _ADDRESSED:
        if parse_endpoint(endpoint) is None:
            raise InvalidInput(f"{endpoint!r} does not say host and port; {_advice(address, protocol)}")
    elif not address:
        raise InvalidInput(f"{endpoint!r} has no address after {protocol + '/'!r}")
    return endpoint


def _advice(address: str, protocol: str = "tcp") -> str:
    if parse_host_port(address):
        return f"write '{protocol}/{address}'"
    if re.fullmatch(r"[\w.-]+", address):
        return f"write '{protocol}/{address}:7447'"
    return f"write '{protocol}/host:port', for instance 'tcp/192.168.1.10:7447'"


def our_config(
    mode: Mode,
    endpoints: Sequence[str],
    listen: Sequence[str],
    timeout_s: float | None = None,
    credentials: Credentials | None = None,
) -> zenoh.Config:
    """Our settings. Without ``timeout_s`` connecting is tried for ever and opening never fails."""
    return _told(
        zenoh.Config(),
        {
            **SETTINGS,
            **_mode(mode),
            **_secured(credentials),
            **_among_its_own(mode, credentials),
            "connect/endpoints": list(endpoints),
            "listen/endpoints": list(listen),
            "connect/timeout_ms": -1 if timeout_s is None else round(timeout_s * 1000),
            "connect/exit_on_failure": timeout_s is not None,
        },
    )


def given_config(
    source: ConfigSource,
    mode: Mode,
    endpoints: Sequence[str],
    listen: Sequence[str],
    credentials: Credentials | None = None,
) -> zenoh.Config:
    """The user's configuration; credentials, endpoints and a mode other than "peer" replace what it says."""
    told = {**({} if mode == "peer" else _mode(mode)), **_secured(credentials)}
    if endpoints:
        told["connect/endpoints"] = list(endpoints)
    if listen:
        told["listen/endpoints"] = list(listen)
    return _told(_load(source), told)


def _mode(mode: Mode) -> dict[str, object]:
    if mode == "lan":
        return {
            "mode": "peer",
            "scouting/multicast/enabled": True,
            "scouting/gossip/enabled": True,
            "scouting/delay": 200,  # to be found takes a while
        }
    return {"mode": "peer" if mode == "loopback" else mode}


def _secured(credentials: Credentials | None) -> dict[str, object]:
    return {} if credentials is None else credentials.settings()


def _among_its_own(mode: Mode, credentials: Credentials | None) -> dict[str, object]:
    # Whoever is found by multicast or gossip and speaks plain TCP would be spoken to, certificates or not.
    # Routers look for nobody, and may serve the programs of their host without.
    if mode == "router" or credentials is None or credentials.ca is None:
        return {}
    return {"transport/link/protocols": ["tls", "quic"]}


def _told(config: zenoh.Config, settings: Mapping[str, object]) -> zenoh.Config:
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def endpoints_in(config: zenoh.Config) -> tuple[str, ...]:
    """Where it says to connect, as far as that is a plain list."""
    found = json.loads(config.get_json("connect/endpoints"))
    return tuple(e for e in found if isinstance(e, str)) if isinstance(found, list) else ()  # pyright: ignore[reportUnknownVariableType]


def credentials_in(config: zenoh.Config) -> Credentials | None:
    """What it shows to those it connects to, if that is of the kind that ``connect`` takes."""
    tls: dict[str, Any] = json.loads(config.get_json("transport/link/tls"))
    user: dict[str, Any] = json.loads(config.get_json("transport/auth/usrpwd"))
    try:
        return Credentials(
            user=user["user"],
            password=user["password"],
            ca=tls["root_ca_certificate"],
            certificate=tls["connect_certificate"],
            key=tls["connect_private_key"],
        )
    except ConfigError:
        return None


def _load(source: ConfigSource) -> zenoh.Config:
    if isinstance(source, zenoh.Config):
        return zenoh.Config.from_json5(str(source))
    if isinstance(source, Mapping):
        return _parse(json.dumps(dict(source)), "the configuration given")
    path = Path(source)
    try:
        return _parse(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"the Zenoh configuration {str(path)!r} cannot be read: {error}", path=str(path)
        ) from None


def _parse(text: str, name: str) -> zenoh.Config:
    try:
        return zenoh.Config.from_json5(text)
    except zenoh.ZError as error:
        raise ConfigError(f"{name!r} is no Zenoh configuration: {error}", path=name) from None
