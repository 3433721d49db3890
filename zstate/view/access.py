"""Access checks for requests to the page.

A browser lets any page on the internet open a websocket to a port of the machine it runs on. So:

- a websocket is opened only for a page from this server (its Origin equals its Host);
- on loopback, Host must be a loopback address or ``localhost``, with the port of this server; otherwise
  another site could let its own name resolve to 127.0.0.1 (DNS rebinding);
- a request with two of a header that decides is refused;
- beyond loopback every request, for the page and for the websocket, needs the token.
"""

from __future__ import annotations

import ipaddress
import secrets
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from websockets.datastructures import Headers

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


@dataclass(frozen=True, slots=True)
class AccessDeniedResponse:
    """Why a request is refused, as text for the user of the browser."""

    status: HTTPStatus
    text: str


@dataclass(frozen=True, slots=True)
class AccessCheck:
    """Decides which requests a server at ``host`` and ``port`` answers; ``token`` is needed unless None."""

    host: str
    port: int
    token: str | None = None

    @classmethod
    def at(cls, host: str, port: int) -> AccessCheck:
        """Without a token on loopback, elsewhere with a random one."""
        return cls(host, port, None if is_loopback(host) else secrets.token_urlsafe(16))

    def check(self, path: str, headers: Headers) -> AccessDeniedResponse | None:
        """Why a request for ``path``, query included, is refused; None if it is answered."""
        repeated = [name for name in _UNIQUE if len(headers.get_all(name)) > 1]
        if repeated:
            text = f"a request has at most one {repeated[0]} header"
            return AccessDeniedResponse(HTTPStatus.BAD_REQUEST, text)
        host = headers.get("Host", "")
        name, port = _name_and_port(host)
        if is_loopback(self.host) and not (is_loopback(name) and port == self.port):
            text = (
                f"this view is for this machine only, at port {self.port}, and was requested as {host!r}; "
                f"forward the same port (ssh -L {self.port}:127.0.0.1:{self.port} HOST), or open the view to "
                "others with `zstate view --host`"
            )
            return AccessDeniedResponse(HTTPStatus.FORBIDDEN, text)
        origin = headers.get("Origin")
        if is_websocket(headers) and origin is not None and not _is_same_host(origin, host):
            return AccessDeniedResponse(HTTPStatus.FORBIDDEN, f"a page of {origin!r} may not use this view")
        if not self._has_token(path, headers):
            text = "this view asks for its token; open the address that `zstate view` printed"
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
            cookies = SimpleCookie(headers.get("Cookie", ""))
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
    return headers.get("Upgrade", "").lower() == "websocket"


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
