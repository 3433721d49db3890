"""How processes of one host find each other without a router, configuration or multicast.

Every session of the default mode connects to one fixed loopback port. Whichever process holds that
port keeps a *lobby* there: a tiny Zenoh peer that tells newcomers where the others listen, and
carries no data. When its process dies, another one takes the port over; links that exist stay. Each
session looks several times a second whether the lobby knows it, and is introduced again if not.

A process that is stopped (Ctrl-Z) keeps its port and answers nobody. Where no lobby answers for a
second, sessions meet at the next rendezvous address in the same way, and go on looking at the first: once it
answers, they are introduced there, and so meet the process that was stopped.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import os
import socket
import threading
import time
import weakref
from contextlib import suppress

import zenoh

from zstate._util.endpoint import parse_host_port
from zstate.errors import Closed, ConfigError
from zstate.locks import new_lock, outlive_fork
from zstate.net.at_exit import join_at_exit
from zstate.net.lobby import Lobby, lobby_key
from zstate.net.membership import Membership

RENDEZVOUS_VARIABLE = "ZSTATE_RENDEZVOUS"
RENDEZVOUS = "127.0.0.1:7450 127.0.0.1:7451 127.0.0.1:7452"
PROBE_PERIOD_S = 0.2
JOIN_WITHIN_S = 0.3

_MET_WITHIN_S = 3.0
_ROUND_S = 0.002


def rendezvous_addresses() -> tuple[tuple[str, int], ...]:
    """Hosts and ports where to meet, each used while those before it are silent.

    Those of ``ZSTATE_RENDEZVOUS``, with blanks between, if that is set; else 127.0.0.1:7450, 7451, 7452.
    """
    text = os.environ.get(RENDEZVOUS_VARIABLE) or RENDEZVOUS
    parsed = [parse_host_port(address) for address in text.split()]
    # IPv6 is not supported here, and port 0 is not a place to meet.
    addresses = tuple(address for address in parsed if address and address[1] and ":" not in address[0])
    if not parsed or len(addresses) < len(parsed):
        raise ConfigError(
            f"{RENDEZVOUS_VARIABLE} is {text!r}; write 'host:port', for instance '127.0.0.1:7450', or "
            "several with blanks between",
            path=RENDEZVOUS_VARIABLE,
        )
    return addresses


class Rendezvous:
    """This process's readiness to keep a lobby: at once if the port is free, else when it falls free."""

    def __init__(self, addresses: tuple[tuple[str, int], ...]) -> None:
        self._places = [_Place(address, lobby_key(number)) for number, address in enumerate(addresses)]
        self._stop = outlive_fork(threading.Event())
        self._watcher: threading.Thread | None = None
        self._places[0].take_over(self._stop)
        _MEETING.add(self)

    @property
    def silent(self) -> tuple[tuple[str, int], ...]:
        """The addresses whose ports are taken, and where no lobby was found."""
        return tuple(place.address for place in self._places if place.is_silent and not place.is_free)

    @property
    def endpoint(self) -> str:
        """Where the first lobby listens."""
        return self._places[0].endpoint

    def watch(self, session: zenoh.Session, endpoint: str) -> None:
        """Take over when the port falls free; keep ``session`` at ``endpoint`` known there.

        Returns when it is known in a lobby, or nobody keeps one.
        """
        self._places[0].join(session, endpoint)
        watcher = threading.Thread(
            target=self._watch, args=(session, endpoint), name="zstate rendezvous", daemon=True
        )
        join_at_exit(watcher).start()
        self._watcher = watcher
        self._await_a_lobby()

    def _await_a_lobby(self) -> None:
        deadline = time.monotonic() + _MET_WITHIN_S
        while not any(place.is_known for place in self._places) and time.monotonic() < deadline:
            if self._places[0].is_free or all(place.is_silent for place in self._places):
                return  # the port is being taken over; or nobody answers
            time.sleep(_ROUND_S)

    def close(self) -> None:
        """Give the ports up that are ours; other processes take them over."""
        _MEETING.discard(self)
        self._stop.set()
        if self._watcher not in (None, threading.current_thread()):
            self._watcher.join(JOIN_WITHIN_S)
        for place in self._places:
            place.give_up()

    def _watch(self, session: zenoh.Session, endpoint: str) -> None:
        with suppress(zenoh.ZError, Closed):  # the session was closed, or the process ends
            while not self._stop.wait(PROBE_PERIOD_S):
                self._look(session, endpoint)

    def _look(self, session: zenoh.Session, endpoint: str) -> None:
        places = iter(self._places)
        for place in places:
            place.take_over(self._stop)
            place.join(session, endpoint)
            place.renew(self._stop)
            if not place.is_silent:
                break
        for place in places:
            place.give_up()


_MEETING: weakref.WeakSet[Rendezvous] = weakref.WeakSet()


def silent_addresses() -> tuple[tuple[str, int], ...]:
    """The rendezvous addresses where sessions of this process get no answer from the program that listens."""
    return tuple(sorted({address for rendezvous in tuple(_MEETING) for address in rendezvous.silent}))


class _Place:
    """One rendezvous address: the lobby there where it is ours, and our membership."""

    def __init__(self, address: tuple[str, int], key: str) -> None:
        self.endpoint = f"tcp/{address[0]}:{address[1]}"
        self.address = address
        self._key = key
        self._lobby: Lobby | None = None
        self._lock = new_lock()
        self._membership: Membership | None = None

    @property
    def is_free(self) -> bool:
        """Whether no process has the port."""
        return _port_is_free(self.address)

    @property
    def is_known(self) -> bool:
        """Whether a lobby is seen there."""
        membership = self._membership
        return membership is not None and membership.is_known

    def take_over(self, stop: threading.Event) -> None:
        """Keep the lobby, if nobody has the port."""
        if self._lobby is not None or not self.is_free:
            return
        try:
            lobby = Lobby(self.endpoint, self._key)
        except zenoh.ZError:
            return  # another process was quicker
        with self._lock:
            if not stop.is_set():
                self._lobby = lobby
                return
        lobby.close()

    def join(self, session: zenoh.Session, endpoint: str) -> None:
        """Have ``session`` become known there."""
        if self._membership is None:
            self._membership = Membership(session, endpoint, self.endpoint, self._key)

    def renew(self, stop: threading.Event) -> None:
        """Have the session introduced, if no lobby knows it."""
        membership = self._membership
        if membership is not None:
            membership.renew(stop)

    @property
    def is_silent(self) -> bool:
        """Whether no lobby was found there."""
        membership = self._membership
        return membership is not None and membership.is_silent

    def give_up(self) -> None:
        """Keep no lobby here, and be no member."""
        with self._lock:
            lobby, self._lobby = self._lobby, None
        self._membership = None
        if lobby is not None:
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
