"""RouterLosses: whether what has just vanished went with a router of ours."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import math
import time
from contextlib import suppress

import zenoh

from zstate.closing import Closing
from zstate.locks import new_lock
from zstate.net.session import Session

_JUST_NOW_S = 0.1
_TOLD_WITHIN_S = 0.02
_ROUND_S = 0.002


class RouterLosses(Closing):
    """The routers that a session is connected to, as they come and go. Has no thread: is asked."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._known: set[str] = set()
        self._lost_at = -math.inf
        self._lock = new_lock()
        channel: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(256)
        self._events = session.zenoh.info.declare_transport_events_listener(channel, history=True)

    def happened_just_now(self) -> bool:
        """Whether a router was lost within the last tenth of a second.

        What a router told us of is gone up to a millisecond before we are told that the router is:
        waits for that, up to 20 ms, where there is a router at all.
        """
        deadline = time.monotonic() + _TOLD_WITHIN_S
        while True:
            self._follow()
            if time.monotonic() - self._lost_at < _JUST_NOW_S:
                return True
            if not self._known or time.monotonic() > deadline:
                return False
            time.sleep(_ROUND_S)

    def _follow(self) -> None:
        # Closing may come between: a listener that is undeclared has nothing more to tell.
        with self._lock, suppress(zenoh.ZError):
            while (event := self._events.try_recv()) is not None:
                zid, is_router = str(event.transport.zid), event.transport.whatami == zenoh.WhatAmI.ROUTER
                if event.kind == zenoh.SampleKind.PUT and is_router:
                    self._known.add(zid)
                elif event.kind == zenoh.SampleKind.DELETE and zid in self._known:
                    self._known.discard(zid)
                    self._lost_at = time.monotonic()

    def close(self) -> None:
        """Follow them no more. A second call does nothing."""
        self._session.release(self._events)
