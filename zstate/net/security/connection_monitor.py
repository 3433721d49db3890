"""RefusalWatch: tells a session that goes on trying who does not let it in, and why.

Twin: one more session like a given one, to see through other eyes what became of its words.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import json
import logging
import secrets
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.endpoint import Endpoint, parse_endpoint
from zstate.errors import Closed
from zstate.net.at_exit import join_at_exit
from zstate.net.open import open_zenoh
from zstate.net.rendezvous import JOIN_WITHIN_S
from zstate.net.security.credentials import Credentials

_LOG = logging.getLogger("zstate")

FIRST_LOOK_S = 1.0
PERIOD_S = 5.0

_FOUND_WITHIN_S = 0.5
_BYPASS = (
    "%s: this session is a peer of a router, with credentials. Access control applies to what passes through "
    "the router; peers send over direct links, and get nothing from each other without. Connect as "
    "a client: mode='client' (--mode client)"
)


class ConnectionMonitor(Closeable):
    """Looks every few seconds whether ``session`` lacks a link to one of ``endpoints``, and asks there why.

    With multicast, and nobody met, also at those who are found by it. A refusal is logged once, until
    there was a link. A client needs one link only. Nothing is said of endpoints where nobody is: in no
    order need programs start.

    A peer with credentials that is linked to a router is warned once: access control applies to what
    passes through a router, and peers exchange data over direct links.
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
        self._seeks = json.loads(config.get_json("scouting/multicast/enabled")) is True
        self._settled: set[str] = set()
        self._stop = threading.Event()
        thread = threading.Thread(target=self._run, name="zstate refusals", daemon=True)
        self._thread = join_at_exit(thread)
        if endpoints or self._seeks:
            self._thread.start()

    def close(self) -> None:
        """Look no more. A second call does nothing."""
        self._stop.set()
        if self._thread.ident not in (None, threading.get_ident()):
            self._thread.join(JOIN_WITHIN_S)

    def _run(self) -> None:
        period_s = FIRST_LOOK_S
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
            self._settled.clear()
            return
        for endpoint in [*self._endpoints, *self._found(alone=not linked)]:
            if _addresses(endpoint) & linked:
                self._settled.discard(endpoint)
            elif endpoint not in self._settled and not self._stop.is_set():
                self._ask(endpoint)

    def _found(self, *, alone: bool) -> Iterator[str]:
        """Where those listen who answer by multicast."""
        if not (alone and self._seeks):
            return
        ring: zenoh.handlers.RingChannel[zenoh.Hello] = zenoh.handlers.RingChannel(64)
        scout = zenoh.scout(ring, what="peer|router", config=self._config)
        self._stop.wait(_FOUND_WITHIN_S)
        hellos: dict[str, list[str]] = {}
        while (hello := scout.try_recv()) is not None:
            hellos[str(hello.zid)] = hello.locators
        scout.stop()
        for zid, locators in hellos.items():
            if zid != str(self._session.zid()):
                yield from locators

    def _ask(self, endpoint: str) -> None:
        from zstate.net.security.connection_check import check_endpoints  # noqa: PLC0415  # loads ssl, which few need

        answers = check_endpoints([endpoint], self._credentials)
        if not answers.are_refusals:
            return
        self._settled.add(endpoint)
        if not self._lets_in(endpoint):
            error = answers.error
            facts = {"event": "refused", "reason": getattr(error, "reason", None)}
            _LOG.warning("%s; still trying", error, extra=facts)

    def _lets_in(self, endpoint: str) -> bool:
        """Whether a client like this session is let in: then there is a link of theirs, or one soon."""
        config = zenoh.Config.from_json5(str(self._config))
        told: dict[str, object] = {
            "id": f"1{secrets.token_hex(15)}",
            "mode": "client",
            "connect": {"endpoints": [endpoint], "timeout_ms": 0, "exit_on_failure": True},
            "listen/endpoints": [],
            "scouting/multicast/enabled": False,
        }
        for path, value in told.items():
            config.insert_json5(path, json.dumps(value))
        try:
            open_zenoh(config).close()
        except zenoh.ZError:
            return False
        return True


def _addresses(endpoint: str) -> frozenset[Endpoint]:
    """All that the host of ``endpoint`` stands for; none where that is not known, or not by TCP."""
    parsed = parse_endpoint(endpoint)
    if parsed is None or parsed.protocol not in ("tcp", "tls"):
        return frozenset()
    try:
        found = socket.getaddrinfo(parsed.host, parsed.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return frozenset()
    hosts = {str(info[4][0]).removeprefix("::ffff:") for info in found}
    return frozenset(Endpoint(parsed.protocol, host, parsed.port) for host in hosts)


@dataclass(frozen=True, slots=True)
class ProbeSession:
    """How to open one more client like this one, whom routers take for ``identity``."""

    config: zenoh.Config
    identity: str

    @classmethod
    def for_config(cls, config: zenoh.Config, credentials: Credentials | None) -> ProbeSession | None:
        """That of the session that ``config`` has opened; None unless it is a client that shows who it is."""
        if credentials is None or not credentials.identity or json.loads(config.get_json("mode")) != "client":
            return None
        config.insert_json5("connect/timeout_ms", "0")  # each endpoint once
        return cls(config, credentials.identity)

    def open(self) -> zenoh.Session:
        """It. Raises zenoh.ZError where nobody answers."""
        return open_zenoh(self.config)
