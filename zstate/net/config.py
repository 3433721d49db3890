"""Session settings: modes, checked endpoints, ``ZSTATE_*`` variables, and the zenoh.Config they make."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import socket
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, get_args

import zenoh

from zstate._util.endpoint import parse_endpoint, parse_host_port
from zstate.errors import ConfigError, InvalidInput, NetworkError, PortBusy

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials

Mode = Literal["peer", "loopback", "lan", "client", "router"]
ConfigSource: TypeAlias = "str | os.PathLike[str] | Mapping[str, object] | zenoh.Config"

CONFIG_VARIABLE = "ZENOH_CONFIG"
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


_ADDRESSED = {"tcp", "udp", "tls", "quic", "ws"}
_LOCAL = {"unixsock-stream", "unixpipe", "vsock", "serial"}


def endpoint_list(endpoints: str | Sequence[str]) -> tuple[str, ...]:
    """Checked endpoints, from one or several. Raises InvalidInput with the correct form."""
    checked = (endpoints,) if isinstance(endpoints, str) else tuple(endpoints)
    for endpoint in checked:
        protocol, slash, location = endpoint.partition("/")
        if not slash or protocol not in _ADDRESSED | _LOCAL:
            raise InvalidInput(f"{endpoint!r} is not an endpoint; {_advice(endpoint)}")
        address = re.split(r"[?#]", location, maxsplit=1)[0]
        if protocol in _ADDRESSED and parse_endpoint(endpoint) is None:
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
    settings = {**SETTINGS, **_mode_settings(mode), **(credentials.settings() if credentials else {})}
    # A peer found by multicast or gossip may accept plain TCP: with certificates only these are used.
    # Routers search for no peers, and may serve the programs of their host without certificates.
    if mode != "router" and credentials is not None and credentials.ca is not None:
        settings["transport/link/protocols"] = ["tls", "quic"]
    settings["connect/endpoints"] = list(endpoints)
    settings["listen/endpoints"] = list(listen)
    settings["connect/timeout_ms"] = -1 if timeout_s is None else round(timeout_s * 1000)
    settings["connect/exit_on_failure"] = timeout_s is not None
    return apply_settings(zenoh.Config(), settings)


def user_config(
    source: ConfigSource,
    mode: Mode,
    endpoints: Sequence[str],
    listen: Sequence[str],
    credentials: Credentials | None = None,
) -> zenoh.Config:
    """The user's configuration, with credentials, endpoints and a mode other than "peer" replaced."""
    settings = {
        **({} if mode == "peer" else _mode_settings(mode)),
        **(credentials.settings() if credentials else {}),
    }
    if endpoints:
        settings["connect/endpoints"] = list(endpoints)
    if listen:
        settings["listen/endpoints"] = list(listen)
    return apply_settings(_load(source), settings)


def _mode_settings(mode: Mode) -> dict[str, object]:
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


def endpoints_in(config: zenoh.Config) -> tuple[str, ...]:
    """The endpoints that ``config`` connects to; empty unless they are a plain list."""
    found = json.loads(config.get_json("connect/endpoints"))
    return tuple(e for e in found if isinstance(e, str)) if isinstance(found, list) else ()  # pyright: ignore[reportUnknownVariableType]


def credentials_in(config: zenoh.Config) -> Credentials | None:
    """The credentials in ``config``; None if it has none, or of a kind that ``connect`` does not accept."""
    tls: dict[str, Any] = json.loads(config.get_json("transport/link/tls"))
    user: dict[str, Any] = json.loads(config.get_json("transport/auth/usrpwd"))
    found = {
        "user": user["user"],
        "password": user["password"],
        "ca": tls["root_ca_certificate"],
        "certificate": tls["connect_certificate"],
        "key": tls["connect_private_key"],
    }
    if not any(found.values()):
        return None
    from zstate.net.security.credentials import Credentials  # noqa: PLC0415  # most sessions have none

    try:
        return Credentials(**found)
    except ConfigError:
        return None


def scouts_by_multicast(config: zenoh.Config) -> bool:
    """Whether a session with ``config`` searches for others by multicast, in whatever mode."""
    return json.loads(config.get_json("scouting/multicast/enabled")) is True


def _load(source: ConfigSource) -> zenoh.Config:
    if isinstance(source, zenoh.Config):
        return zenoh.Config.from_json5(str(source))
    if isinstance(source, Mapping):
        return _parse(json.dumps(dict(source)), "the configuration given")
    path = Path(source)
    if (text := str(path)).partition("/")[0] in _ADDRESSED | _LOCAL and not path.exists():
        error = f"{text!r} is an endpoint, not a file: connect(mode='client', endpoints={text!r})"
        raise ConfigError(error, path=text)
    try:
        return _parse(path.read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as error:
        text = f"the Zenoh configuration {str(path)!r} cannot be read: {error}"
        raise ConfigError(text, path=str(path)) from None


def _parse(text: str, name: str) -> zenoh.Config:
    try:
        return zenoh.Config.from_json5(text)
    except zenoh.ZError as error:
        raise ConfigError(f"{name!r} is not a Zenoh configuration: {error}", path=name) from None


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


MODE, CONNECT, LISTEN, FILE = "ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"
CERTS, IDENTITY = "ZSTATE_CERTS", "ZSTATE_IDENTITY"
USER, PASSWORD, PASSWORD_FILE = "ZSTATE_USER", "ZSTATE_PASSWORD", "ZSTATE_PASSWORD_FILE"

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """The arguments of ``connect``."""

    mode: Mode
    endpoints: tuple[str, ...]
    listen: tuple[str, ...]
    config: str | None
    credentials: Credentials | None


def settings_from_environment() -> SessionSettings | None:
    """The settings in ZSTATE_MODE, _CONNECT, _LISTEN and _CONFIG, with credentials; None if all are unset.

    Endpoints are separated by blanks. Raises ConfigError with the variable.
    """
    mode, config = os.environ.get(MODE), os.environ.get(FILE) or None
    endpoints, listen = _endpoints(CONNECT), _endpoints(LISTEN)
    if not (mode or endpoints or listen or config):
        return None
    checked: Mode = _checked(MODE, lambda: check_mode(mode or implied_mode(endpoints, listen, config)))
    if checked == "loopback":
        for variable, used in ((CONNECT, endpoints), (LISTEN, listen)):
            _checked(variable, lambda used=used: check_loopback_only(used))
    if checked == "client" and not (endpoints or config or os.environ.get(CONFIG_VARIABLE)):
        raise ConfigError(
            f"{MODE} is 'client' and {CONNECT} is not set; set it to the router's endpoint, for instance "
            "tcp/192.168.1.10:7447",
            path=MODE,
        )
    return SessionSettings(checked, endpoints, listen, config, _credentials_in_environment())


def implied_mode(endpoints: object, listen: object, config: object) -> str:
    """The mode if endpoints are set, but no mode."""
    # An endpoint to connect to is usually a router, and peers do not forward.
    return "client" if endpoints and not listen and not config else "peer"


@contextmanager
def blame_variable() -> Generator[None]:
    """Add the variable that holds the endpoint to network errors."""
    try:
        yield
    except NetworkError as error:
        variable = LISTEN if isinstance(error, PortBusy) else CONNECT
        if os.environ.get(variable):
            error.args = (f"{error} (the endpoint is from {variable} in the environment)",)
        raise


def _endpoints(variable: str) -> tuple[str, ...]:
    return _checked(variable, lambda: endpoint_list(os.environ.get(variable, "").split()))


def _checked(variable: str, check: Callable[[], T]) -> T:
    try:
        return check()
    except InvalidInput as error:
        raise ConfigError(f"{variable} in the environment: {error}", path=variable) from None


def _credentials_in_environment() -> Credentials | None:
    certs, identity, user = (os.environ.get(variable) for variable in (CERTS, IDENTITY, USER))
    if bool(certs) != bool(identity):
        has, lacks = (CERTS, IDENTITY) if certs else (IDENTITY, CERTS)
        raise ConfigError(f"{has} is set but {lacks} is not; set both or neither", path=has)
    if not (certs or user):
        return None
    from zstate.net.security.credentials import Credentials, password_in  # noqa: PLC0415  # as above

    password = os.environ.get(PASSWORD) if user else None
    if user and (file := os.environ.get(PASSWORD_FILE)):
        password = password_in(file)
    elif user and not password:
        raise ConfigError(
            f"the password of {user!r} ({USER} in the environment) is missing; put it into {PASSWORD}, or "
            f"the path of its file into {PASSWORD_FILE}",
            path=PASSWORD,
        )
    if certs and identity:
        return Credentials.from_folder(certs, identity, user=user or None, password=password)
    return Credentials(user=user, password=password)
