"""How processes of one host find each other without a router, configuration or multicast.

Every session of the default mode connects to one fixed loopback port. Whichever process holds that
port keeps a *lobby* there: a tiny Zenoh peer that tells newcomers where the others listen, and
carries no data. When its process dies, another one takes the port over; links that exist stay. Each
session looks several times a second whether the lobby knows it, and is introduced again if not.

A process that is stopped (Ctrl-Z) keeps its port and answers nobody. Where no lobby answers for a
second, sessions meet at the next rendezvous address in the same way, and go on looking at the first: once it
answers, they are introduced there, and so meet the process that was stopped.

The lobby: where the processes of one host are told of each other. It carries no data.

Membership: that the lobby knows of a session, whoever keeps the lobby.
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
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.errors import Closed, ConfigError
from zstate.net.at_exit import join_at_exit
from zstate.net.config import default_config
from zstate.net.open import open_zenoh

# The @ keeps it out of what is asked for with wildcards.
LOBBY_KEY = "@zstate/lobby"


def lobby_key(number: int) -> str:
    """What the lobby at the rendezvous address ``number`` subscribes to: each is told from the others."""
    return f"{LOBBY_KEY}/{number}" if number else LOBBY_KEY


class RendezvousPeer:
    """A Zenoh peer that listens at ``endpoint``, and subscribes to ``key`` to show that it is open.

    Raises ZError where somebody listens already.
    """

    def __init__(self, endpoint: str, key: str = LOBBY_KEY) -> None:
        self._session = open_zenoh(default_config("peer", (), [endpoint]))
        self._sign = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(1))

    def close(self) -> None:
        """Leave."""
        # Closing undeclares nothing, and whoever connects at that moment would see the sign for ever.
        self._sign.undeclare()
        self._session.close()


INTRODUCED_WITHIN_S = 1.0
_FIRST_PAUSE_S = 0.2  # Zenoh connects again by itself within this time, if it has noticed
_LONGEST_PAUSE_S = 5.0  # whoever has the port may be frozen, or keep no lobby
_ROUND_S = 0.01


class RendezvousRegistration:
    """Sees to it that ``session``, which listens at ``endpoint``, is known in the lobby at another.

    That there is a link to the lobby does not say so. One that is made while the lobby closes stays up
    with nobody behind it until that process ends; and one that breaks in the moment in which it is made
    is not tried again. Zenoh calls both connected. An open lobby is told by what it subscribes to.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, lobby: str, key: str = LOBBY_KEY) -> None:
        self._publisher = session.declare_publisher(key)
        self._endpoints = (lobby, endpoint)
        self._pause_s = _FIRST_PAUSE_S
        self._due: float | None = None
        self.is_silent = False
        """Whether no lobby was found when the session was to be introduced there last."""

    def refresh(self, stop: threading.Event) -> None:
        """Look, and have the session introduced where it has seen no lobby for a while.

        To be called several times a second. Takes up to a second, or until ``stop``. Raises ZError when
        that is due and the session is closed.
        """
        if self.is_known:
            self._pause_s, self._due, self.is_silent = _FIRST_PAUSE_S, None, False
        elif self._due is None:
            self._due = time.monotonic() + self._pause_s
        elif time.monotonic() >= self._due:
            self._register(stop)
            self.is_silent = not self.is_known
            self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
            self._due = time.monotonic() + self._pause_s

    @property
    def is_known(self) -> bool:
        """Whether a lobby is seen there now."""
        # the stub says bool, but it is an object and always true
        return bool(self._publisher.matching_status.matching)  # pyright: ignore

    def _register(self, stop: threading.Event) -> None:
        self._publisher.put(b"")  # reaches nobody, but fails where the session is closed
        # A session cannot be told to connect once it is open. But the lobby connects to whomever it is
        # told of, and it is told by a peer that is there for a moment and connects to both.
        config = default_config("peer", self._endpoints, ())
        config.insert_json5("scouting/gossip/autoconnect", '{"peer": []}')  # and to nobody else
        deadline = time.monotonic() + INTRODUCED_WITHIN_S
        with suppress(zenoh.ZError), open_zenoh(config):
            while not self.is_known and time.monotonic() < deadline and not stop.wait(_ROUND_S):
                pass


RENDEZVOUS_VARIABLE = "ZSTATE_RENDEZVOUS"
RENDEZVOUS = "127.0.0.1:7450 127.0.0.1:7451 127.0.0.1:7452"
PROBE_PERIOD_S = 0.2
JOIN_WITHIN_S = 0.3

_MET_WITHIN_S = 3.0
_ROUND_S_RENDEZVOUS = 0.002


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
        self._stop = fork_safe(threading.Event())
        self._watcher: threading.Thread | None = None
        self._places[0].open_peer(self._stop)
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
            time.sleep(_ROUND_S_RENDEZVOUS)

    def close(self) -> None:
        """Give the ports up that are ours; other processes take them over."""
        _MEETING.discard(self)
        self._stop.set()
        if self._watcher not in (None, threading.current_thread()):
            self._watcher.join(JOIN_WITHIN_S)
        for place in self._places:
            place.leave()

    def _watch(self, session: zenoh.Session, endpoint: str) -> None:
        with suppress(zenoh.ZError, Closed):  # the session was closed, or the process ends
            while not self._stop.wait(PROBE_PERIOD_S):
                self._check(session, endpoint)

    def _check(self, session: zenoh.Session, endpoint: str) -> None:
        places = iter(self._places)
        for place in places:
            place.open_peer(self._stop)
            place.join(session, endpoint)
            place.renew(self._stop)
            if not place.is_silent:
                break
        for place in places:
            place.leave()


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
        self._lobby: RendezvousPeer | None = None
        self._lock = fork_safe_lock()
        self._membership: RendezvousRegistration | None = None

    @property
    def is_free(self) -> bool:
        """Whether no process has the port."""
        return _port_is_free(self.address)

    @property
    def is_known(self) -> bool:
        """Whether a lobby is seen there."""
        membership = self._membership
        return membership is not None and membership.is_known

    def open_peer(self, stop: threading.Event) -> None:
        """Keep the lobby, if nobody has the port."""
        if self._lobby is not None or not self.is_free:
            return
        try:
            lobby = RendezvousPeer(self.endpoint, self._key)
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
            self._membership = RendezvousRegistration(session, endpoint, self.endpoint, self._key)

    def renew(self, stop: threading.Event) -> None:
        """Have the session introduced, if no lobby knows it."""
        membership = self._membership
        if membership is not None:
            membership.refresh(stop)

    @property
    def is_silent(self) -> bool:
        """Whether no lobby was found there."""
        membership = self._membership
        return membership is not None and membership.is_silent

    def leave(self) -> None:
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
