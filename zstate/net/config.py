"""What a session is told: endpoints checked, settings chosen, one zenoh.Config out.

The ways to join the network, and how open each of them is.

What the environment says about joining the network: what zstate's commands go by, for other programs.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import ipaddress
import json
import os
import re
import socket
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, get_args

import zenoh

from zstate._util.endpoint import parse_endpoint, parse_host_port
from zstate.errors import ConfigError, InvalidInput, NetworkError, PortBusy
from zstate.net.security.credentials import Credentials

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


def default_config(
    mode: Mode,
    endpoints: Sequence[str],
    listen: Sequence[str],
    timeout_s: float | None = None,
    credentials: Credentials | None = None,
) -> zenoh.Config:
    """Our settings. Without ``timeout_s`` connecting is tried for ever and opening never fails."""
    return _apply(
        zenoh.Config(),
        {
            **SETTINGS,
            **_mode(mode),
            **_secured(credentials),
            **_is_config_section(mode, credentials),
            "connect/endpoints": list(endpoints),
            "listen/endpoints": list(listen),
            "connect/timeout_ms": -1 if timeout_s is None else round(timeout_s * 1000),
            "connect/exit_on_failure": timeout_s is not None,
        },
    )


def user_config(
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
    return _apply(_load(source), told)


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


def _is_config_section(mode: Mode, credentials: Credentials | None) -> dict[str, object]:
    # Whoever is found by multicast or gossip and speaks plain TCP would be spoken to, certificates or not.
    # Routers look for nobody, and may serve the programs of their host without.
    if mode == "router" or credentials is None or credentials.ca is None:
        return {}
    return {"transport/link/protocols": ["tls", "quic"]}


def _apply(config: zenoh.Config, settings: Mapping[str, object]) -> zenoh.Config:
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


_WITHIN_A_HOST = ("unixsock-stream/", "unixpipe/")


def check_mode(mode: str) -> Mode:
    """``mode`` if it is one. Raises InvalidInput naming all of them."""
    for known in get_args(Mode):
        if mode == known:
            return known
    raise InvalidInput(f"{mode!r} is not a mode; the modes are {', '.join(map(repr, get_args(Mode)))}")


def listen_endpoints(mode: Mode, listen: Sequence[str], credentials: Credentials | None) -> tuple[str, ...]:
    """Where to listen: ``listen``, or where ``mode`` does unless told otherwise."""
    if listen or mode == "client":
        return tuple(listen)
    default = {"router": ROUTER_ENDPOINT, "lan": _any_port()}.get(mode, ANY_LOOPBACK_PORT)
    is_encrypted = credentials is not None and credentials.ca is not None
    return (default.replace("tcp/", "tls/", 1) if is_encrypted else default,)


def _any_port() -> str:
    # Where IPv6 is switched off, Zenoh cannot listen at its own default.
    return "tcp/[::]:0" if socket.has_dualstack_ipv6() else "tcp/0.0.0.0:0"


def check_loopback_only(endpoints: Iterable[str]) -> None:
    """Raise InvalidInput for an endpoint through which something could leave this host, or come in."""
    for endpoint in endpoints:
        if not endpoint.startswith(_WITHIN_A_HOST) and not _is_loopback(endpoint):
            raise InvalidInput(
                f"{endpoint!r} leaves this host, which mode 'loopback' forbids; write an address in "
                "127.0.0.0/8, '[::1]' or 'localhost', or choose mode 'peer', 'lan' or 'client'"
            )


def _is_loopback(endpoint: str) -> bool:
    parsed = parse_endpoint(endpoint)
    host = parsed.host if parsed else ""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name may mean another address tomorrow


def check_credentials(mode: Mode, credentials: Credentials | None, listen: Iterable[str]) -> None:
    """Raise ConfigError for what would keep everybody out."""
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
            "a router with a user and no users would let nobody in; give users= (--users FILE), a file of "
            "user:password lines",
            path="users",
        )


MODE, CONNECT, LISTEN, FILE = "ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"
CERTS, IDENTITY = "ZSTATE_CERTS", "ZSTATE_IDENTITY"
USER, PASSWORD, PASSWORD_FILE = "ZSTATE_USER", "ZSTATE_PASSWORD", "ZSTATE_PASSWORD_FILE"

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How to join, as ``connect`` takes it."""

    mode: Mode
    endpoints: tuple[str, ...]
    listen: tuple[str, ...]
    config: str | None
    credentials: Credentials | None


def said_in_environment() -> SessionSettings | None:
    """What ZSTATE_MODE, _CONNECT, _LISTEN and _CONFIG say, and who this is; None where they say nothing.

    Endpoints stand with blanks between them. Raises ConfigError naming the variable.
    """
    mode, config = os.environ.get(MODE), os.environ.get(FILE) or None
    endpoints, listen = _endpoints(CONNECT), _endpoints(LISTEN)
    if not (mode or endpoints or listen or config):
        return None
    checked: Mode = _checked(MODE, lambda: check_mode(mode or implied_mode(endpoints, listen, config)))
    if checked == "loopback":
        for variable, said in ((CONNECT, endpoints), (LISTEN, listen)):
            _checked(variable, lambda said=said: check_loopback_only(said))
    if checked == "client" and not (endpoints or config or os.environ.get(CONFIG_VARIABLE)):
        raise ConfigError(
            f"{MODE} is 'client', and {CONNECT} does not say where the router is, for instance "
            "tcp/192.168.1.10:7447",
            path=MODE,
        )
    return SessionSettings(checked, endpoints, listen, config, _credentials())


def implied_mode(endpoints: object, listen: object, config: object) -> str:
    """What is meant by whoever names places and no mode."""
    # Whoever only says where to connect means a router, and peers do not pass on what others say.
    return "client" if endpoints and not listen and not config else "peer"


@contextmanager
def blame_variable() -> Generator[None]:
    """Let an error of the network name the variable that sent us there."""
    try:
        yield
    except NetworkError as error:
        variable = LISTEN if isinstance(error, PortBusy) else CONNECT
        if os.environ.get(variable):
            error.args = (f"{error} ({variable} in the environment says where)",)
        raise


def _endpoints(variable: str) -> tuple[str, ...]:
    return _checked(variable, lambda: endpoint_list(os.environ.get(variable, "").split()))


def _checked(variable: str, check: Callable[[], T]) -> T:
    try:
        return check()
    except InvalidInput as error:
        raise ConfigError(f"{variable} in the environment: {error}", path=variable) from None


def _credentials() -> Credentials | None:
    certs, identity, user = (os.environ.get(variable) for variable in (CERTS, IDENTITY, USER))
    if bool(certs) != bool(identity):
        has, lacks = (CERTS, IDENTITY) if certs else (IDENTITY, CERTS)
        raise ConfigError(f"{has} in the environment is of no use without {lacks}", path=has)
    password = _password(user) if user else None
    if certs and identity:
        return Credentials.from_folder(certs, identity, user=user or None, password=password)
    return Credentials(user=user, password=password) if user else None


def _password(user: str) -> str:
    file, password = os.environ.get(PASSWORD_FILE), os.environ.get(PASSWORD)
    if file:
        from zstate.net.security.credential_files import password_in  # noqa: PLC0415  # loads ssl, which few need

        return password_in(file)
    if not password:
        raise ConfigError(
            f"the password of {user!r} ({USER} in the environment) is missing; put it into {PASSWORD}, or "
            f"where it stands into {PASSWORD_FILE}",
            path=PASSWORD,
        )
    return password
