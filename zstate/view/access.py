"""Door: whom the page is shown to.

A browser lets any page on the internet open a websocket to a port of the machine it runs on. So:

- a websocket is opened only for a page that came from here (its Origin is the Host it asks);
- on loopback, Host must be a loopback address or ``localhost``, with the port of this server; otherwise
  another site could let its own name resolve to 127.0.0.1 (DNS rebinding);
- a header that decides is refused if a request has it twice;
- beyond loopback everything, the page as well as the websocket, wants the token.
"""

from __future__ import annotations

import http
import ipaddress
import secrets
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from websockets.datastructures import Headers

_HTTP_PORT = 80
_ONCE = ("Host", "Origin", "Upgrade", "Cookie")

# The page is one file with everything in it: whatever it were made to ask for elsewhere, it does not get.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
    "frame-ancestors 'self'; form-action 'none'; base-uri 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True, slots=True)
class AccessDeniedResponse:
    """Why somebody stays outside, for who reads it in a browser."""

    status: http.HTTPStatus
    text: str


@dataclass(frozen=True, slots=True)
class AccessCheck:
    """Who may come in at ``host`` and ``port``; ``token`` is what they have to know, None where nothing."""

    host: str
    port: int
    token: str | None = None

    @classmethod
    def at(cls, host: str, port: int) -> AccessCheck:
        """Open on loopback, else with a token that nobody guesses."""
        return cls(host, port, None if is_loopback(host) else secrets.token_urlsafe(16))

    def check(self, path: str, headers: Headers) -> AccessDeniedResponse | None:
        """Why a request for ``path``, query included, stays outside; None when it may come in."""
        repeated = [name for name in _ONCE if len(headers.get_all(name)) > 1]
        if repeated:
            return AccessDeniedResponse(
                http.HTTPStatus.BAD_REQUEST, f"a request has one {repeated[0]} header at most"
            )
        host = headers.get("Host", "")
        if is_loopback(self.host) and not self._is_here(host):
            return AccessDeniedResponse(
                http.HTTPStatus.FORBIDDEN,
                f"this view is for this machine only, at port {self.port}, and was asked for as {host!r}; "
                f"forward the same port (ssh -L {self.port}:127.0.0.1:{self.port} HOST), or open the view to "
                "others with `zstate view --host`",
            )
        origin = headers.get("Origin")
        if is_websocket(headers) and origin is not None and not _is_same_place(origin, host):
            return AccessDeniedResponse(
                http.HTTPStatus.FORBIDDEN, f"a page of {origin!r} may not use this view"
            )
        if not self._is_known(path, headers):
            return AccessDeniedResponse(
                http.HTTPStatus.UNAUTHORIZED,
                "this view asks for its token; open the address that `zstate view` printed",
            )
        return None

    def headers(self) -> dict[str, str]:
        """What every answer says besides itself: nothing from elsewhere, and the token kept for later."""
        if self.token is None:
            return _HEADERS
        # The page opens its websocket without the query it was asked with: a cookie goes along by itself.
        # A host has the same cookies at all its ports.
        cookie = f"{_cookie_name(self.port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return {**_HEADERS, "Set-Cookie": cookie}

    def _is_here(self, host: str) -> bool:
        """Whether a Host header names loopback and this server's port."""
        name, port = _name_and_port(host)
        return is_loopback(name) and port == self.port

    def _is_known(self, path: str, headers: Headers) -> bool:
        if self.token is None:
            return True
        asked = parse_qs(path.partition("?")[2]).get("token", [])
        said = [one.encode(errors="surrogateescape") for one in (*asked, *_cookies(headers))]
        return any(secrets.compare_digest(self.token.encode(), one) for one in said)


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
    """The parts of a Host header, in lower case; an empty name if it is none."""
    try:
        parts = urlsplit(f"//{host}")
        port = _HTTP_PORT if parts.port is None else parts.port
    except ValueError:
        return "", 0
    # What else stands there (a user, a path) has no place in a Host header.
    has_more = parts.netloc != host or "@" in host
    return "" if has_more or parts.hostname is None else parts.hostname, port


def _is_same_place(origin: str, host: str) -> bool:
    """Whether an Origin header names the same host and port as a Host header."""
    try:
        place = urlsplit(origin).netloc.lower()
    except ValueError:
        return False
    return place != "" and place == host.lower()


def _cookie_name(port: int) -> str:
    return f"zstate_view_{port}"


def _cookies(headers: Headers) -> list[str]:
    """The tokens that a browser kept, whichever port's they are."""
    try:
        jar = SimpleCookie(headers.get("Cookie", ""))
    except CookieError:
        return []
    return [morsel.value for name, morsel in jar.items() if name.startswith(_cookie_name(0)[:-1])]
