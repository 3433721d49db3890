"""Discovery of the processes of one host, without a router, configuration or multicast.

Every session of the default mode connects to one fixed loopback port, the rendezvous. The process that holds
the port runs a *rendezvous peer* there: a Zenoh peer that only gossips endpoints; no data flows through it.
When its process dies, another process takes the port over; existing links stay. Each session checks several
times a second that it is registered, which means that the rendezvous peer knows it, and registers again if
not.

A process that is stopped (Ctrl-Z) keeps its port and does not answer. If no rendezvous peer answers for a
second, sessions meet at the next address in the same way and keep checking the first. Once it answers, they
register there, and so meet the process that was stopped.
"""

from __future__ import annotations

import os
import socket
import threading
import time
import weakref
from contextlib import ExitStack, suppress

import zenoh

from zstate._util.endpoint import parse_host_port
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.errors import Closed, ConfigError
from zstate.net.at_exit import join_at_exit
from zstate.net.config import default_config
from zstate.net.open import open_zenoh

RENDEZVOUS_VARIABLE = "ZSTATE_RENDEZVOUS"
RENDEZVOUS = "127.0.0.1:7450 127.0.0.1:7451 127.0.0.1:7452"
PEER_KEY = "@zstate/lobby"
"""Subscribed to by rendezvous peers. The @ keeps it out of what wildcards match."""

REGISTRATION_TIMEOUT_S = 1.0
_FIRST_PAUSE_S = 0.2  # Zenoh reconnects by itself within this time, if it has noticed
_MAX_PAUSE_S = 5.0  # the process that has the port may be frozen, or run no rendezvous peer
_REGISTRATION_POLL_S = 0.01

PROBE_PERIOD_S = 0.2
JOIN_WITHIN_S = 0.3
_DISCOVERY_TIMEOUT_S = 3.0
_ANSWER_WITHIN_S = 10.0  # on a busy machine an attempt to register takes several seconds
_DISCOVERY_POLL_S = 0.002  # nothing reports a port that becomes free


def rendezvous_key(number: int) -> str:
    """The key of the peer at the rendezvous address ``number``, which distinguishes it from the others."""
    return f"{PEER_KEY}/{number}" if number else PEER_KEY


def rendezvous_addresses() -> tuple[tuple[str, int], ...]:
    """Hosts and ports of the rendezvous, each used while those before it are silent.

    Read from ``ZSTATE_RENDEZVOUS``, separated by blanks; else 127.0.0.1:7450, 7451, 7452.
    """
    text = os.environ.get(RENDEZVOUS_VARIABLE) or RENDEZVOUS
    parsed = [parse_host_port(address) for address in text.split()]
    # IPv6 is not supported here, and port 0 cannot be found by others.
    addresses = tuple(address for address in parsed if address and address[1] and ":" not in address[0])
    if not parsed or len(addresses) < len(parsed):
        raise ConfigError(
            f"{RENDEZVOUS_VARIABLE} is {text!r}; write 'host:port', for instance '127.0.0.1:7450', or "
            "several with blanks between",
            path=RENDEZVOUS_VARIABLE,
        )
    return addresses


class RendezvousRegistration:
    """Keeps ``session``, which listens at ``endpoint``, known to the rendezvous peer at ``rendezvous``.

    A link is not proof of registration: a link opened while the peer is closing stays up until that process
    exits, and one that breaks during setup is not retried. Zenoh reports both as connected. An open
    rendezvous peer is recognised by its subscription to ``key``.
    """

    def __init__(self, session: zenoh.Session, endpoint: str, rendezvous: str, key: str = PEER_KEY) -> None:
        self._publisher = session.declare_publisher(key)
        self._endpoints = (rendezvous, endpoint)
        self._pause_s = _FIRST_PAUSE_S
        self._due: float | None = None
        self.is_silent = False
        """Whether no rendezvous peer answered the last registration."""

    def refresh(self, stop: threading.Event) -> None:
        """Check, and register the session if it has seen no rendezvous peer for a while.

        Called several times a second. Takes up to a second, or until ``stop``. Raises ZError if a
        registration is due and the session is closed.
        """
        if self.is_registered:
            self._pause_s, self._due, self.is_silent = _FIRST_PAUSE_S, None, False
        elif self._due is None:
            self._due = time.monotonic() + self._pause_s
        elif time.monotonic() >= self._due:
            self._register(stop)
            self.is_silent = not self.is_registered
            self._pause_s = min(2.0 * self._pause_s, _MAX_PAUSE_S)
            self._due = time.monotonic() + self._pause_s

    @property
    def is_registered(self) -> bool:
        """Whether the session sees a rendezvous peer there now."""
        # zenoh 1.10, a MatchingStatus, always true, is a bool in the stub: delete the comment when fixed
        return bool(self._publisher.matching_status.matching)  # pyright: ignore

    def _register(self, stop: threading.Event) -> None:
        self._publisher.put(b"")  # has no receiver, but fails if the session is closed
        # zenoh 1.10, an open session cannot be made to connect: delete when it can. But the rendezvous peer
        # connects to each endpoint that gossip brings it, and a temporary peer that connects to both of them
        # gossips ours.
        config = default_config("peer", self._endpoints, ())
        config.insert_json5("scouting/gossip/autoconnect", '{"peer": []}')  # to these two only
        deadline = time.monotonic() + REGISTRATION_TIMEOUT_S
        with suppress(zenoh.ZError), open_zenoh(config):
            while not self.is_registered and time.monotonic() < deadline:
                if stop.wait(_REGISTRATION_POLL_S):
                    break


class Rendezvous:
    """This process's part in the rendezvous: runs the peer if the port is free, or when it becomes free."""

    def __init__(self, addresses: tuple[tuple[str, int], ...]) -> None:
        self._places = [_Address(address, rendezvous_key(number)) for number, address in enumerate(addresses)]
        self._stop = fork_safe(threading.Event())
        self._watcher: threading.Thread | None = None
        self._places[0].open_peer(self._stop)
        _OPEN.add(self)

    @property
    def silent(self) -> tuple[tuple[str, int], ...]:
        """The addresses whose ports are in use, but without an answering rendezvous peer."""
        return tuple(place.address for place in self._places if place.is_silent and not place.is_free)

    @property
    def endpoint(self) -> str:
        """The endpoint of the first rendezvous peer."""
        return self._places[0].endpoint

    def watch(self, session: zenoh.Session, endpoint: str) -> None:
        """Take the port over when it becomes free; keep ``session`` at ``endpoint`` registered.

        Returns once it is registered, or if no rendezvous peer answers.
        """
        self._places[0].join(session, endpoint)
        watcher = threading.Thread(
            target=self._watch, args=(session, endpoint), name="zstate rendezvous", daemon=True
        )
        join_at_exit(watcher).start()
        self._watcher = watcher
        self.wait(_DISCOVERY_TIMEOUT_S)

    def wait(self, within_s: float) -> None:
        """Wait until a rendezvous peer has answered, or none does; at most ``within_s`` [s]."""
        deadline = time.monotonic() + within_s
        while not any(place.is_registered for place in self._places) and time.monotonic() < deadline:
            if self._places[0].is_free or all(place.is_silent for place in self._places):
                return  # the port is being taken over; or no peer answers
            time.sleep(_DISCOVERY_POLL_S)

    def close(self) -> None:
        """Release the ports held here; other processes take them over."""
        _OPEN.discard(self)
        self._stop.set()
        if self._watcher not in (None, threading.current_thread()):
            self._watcher.join(JOIN_WITHIN_S)
        for place in self._places:
            place.leave()

    def _watch(self, session: zenoh.Session, endpoint: str) -> None:
        with suppress(zenoh.ZError, Closed):  # the session was closed, or the process ends
            while not self._stop.wait(PROBE_PERIOD_S):
                places = iter(self._places)
                for place in places:
                    place.open_peer(self._stop)
                    place.join(session, endpoint).refresh(self._stop)
                    if not place.is_silent:
                        break
                for place in places:
                    place.leave()


_OPEN: weakref.WeakSet[Rendezvous] = weakref.WeakSet()


def silent_addresses() -> tuple[tuple[str, int], ...]:
    """The rendezvous addresses where sessions of this process get no answer from the program that listens.

    Waits for up to 10 s for sessions that have just been opened and do not know yet.
    """
    for rendezvous in tuple(_OPEN):
        rendezvous.wait(_ANSWER_WITHIN_S)
    return tuple(sorted({address for rendezvous in tuple(_OPEN) for address in rendezvous.silent}))


class _Address:
    """One rendezvous address: the peer there if it runs in this process, and the session's registration."""

    def __init__(self, address: tuple[str, int], key: str) -> None:
        self.endpoint = f"tcp/{address[0]}:{address[1]}"
        self.address = address
        self._key = key
        self._peer: ExitStack | None = None
        self._lock = fork_safe_lock()
        self._registration: RendezvousRegistration | None = None

    @property
    def is_free(self) -> bool:
        """Whether no process has the port."""
        # Binding fails while a process listens and, unlike connecting, does not disturb it.
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(self.address)
            except OSError:
                return False
        return True

    @property
    def is_registered(self) -> bool:
        registration = self._registration
        return registration is not None and registration.is_registered

    @property
    def is_silent(self) -> bool:
        registration = self._registration
        return registration is not None and registration.is_silent

    def open_peer(self, stop: threading.Event) -> None:
        """Run the rendezvous peer, if no process has the port."""
        if self._peer is not None or not self.is_free:
            return
        peer = ExitStack()
        try:
            session = open_zenoh(default_config("peer", (), [self.endpoint]))
            peer.callback(session.close)
            # zenoh 1.10, closing undeclares nothing, and a session that connects at that moment sees the
            # subscription for ever: delete when fixed. So it is undeclared first.
            peer.callback(session.declare_subscriber(self._key, zenoh.handlers.RingChannel(1)).undeclare)
        except zenoh.ZError:
            return  # another process was quicker
        with self._lock:
            if not stop.is_set():
                self._peer = peer
                return
        peer.close()

    def join(self, session: zenoh.Session, endpoint: str) -> RendezvousRegistration:
        """The registration of ``session`` there."""
        registration = self._registration  # ``leave`` may clear it at the same time
        if registration is None:
            registration = RendezvousRegistration(session, endpoint, self.endpoint, self._key)
            self._registration = registration
        return registration

    def leave(self) -> None:
        """Run no rendezvous peer here, and stop registering."""
        with self._lock:
            peer, self._peer = self._peer, None
        self._registration = None
        if peer is not None:
            peer.close()


def free_endpoint() -> str:
    """A loopback endpoint whose port is free now; unlike with port 0, it is known before Zenoh opens it."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
