"""How processes of one host find each other without a router, configuration or multicast.

Every session of the default mode connects to one fixed loopback port. Whichever process holds that
port keeps a *lobby* there: a tiny Zenoh peer that tells newcomers where the others listen, and
carries no data. When its process dies, another one takes the port over; links that exist stay. Each
session looks several times a second whether the lobby knows it, and is introduced again if not.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import os
import re
import socket
import threading
from contextlib import suppress

import zenoh

from zstate.errors import Closed, ConfigError
from zstate.locks import new_lock
from zstate.net.at_exit import join_at_exit
from zstate.net.lobby import Lobby
from zstate.net.membership import Membership

RENDEZVOUS_VARIABLE = "ZSTATE_RENDEZVOUS"
RENDEZVOUS = "127.0.0.1:7450"
PROBE_PERIOD_S = 0.2
JOIN_WITHIN_S = 0.3

_HOST_PORT = re.compile(r"([\w.-]+):([1-9]\d{0,4})")


def rendezvous_address() -> tuple[str, int]:
    """Host and port of the rendezvous: ``ZSTATE_RENDEZVOUS`` if set, else 127.0.0.1:7450."""
    text = os.environ.get(RENDEZVOUS_VARIABLE) or RENDEZVOUS
    match = _HOST_PORT.fullmatch(text)
    if not match or int(match[2]) > 65535:
        raise ConfigError(
            f"{RENDEZVOUS_VARIABLE} is {text!r}; write 'host:port', for instance {RENDEZVOUS!r}",
            path=RENDEZVOUS_VARIABLE,
        )
    return match[1], int(match[2])


class Rendezvous:
    """This process's readiness to keep the lobby: at once if the port is free, else when it falls free."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._lobby: Lobby | None = None
        self._lock = new_lock()
        self._stop = threading.Event()
        self._watcher: threading.Thread | None = None
        self._take_over()

    @property
    def endpoint(self) -> str:
        """Where the lobby listens."""
        return f"tcp/{self._address[0]}:{self._address[1]}"

    @property
    def owner(self) -> bool:
        """Whether this process keeps the lobby."""
        return self._lobby is not None

    def watch(self, session: zenoh.Session, endpoint: str) -> None:
        """Take over when the port falls free; keep ``session`` at ``endpoint`` known there."""
        membership = Membership(session, endpoint, self.endpoint)
        watcher = threading.Thread(
            target=self._watch, args=(membership,), name="zstate rendezvous", daemon=True
        )
        self._watcher = join_at_exit(watcher)
        self._watcher.start()

    def close(self) -> None:
        """Give the port up, if it is ours; another process takes it over."""
        self._stop.set()
        if self._watcher not in (None, threading.current_thread()):
            self._watcher.join(JOIN_WITHIN_S)
        with self._lock:
            lobby, self._lobby = self._lobby, None
        if lobby is not None:
            lobby.close()

    def _watch(self, membership: Membership) -> None:
        with suppress(zenoh.ZError, Closed):  # the session was closed, or the process ends
            while not self._stop.wait(PROBE_PERIOD_S):
                self._take_over()
                membership.renew(self._stop)

    def _take_over(self) -> None:
        if self.owner or not _port_is_free(self._address):
            return
        try:
            lobby = Lobby(self.endpoint)
        except zenoh.ZError:
            return  # another process was quicker
        with self._lock:
            if not self._stop.is_set():
                self._lobby = lobby
                return
        lobby.close()


def _port_is_free(address: tuple[str, int]) -> bool:
    # Binding fails while somebody listens, and unlike connecting it disturbs nobody.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
        except OSError:
            return False
    return True


def free_endpoint() -> str:
    """A loopback endpoint where nobody listens now: unlike port 0, it is known before Zenoh opens it."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
