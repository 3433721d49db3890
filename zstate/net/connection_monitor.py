"""Connection monitor: logs why endpoints deny a session that is open and keeps trying."""

from __future__ import annotations

import json
import logging
import secrets
import socket
import threading
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.endpoint import Endpoint, parse_endpoint
from zstate.errors import Closed
from zstate.net.at_exit import join_at_exit
from zstate.net.config import apply_settings, scouts_by_multicast
from zstate.net.open import open_zenoh

if TYPE_CHECKING:
    from zstate.net.security.credentials import Credentials

_LOG = logging.getLogger("zstate")

FIRST_PERIOD_S = 1.0
PERIOD_S = 5.0

_SCOUT_S = 0.5
_JOIN_WITHIN_S = 0.3
_BYPASS = (
    "%s: this session is a peer of a router, with credentials. Access control applies to messages through "
    "the router only; peers use direct links, and receive nothing from each other without them. Connect as "
    "a client: mode='client' (--mode client)"
)


class ConnectionMonitor(Closeable):
    """Checks every few seconds for ``endpoints`` without a link from ``session``, and logs their denials.

    With multicast and without any link, it also checks the endpoints found by scouting. A denial is logged
    once until there is a link. A client needs only one link. Endpoints without a listener are not logged,
    as programs may start in any order.

    A peer with credentials and a link to a router is warned once: access control applies to messages through
    a router, and peers exchange data over direct links.
    """

    def __init__(
        self,
        session: zenoh.Session,
        config: zenoh.Config,
        endpoints: Sequence[str],
        credentials: Credentials | None,
    ) -> None:
        self._session = session
        self._config = config
        self._endpoints = endpoints
        self._credentials = credentials
        mode = json.loads(config.get_json("mode"))
        self._needs_all = mode != "client"
        self._may_bypass = mode == "peer" and credentials is not None
        self._scouts = scouts_by_multicast(config)
        self._checked: set[str] = set()
        self._stop = threading.Event()
        thread = threading.Thread(target=self._run, name="zstate connection monitor", daemon=True)
        self._thread = join_at_exit(thread)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not threading.current_thread():
            self._thread.join(_JOIN_WITHIN_S)

    def _run(self) -> None:
        period_s = FIRST_PERIOD_S
        with suppress(zenoh.ZError, Closed):  # the session was closed, or the process ends
            while not self._stop.wait(period_s):
                self._check()
                period_s = PERIOD_S

    def _check(self) -> None:
        if self._may_bypass and self._session.info.routers_zid():
            self._may_bypass = False
            _LOG.warning(_BYPASS, " and ".join(map(repr, self._endpoints)), extra={"event": "bypass"})
        links = {_addresses(str(link.dst)) for link in self._session.info.links()}
        linked = frozenset[Endpoint]().union(*links)
        if linked and not self._needs_all:
            self._checked.clear()
            return
        scouted = self._scout() if self._scouts and not linked else []
        for endpoint in [*self._endpoints, *scouted]:
            if _addresses(endpoint) & linked:
                self._checked.discard(endpoint)
            elif endpoint not in self._checked and not self._stop.is_set():
                self._log_denial(endpoint)

    def _scout(self) -> list[str]:
        """The endpoints of sessions that reply by multicast."""
        ring: zenoh.handlers.RingChannel[zenoh.Hello] = zenoh.handlers.RingChannel(64)
        scout = zenoh.scout(ring, what="peer|router", config=self._config)
        self._stop.wait(_SCOUT_S)
        hellos = {str(hello.zid): hello.locators for hello in iter(scout.try_recv, None)}
        scout.stop()
        hellos.pop(str(self._session.zid()), None)
        return [locator for locators in hellos.values() for locator in locators]

    def _log_denial(self, endpoint: str) -> None:
        from zstate.net.security.connection_check import check_connections  # noqa: PLC0415  # loads ssl

        results = check_connections([endpoint], self._credentials)
        if not results.is_denied:
            return
        self._checked.add(endpoint)
        if not self._accepts(endpoint):
            error = results.error
            facts = {"event": "refused", "reason": getattr(error, "reason", None)}
            _LOG.warning("%s; still trying", error, extra=facts)

    def _accepts(self, endpoint: str) -> bool:
        """Whether a client with this configuration is accepted: then the session has a link, or one soon."""
        settings: dict[str, object] = {
            "id": f"1{secrets.token_hex(15)}",
            "mode": "client",
            "connect": {"endpoints": [endpoint], "timeout_ms": 0, "exit_on_failure": True},
            "listen/endpoints": [],
            "scouting/multicast/enabled": False,
        }
        try:
            open_zenoh(apply_settings(zenoh.Config.from_json5(str(self._config)), settings)).close()
        except zenoh.ZError:
            return False
        return True


def _addresses(endpoint: str) -> frozenset[Endpoint]:
    """All addresses of ``endpoint``; none if its host is unknown, or its protocol not TCP or TLS."""
    parsed = parse_endpoint(endpoint)
    if parsed is None or parsed.protocol not in ("tcp", "tls"):
        return frozenset()
    try:
        found = socket.getaddrinfo(parsed.host, parsed.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return frozenset()
    hosts = {str(info[4][0]).removeprefix("::ffff:") for info in found}
    return frozenset(Endpoint(parsed.protocol, host, parsed.port) for host in hosts)
