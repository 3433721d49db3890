"""Latched values (ROS 1; transient local in DDS): late joiners receive the current value of each key."""

from __future__ import annotations

from collections.abc import Callable

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import Closed, InvalidInput
from zstate.net.session import Session
from zstate.net.streams import Receiver, Ring, call_for_each, to_serialized
from zstate.wire.protocol import SerializedSample

CAPACITY = 4096
HEARTBEAT_S = 0.5


class LatchedPublisher(Closeable):
    """Publisher of one value on one key for current and later subscribers, while this publisher lives.

    Once it closes or dies, late joiners do not receive the value. Subscribers that have it keep it, unless it
    was withdrawn.
    """

    def __init__(self, session: Session, key: str, encoding: str) -> None:
        self._session = session
        self._key = key
        misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session.zenoh,
            key,
            encoding=encoding or None,
            congestion_control=zenoh.CongestionControl.BLOCK,
            cache=zenoh.ext.CacheConfig(1),
            sample_miss_detection=misses,
            publisher_detection=True,
        )

    def set(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Replace the value. Raises InvalidInput if it is empty, and Closed."""
        if not payload:
            raise InvalidInput(f"the value of {self._key!r} is empty; withdraw() withdraws a value")
        self._send(lambda: self._publisher.put(payload, attachment=attachment))

    def withdraw(self) -> None:
        """Withdraw the value from all subscribers. Raises Closed."""
        self._send(self._publisher.delete)

    def _send(self, action: Callable[[], object]) -> None:
        self._session.check()
        try:
            action()
        except zenoh.ZError:
            raise Closed(f"the publisher of {self._key!r} is closed") from None

    def close(self) -> None:
        """Stop publishing the value. A second call does nothing."""
        self._session.release(self._publisher)


class LatchedSubscriber(Receiver[zenoh.Sample]):
    """Subscriber to the current value of every matching key, then to each change.

    ``on_value(sample)`` is called from one thread of this subscriber; the payload is empty if the value was
    withdrawn. ``Receiver`` describes slow and failing callbacks.
    """

    def __init__(self, session: Session, keyexpr: str, on_value: Callable[[SerializedSample], None]) -> None:
        self._on_value = on_value
        ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session.zenoh,
            keyexpr,
            ring,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        super().__init__(session, subscriber, CAPACITY)

    def _on_batch(self, batch: list[zenoh.Sample]) -> None:
        # A delete has no payload, and Zenoh's cache replays it to late joiners as an empty put.
        call_for_each(batch, lambda sample: self._on_value(to_serialized(sample)))
