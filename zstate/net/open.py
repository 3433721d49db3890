"""Opening a Zenoh session: retried until a router or peer accepts it, or all of them deny it.

A session that is open and keeps trying has a ``ConnectionMonitor``, which logs why endpoints deny it.

Also sets Zenoh's thread-pool sizes: enough that closing dead links does not block reconnecting peers.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, cast

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.endpoint import Endpoint, parse_endpoint
from zstate.errors import AccessDenied, Closed, NetworkError, PortBusy
from zstate.net.at_exit import join_at_exit, session_opening
from zstate.net.config import apply_settings, endpoints_in
from zstate.net.security.credentials import Credentials

_LOG = logging.getLogger("zstate")

RUNTIME_VARIABLE = "ZENOH_RUNTIME"
RETRY_PERIOD_S = 0.1
CHECK_PERIOD_S = 1.0

MONITOR_FIRST_PERIOD_S = 1.0
MONITOR_PERIOD_S = 5.0

_SCOUT_S = 0.5
_JOIN_WITHIN_S = 0.3
_BYPASS = (
    "%s: this session is a peer of a router, with credentials. Access control applies to messages through "
    "the router only; peers use direct links, and receive nothing from each other without them. Connect as "
    "a client: mode='client' (--mode client)"
)

# Of Zenoh's runtimes the sockets belong to "net" and "acc", and what receives from them to "rx": each sample
# wakes a thread to wake another. With one runtime for the three, a reader's sample costs 30 us less CPU.
#
# Zenoh sets SO_LINGER to 10 s: closing the socket of a neighbour that was cut off blocks the closing thread
# for that time (eclipse-zenoh/zenoh#1101). With all threads blocked nothing can connect, so there are more
# threads than one. "tx" closes nothing and keeps its single one: a second is woken in vain.
_THREADS = 4
_ROUTER_THREADS = 128


def runtime(*, is_router: bool) -> str:
    """The value for ``ZENOH_RUNTIME``."""
    threads = _ROUTER_THREADS if is_router else _THREADS
    return f"(rx: (handover: net), acc: (handover: net), net: (worker_threads: {threads}))"


def open_zenoh(config: zenoh.Config) -> zenoh.Session:
    """``zenoh.open``. The first session of a process fixes the thread counts, unless ZENOH_RUNTIME is set.

    Raises Closed in a forked process (see ``session_opening``), and while the process ends.
    """
    with session_opening():
        if RUNTIME_VARIABLE in os.environ:
            return zenoh.open(config)
        mode = config.get_json("mode").strip('"')
        os.environ[RUNTIME_VARIABLE] = runtime(is_router=mode == "router")
        try:
            return zenoh.open(config)
        finally:
            os.environ.pop(RUNTIME_VARIABLE, None)  # it has been read; child processes do not inherit it


def open_with_retry(
    config: zenoh.Config,
    endpoints: Sequence[str],
    credentials: Credentials | None = None,
    timeout_s: float = 0.0,
) -> zenoh.Session:
    """A session with ``config``; if it gets no link, retried for ``timeout_s`` [s].

    Raises PortBusy, Unreachable, NetworkError; and AccessDenied, before the timeout, if all of ``endpoints``
    deny it.
    """
    deadline, next_check = time.monotonic() + timeout_s, 0.0
    while (session := _attempt(config)) is None:
        if time.monotonic() >= min(deadline, next_check):
            from zstate.net.security.connection_check import check_connections  # noqa: PLC0415  # loads ssl

            results = check_connections(endpoints, credentials)
            next_check = time.monotonic() + CHECK_PERIOD_S
            if results.is_denied or time.monotonic() >= deadline:
                # A router that answers the check may have started after our attempt, and deny nothing.
                session = _attempt(config) if isinstance(results.error, AccessDenied) else None
                if session is None:
                    raise results.error
                return session
        time.sleep(RETRY_PERIOD_S)
    return session


def _attempt(config: zenoh.Config) -> zenoh.Session | None:
    """A session, or None without a link. Zenoh has one error for everything; its text distinguishes them."""
    try:
        return open_zenoh(config)
    except zenoh.ZError as error:
        text = str(error)
    busy = re.search(r"bound to (\S+?):? .*Address already in use", text)
    if busy:
        raise PortBusy(
            f"another program listens at {busy[1]!r}; choose another port, or stop that program",
            endpoint=busy[1],
        )
    if "Unable to connect" not in text:
        text = re.sub(r" at /[^\s\]]*", "", text)  # places in Zenoh's sources
        raise NetworkError(f"Zenoh cannot open a session: {text}")
    return None


def connect_timeout(config: zenoh.Config) -> float:
    """How long the client that ``config`` describes retries [s]; clears that time in ``config``.

    Zenoh spends all of that time on the first endpoint; without it, Zenoh tries each endpoint once. 0 if
    ``config`` describes no client, or does not retry.
    """

    def client_value(name: str) -> Any:
        """A setting, or the client's part of it if it has a value for each mode."""
        value: Any = json.loads(config.get_json(f"connect/{name}"))
        return cast("dict[str, Any]", value).get("client") if isinstance(value, dict) else value

    timeout_ms, is_needed = client_value("timeout_ms"), client_value("exit_on_failure")
    is_client = json.loads(config.get_json("mode")) == "client"
    if not (is_client and endpoints_in(config) and timeout_ms) or is_needed is False:
        return 0.0
    config.insert_json5("connect/timeout_ms", "0")
    return math.inf if timeout_ms < 0 else timeout_ms / 1000.0


@dataclass(frozen=True, slots=True)
class ProbeSession:
    """Configuration of a second client with the same ``identity``, which checks what a router forwards."""

    config: zenoh.Config
    identity: str

    @classmethod
    def for_config(cls, config: zenoh.Config, credentials: Credentials | None) -> ProbeSession | None:
        """For the session that ``config`` opened; None unless it is a client with an identity."""
        if credentials is None or not credentials.identity or json.loads(config.get_json("mode")) != "client":
            return None
        config.insert_json5("connect/timeout_ms", "0")  # each endpoint once
        return cls(config, credentials.identity)

    def open(self) -> zenoh.Session:
        """Open it. Raises zenoh.ZError if no router answers."""
        return open_zenoh(self.config)


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
        self._scouts = json.loads(config.get_json("scouting/multicast/enabled")) is True
        self._checked: set[str] = set()
        self._stop = threading.Event()
        thread = threading.Thread(target=self._run, name="zstate connection monitor", daemon=True)
        self._thread = join_at_exit(thread)
        if endpoints or self._scouts:
            self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread.ident not in (None, threading.get_ident()):
            self._thread.join(_JOIN_WITHIN_S)

    def _run(self) -> None:
        period_s = MONITOR_FIRST_PERIOD_S
        with suppress(zenoh.ZError, Closed):  # the session was closed, or the process ends
            while not self._stop.wait(period_s):
                self._check()
                period_s = MONITOR_PERIOD_S

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
