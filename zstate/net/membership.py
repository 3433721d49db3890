"""Membership: that the lobby knows of a session, whoever keeps the lobby."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import threading
import time
from contextlib import suppress

import zenoh

from zstate.net.config import our_config
from zstate.net.lobby import LOBBY_KEY
from zstate.net.runtime import open_zenoh

INTRODUCED_WITHIN_S = 1.0
_FIRST_PAUSE_S = 0.2  # Zenoh connects again by itself within this time, if it has noticed
_LONGEST_PAUSE_S = 5.0  # whoever has the port may be frozen, or keep no lobby
_ROUND_S = 0.01


class Membership:
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

    def renew(self, stop: threading.Event) -> None:
        """Look, and have the session introduced where it has seen no lobby for a while.

        To be called several times a second. Takes up to a second, or until ``stop``. Raises ZError when
        that is due and the session is closed.
        """
        if self.is_known:
            self._pause_s, self._due, self.is_silent = _FIRST_PAUSE_S, None, False
        elif self._due is None:
            self._due = time.monotonic() + self._pause_s
        elif time.monotonic() >= self._due:
            self._introduce(stop)
            self.is_silent = not self.is_known
            self._pause_s = min(2.0 * self._pause_s, _LONGEST_PAUSE_S)
            self._due = time.monotonic() + self._pause_s

    @property
    def is_known(self) -> bool:
        """Whether a lobby is seen there now."""
        # the stub says bool, but it is an object and always true
        return bool(self._publisher.matching_status.matching)  # pyright: ignore

    def _introduce(self, stop: threading.Event) -> None:
        self._publisher.put(b"")  # reaches nobody, but fails where the session is closed
        # A session cannot be told to connect once it is open. But the lobby connects to whomever it is
        # told of, and it is told by a peer that is there for a moment and connects to both.
        config = our_config("peer", self._endpoints, ())
        config.insert_json5("scouting/gossip/autoconnect", '{"peer": []}')  # and to nobody else
        deadline = time.monotonic() + INTRODUCED_WITHIN_S
        with suppress(zenoh.ZError), open_zenoh(config):
            while not self.is_known and time.monotonic() < deadline and not stop.wait(_ROUND_S):
                pass
