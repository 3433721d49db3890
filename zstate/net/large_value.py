"""Latched values above 1 MB, whose cache replies from a thread of its own."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

import zenoh

from zstate._util.fork_safe import fork_safe_lock
from zstate.net.queryable import Queryable, Reply
from zstate.net.session import Session


# zenoh 1.10, the cache of an advanced publisher replies in the task that receives: delete when fixed
class LargeValuePublisher:
    """Zenoh's advanced publisher, with a cache that replies from a thread of its own.

    Zenoh's cache replies inside the task that receives the query. That task waits while the sending queue is
    full, beyond 1 MB and the buffers of the socket; no thread then polls the sockets (``zstate.net.open``),
    and after 5 s Zenoh closes the link.

    Replies of Python have no sequence numbers. So samples have timestamps, which advanced subscribers use as
    well: increasing, and with an identifier of this publisher, as they compare those of one identifier.
    """

    def __init__(self, session: Session, key: str, encoding: str) -> None:
        self._session = session
        self._key = key
        self._encoding = encoding
        self._id = secrets.token_bytes(16)
        self._stamp = datetime.fromtimestamp(0, UTC)
        self._lock = fork_safe_lock()
        self._value: Reply | None = None
        self._publisher = session.zenoh.declare_publisher(
            key, encoding=encoding or None, congestion_control=zenoh.CongestionControl.BLOCK
        )
        # The form of the tokens of advanced publishers with timestamps.
        token = f"{key}/@adv/pub/{session.zid}/uhlc/{session.next_number()}"
        self._cache = Queryable(session, token, self._cached)
        self._token = session.zenoh.liveliness().declare_token(token)

    def _cached(self, _: Mapping[str, str]) -> Reply | None:
        return self._value

    def put(self, payload: bytes, *, attachment: bytes | None = None) -> None:
        with self._lock:
            timestamp = self._next_timestamp(payload, attachment)
            self._publisher.put(payload, attachment=attachment, timestamp=timestamp)

    def delete(self) -> None:
        with self._lock:
            self._publisher.delete(timestamp=self._next_timestamp(b"", None))

    def _next_timestamp(self, payload: bytes, attachment: bytes | None) -> zenoh.Timestamp:
        """The timestamp of a new value, which is cached before it is sent: late joiners then miss none."""
        self._stamp = max(datetime.now(UTC), self._stamp + timedelta(microseconds=1))
        timestamp = zenoh.Timestamp(self._stamp, self._id)
        self._value = Reply(
            payload, self._encoding, key=self._key, attachment=attachment, timestamp=timestamp
        )
        return timestamp

    def undeclare(self) -> None:
        self._session.release(self._token)
        self._cache.close()
        self._publisher.undeclare()
