"""How processes of one host find each other without a router, configuration or multicast.

Every session of the default mode connects to one fixed loopback port. Whichever process holds that
port keeps a *lobby* there: a tiny Zenoh peer that tells newcomers where the others listen, and
carries no data. When its process dies, another one takes the port over; links that exist stay.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import os
import re
import socket
import threading
from collections.abc import Callable

import zenoh

from zstate.errors import ConfigError

RENDEZVOUS_VARIABLE = "ZSTATE_RENDEZVOUS"
RENDEZVOUS = "127.0.0.1:7450"
PROBE_PERIOD_S = 0.2

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
    """This process's readiness to keep the lobby: at once if the port is free, else when it falls free.

    ``open_lobby(endpoint)`` opens a Zenoh session that listens there, or raises ZError.
    """

    def __init__(self, address: tuple[str, int], open_lobby: Callable[[str], zenoh.Session]) -> None:
        self._address = address
        self._open_lobby = open_lobby
        self._lobby: zenoh.Session | None = None
        self._stop = threading.Event()
        self._watcher: threading.Thread | None = None
        if not self._take_over():
            self._watcher = threading.Thread(target=self._watch, name="zstate rendezvous", daemon=True)
            self._watcher.start()

    @property
    def endpoint(self) -> str:
        """Where the lobby listens."""
        return f"tcp/{self._address[0]}:{self._address[1]}"

    @property
    def owner(self) -> bool:
        """Whether this process keeps the lobby."""
        return self._lobby is not None

    def close(self) -> None:
        """Give the port up, if it is ours; another process takes it over."""
        self._stop.set()
        if self._watcher is not None:
            self._watcher.join(1.0)
        if self._lobby is not None:
            self._lobby.close()
            self._lobby = None

    def _watch(self) -> None:
        while not self._stop.wait(PROBE_PERIOD_S):
            if self._take_over():
                return

    def _take_over(self) -> bool:
        if not _port_is_free(self._address):
            return False
        try:
            self._lobby = self._open_lobby(self.endpoint)
        except zenoh.ZError:
            return False  # another process was quicker
        return True


def _port_is_free(address: tuple[str, int]) -> bool:
    # Binding fails while somebody listens, and unlike connecting it disturbs nobody.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(address)
        except OSError:
            return False
    return True
