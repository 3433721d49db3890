"""Door: whom the page is shown to.

A browser lets any page on the internet open a websocket to a port of the machine it runs on. So:

- a websocket is opened only for a page that came from here (its Origin is the Host it asks);
- on loopback, Host must be a name of loopback, or a page elsewhere could have its name lead here;
- beyond loopback everything, the page as well as the websocket, wants the token.
"""

from __future__ import annotations

import http
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})

# The page is one file with everything in it: whatever it were made to ask for elsewhere, it does not get.
_HEADERS = {
    "Content-Security-Policy": "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
    "frame-ancestors 'self'; form-action 'none'; base-uri 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True, slots=True)
class Refused:
    """Why somebody stays outside, for who reads it in a browser."""

    status: http.HTTPStatus
    text: str


@dataclass(frozen=True, slots=True)
class Door:
    """Who may come in at ``host``; ``token`` is what they have to know, None where nothing."""

    host: str
    token: str | None = None

    @classmethod
    def at(cls, host: str) -> Door:
        """Open on loopback, else with a token that nobody guesses."""
        return cls(host, None if is_loopback(host) else secrets.token_urlsafe(16))

    def objection(self, path: str, headers: Mapping[str, str]) -> Refused | None:
        """Why a request for ``path``, query included, stays outside; None when it may come in."""
        host = headers.get("Host", "")
        if is_loopback(self.host) and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return Refused(
                http.HTTPStatus.FORBIDDEN,
                f"this view is for this machine only and was asked for as {host!r}; "
                "`zstate view --host` opens it to others",
            )
        origin = headers.get("Origin")
        if is_websocket(headers) and origin is not None and urlsplit(origin).netloc != host:
            return Refused(http.HTTPStatus.FORBIDDEN, f"a page of {origin!r} may not use this view")
        if not self._is_known(path, headers):
            return Refused(
                http.HTTPStatus.UNAUTHORIZED,
                "this view asks for its token; open the address that `zstate view` printed",
            )
        return None

    def headers(self, port: int) -> dict[str, str]:
        """What every answer says besides itself: nothing from elsewhere, and the token kept for later."""
        if self.token is None:
            return _HEADERS
        # The page opens its websocket without the query it was asked with: a cookie goes along by itself.
        # A host has the same cookies at all its ports.
        cookie = f"{_cookie_name(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"
        return {**_HEADERS, "Set-Cookie": cookie}

    def _is_known(self, path: str, headers: Mapping[str, str]) -> bool:
        if self.token is None:
            return True
        asked = parse_qs(urlsplit(path).query).get("token", [])
        said = [*asked, *_cookies(headers)]
        return any(secrets.compare_digest(self.token.encode(), one.encode()) for one in said)


def is_loopback(host: str) -> bool:
    """Whether ``host`` is reached from this machine only."""
    return host in LOOPBACK or host.startswith("127.")


def is_websocket(headers: Mapping[str, str]) -> bool:
    """Whether a request asks for a websocket."""
    return headers.get("Upgrade", "").lower() == "websocket"


def _cookie_name(port: int) -> str:
    return f"zstate_view_{port}"


def _cookies(headers: Mapping[str, str]) -> list[str]:
    """The tokens that a browser kept, whichever port's they are."""
    try:
        jar = SimpleCookie(headers.get("Cookie", ""))
    except CookieError:
        return []
    return [morsel.value for name, morsel in jar.items() if name.startswith(_cookie_name(0)[:-1])]
