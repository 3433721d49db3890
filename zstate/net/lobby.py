"""The lobby: where the processes of one host are told of each other. It carries no data."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import zenoh

from zstate.net.config import our_config
from zstate.net.runtime import open_zenoh

# The @ keeps it out of what is asked for with wildcards.
LOBBY_KEY = "@zstate/lobby"


def lobby_key(number: int) -> str:
    """What the lobby at the rendezvous address ``number`` subscribes to: each is told from the others."""
    return f"{LOBBY_KEY}/{number}" if number else LOBBY_KEY


class Lobby:
    """A Zenoh peer that listens at ``endpoint``, and subscribes to ``key`` to show that it is open.

    Raises ZError where somebody listens already.
    """

    def __init__(self, endpoint: str, key: str = LOBBY_KEY) -> None:
        self._session = open_zenoh(our_config("peer", (), [endpoint]))
        self._sign = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(1))

    def close(self) -> None:
        """Leave."""
        # Closing undeclares nothing, and whoever connects at that moment would see the sign for ever.
        self._sign.undeclare()
        self._session.close()
