"""The ways to join the network, and how open each of them is."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable, Sequence
from typing import get_args

from zstate._util.endpoint import parse_endpoint
from zstate.errors import ConfigError, InvalidInput
from zstate.net.config import ANY_LOOPBACK_PORT, ROUTER_ENDPOINT, Mode
from zstate.net.security import Credentials

_WITHIN_A_HOST = ("unixsock-stream/", "unixpipe/")


def check_mode(mode: str) -> Mode:
    """``mode`` if it is one. Raises InvalidInput naming all of them."""
    for known in get_args(Mode):
        if mode == known:
            return known
    raise InvalidInput(f"{mode!r} is not a mode; the modes are {', '.join(map(repr, get_args(Mode)))}")


def listening(mode: Mode, listen: Sequence[str], credentials: Credentials | None) -> tuple[str, ...]:
    """Where to listen: ``listen``, or where ``mode`` does unless told otherwise."""
    if listen or mode == "client":
        return tuple(listen)
    default = {"router": ROUTER_ENDPOINT, "lan": _any_port()}.get(mode, ANY_LOOPBACK_PORT)
    is_encrypted = credentials is not None and credentials.ca is not None
    return (default.replace("tcp/", "tls/", 1) if is_encrypted else default,)


def _any_port() -> str:
    # Where IPv6 is switched off, Zenoh cannot listen at its own default.
    return "tcp/[::]:0" if socket.has_dualstack_ipv6() else "tcp/0.0.0.0:0"


def check_stays_here(endpoints: Iterable[str]) -> None:
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
