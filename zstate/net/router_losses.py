"""Losses of routers, which take the liveliness tokens of all robots behind them along."""

from __future__ import annotations

import math
import time
from contextlib import suppress

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.net.session import Session

_RECENT_S = 0.1
_ROUTER_EVENT_S = 0.02
_POLL_S = 0.002  # zenoh 1.10, channels have no receive with a timeout: delete when they have


# zenoh 1.10, tokens behind a lost router are undeclared like those of ended writers: delete when they differ
class RouterLossDetector(Closeable):
    """The routers that a session is connected to. Has no thread: reads events when it is asked."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._routers: set[str] = set()
        self._lost_at = -math.inf
        self._lock = fork_safe_lock()
        channel: zenoh.handlers.RingChannel[zenoh.TransportEvent] = zenoh.handlers.RingChannel(256)
        self._events = session.zenoh.info.declare_transport_events_listener(channel, history=True)

    def lost_recently(self) -> bool:
        """Whether a router was lost within the last tenth of a second.

        Tokens behind a router disappear up to a millisecond before the event of its loss. Waits for that
        event, up to 20 ms, if there is a router at all.
        """
        deadline = time.monotonic() + _ROUTER_EVENT_S
        while True:
            # The listener may be undeclared at the same time: then it has no events.
            with self._lock, suppress(zenoh.ZError):
                while (event := self._events.try_recv()) is not None:
                    zid, is_router = str(event.transport.zid), event.transport.whatami == zenoh.WhatAmI.ROUTER
                    if event.kind == zenoh.SampleKind.PUT and is_router:
                        self._routers.add(zid)
                    elif event.kind == zenoh.SampleKind.DELETE and zid in self._routers:
                        self._routers.discard(zid)
                        self._lost_at = time.monotonic()
            if time.monotonic() - self._lost_at < _RECENT_S:
                return True
            if not self._routers or time.monotonic() > deadline:
                return False
            time.sleep(_POLL_S)

    def close(self) -> None:
        self._session.release(self._events)
