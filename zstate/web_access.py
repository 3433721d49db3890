"""Access checks for requests to web servers (the view, Foxglove and metrics), and their sockets.

A browser lets any page on the internet open a websocket to a port of the machine it runs on. So:

- a websocket is opened only for a page from this server (its Origin equals its Host), or from an allowed
  site;
- on loopback, Host must be a loopback address or ``localhost``, with the port of this server; otherwise
  another site could let its own name resolve to 127.0.0.1 (DNS rebinding);
- a request with two of a header that decides is refused;
- beyond loopback every request, for the page and for the websocket, needs the token.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import secrets
import socket
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Protocol
from urllib.parse import parse_qs, urlsplit

from zstate._util.endpoint import format_host
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from websockets.asyncio.server import Server

_PORTS_TRIED = 100
_ACCEPT_TURNS = 3
_HTTP_PORT = 80
_UNIQUE = ("Host", "Origin", "Upgrade", "Cookie")
_COOKIE = "zstate_view_"  # and the port, because a host has the same cookies at all its ports

# The page is one file with everything in it: requests to other servers are blocked.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
    "frame-ancestors 'self'; form-action 'none'; base-uri 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Headers(Protocol):
    """The headers of a request: their values by name, in any case."""

    def get_all(self, key: str, /) -> list[str]: ...


@dataclass(frozen=True, slots=True)
class AccessDeniedResponse:
    """Why a request is refused, as text for the user of the browser; ``origin`` if that is the reason."""

    status: HTTPStatus
    text: str
    origin: str = ""


@dataclass(frozen=True, slots=True)
class AccessCheck:
    """Decides which requests a server at ``host`` and ``port`` answers; ``token`` is needed unless None.

    ``origins`` are sites whose pages may open a websocket as well, as "https://app.example". ``command`` runs
    the server, and with ``host_option`` beyond loopback; refusals name both.
    """

    host: str
    port: int
    token: str | None = None
    origins: tuple[str, ...] = ()
    command: str = "zstate view"
    host_option: str = "--host"

    @classmethod
    def at(
        cls, host: str, port: int, *, origins: tuple[str, ...] = (), command: str = "zstate view"
    ) -> AccessCheck:
        """Without a token on loopback, elsewhere with a random one."""
        token = None if is_loopback(host) else secrets.token_urlsafe(16)
        return cls(host, port, token, origins, command)

    def url(self, scheme: str) -> str:
        """The address of the server, with the token if one is needed."""
        query = "" if self.token is None else f"/?token={self.token}"
        is_any = self.host in ("", "0.0.0.0", "::")
        name = socket.gethostname() if is_any else format_host(self.host)
        return f"{scheme}://{name}:{self.port}{query}"

    def check(self, path: str, headers: Headers) -> AccessDeniedResponse | None:
        """Why a request for ``path``, query included, is refused; None if it is answered."""
        repeated = [name for name in _UNIQUE if len(headers.get_all(name)) > 1]
        if repeated:
            text = f"a request has at most one {repeated[0]} header"
            return AccessDeniedResponse(HTTPStatus.BAD_REQUEST, text)
        host = _first(headers, "Host")
        name, port = _name_and_port(host)
        if is_loopback(self.host) and not (is_loopback(name) and port == self.port):
            text = (
                f"`{self.command}` is for this machine only, at port {self.port}, and was requested as "
                f"{host!r}; forward the same port (ssh -L {self.port}:127.0.0.1:{self.port} HOST), or open "
                f"it to others with `{self.command} {self.host_option}`"
            )
            return AccessDeniedResponse(HTTPStatus.FORBIDDEN, text)
        origin = next(iter(headers.get_all("Origin")), None)
        is_allowed = origin is None or origin in self.origins or _is_same_host(origin, host)
        if is_websocket(headers) and not is_allowed:
            text = f"a page of {origin!r} may not use `{self.command}`"
            return AccessDeniedResponse(HTTPStatus.FORBIDDEN, text, origin or "")
        if not self._has_token(path, headers):
            text = f"`{self.command}` requires its token; open the address that it printed"
            return AccessDeniedResponse(HTTPStatus.UNAUTHORIZED, text)
        return None

    def headers(self) -> dict[str, str]:
        """Headers of every response: no requests to other servers, and the token as a cookie.

        The page opens its websocket without the query of its own address; the browser adds the cookie.
        """
        if self.token is None:
            return _HEADERS
        cookie = f"{_COOKIE}{self.port}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return {**_HEADERS, "Set-Cookie": cookie}

    def _has_token(self, path: str, headers: Headers) -> bool:
        """Whether the token is in the query, or in a cookie, whatever port that belongs to."""
        if self.token is None:
            return True
        tokens = parse_qs(path.partition("?")[2]).get("token", [])
        try:
            cookies = SimpleCookie(_first(headers, "Cookie"))
        except CookieError:
            cookies = SimpleCookie()
        tokens += [morsel.value for name, morsel in cookies.items() if name.startswith(_COOKIE)]
        token = self.token.encode()
        return any(secrets.compare_digest(token, one.encode(errors="surrogateescape")) for one in tokens)


def is_loopback(host: str) -> bool:
    """Whether ``host``, an address or a name, is reached from this machine only."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_websocket(headers: Headers) -> bool:
    """Whether a request asks for a websocket."""
    return _first(headers, "Upgrade").lower() == "websocket"


def _first(headers: Headers, name: str) -> str:
    """The first header of this name; empty if there is none."""
    return next(iter(headers.get_all(name)), "")


def listen(host: str, port: int | None, default: int) -> socket.socket:
    """A socket that listens at ``port``; for None at the first free one from ``default`` on.

    Raises InvalidInput if ``host`` or ``port`` cannot be used.
    """
    ports = range(default, default + _PORTS_TRIED) if port is None else (port,)
    for tried in ports:
        bound = _bind(host, tried)
        if bound is not None:
            return bound
    taken = f"port {port} is taken" if port is not None else f"ports {ports[0]} to {ports[-1]} are taken"
    raise InvalidInput(f"{taken} at {host!r}; name a free one with --port, or 0 for any")


async def end_openings(server: Server) -> None:
    """Accept no more connections, and abort those of clients that have not sent their whole request.

    To be awaited before ``server`` closes: that waits for these clients, for up to 10 s.
    """
    from websockets.protocol import State  # noqa: PLC0415  # not for metrics

    # python/cpython#109564: a server that closes in the turn of the event loop in which it has accepted a
    # connection leaves that open; delete when fixed. Two turns later the server knows it.
    loop = asyncio.get_running_loop()
    for listening in server.sockets:
        loop.remove_reader(listening)
    for _ in range(_ACCEPT_TURNS):
        await asyncio.sleep(0)
    for connection in server.handlers:
        if connection.protocol.state is State.CONNECTING:
            connection.transport.abort()


def _bind(host: str, port: int) -> socket.socket | None:
    """A socket that listens at ``port``; None if the port is taken."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except (OSError, OverflowError) as error:
        if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
            return None
        raise InvalidInput(f"cannot listen at {host!r}, port {port}: {error}") from None


def _name_and_port(host: str) -> tuple[str, int]:
    """The parts of a Host header, in lower case; an empty name if it is invalid."""
    try:
        parts = urlsplit(f"//{host}")
        port = _HTTP_PORT if parts.port is None else parts.port
    except ValueError:
        return "", 0
    # A Host header has no user and no path.
    has_more = parts.netloc != host or "@" in host
    return "" if has_more or parts.hostname is None else parts.hostname, port


def _is_same_host(origin: str, host: str) -> bool:
    """Whether an Origin header names the same host and port as a Host header."""
    with suppress(ValueError):
        return urlsplit(origin).netloc.lower() == host.lower() != ""
    return False
