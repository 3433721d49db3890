"""Latched values: whoever joins late still receives the present value of each key."""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

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
    """Keeps one value on one key for everybody, now and later, as long as this publisher lives.

    When it closes or dies, later joiners do not get the value any more; those who have it keep it,
    unless it was withdrawn.
    """

    def __init__(self, session: Session, key: str, encoding: str) -> None:
        self._session = session
        self._key = key
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session.zenoh,
            key,
            encoding=encoding or None,
            congestion_control=zenoh.CongestionControl.BLOCK,
            cache=zenoh.ext.CacheConfig(1),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=HEARTBEAT_S
            ),
            publisher_detection=True,
        )

    def set(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Replace the value, for everybody. An empty one is InvalidInput. Raises Closed."""
        if not payload:
            raise InvalidInput(f"the value of {self._key!r} is empty; withdraw() takes a value back")
        self._session.check()
        try:
            self._publisher.put(payload, attachment=attachment)
        except zenoh.ZError:
            raise Closed(f"the publisher of {self._key!r} is closed") from None

    def withdraw(self) -> None:
        """Take the value back, from everybody. Raises Closed."""
        self._session.check()
        try:
            self._publisher.delete()
        except zenoh.ZError:
            raise Closed(f"the publisher of {self._key!r} is closed") from None

    def close(self) -> None:
        """Stop keeping the value. A second call does nothing."""
        self._session.release(self._publisher)


class LatchedSubscriber(Closeable):
    """Hears the present value of every matching key, then each change.

    ``on_value(arrival)`` is called from one thread of this subscriber; the payload is empty when the
    value was withdrawn. See ``Receiver`` for what happens when it raises.
    """

    def __init__(self, session: Session, keyexpr: str, on_value: Callable[[SerializedSample], None]) -> None:
        def hand_over(batch: list[zenoh.Sample]) -> None:
            # A delete has no payload, and Zenoh's cache replays it to late joiners as an empty put.
            call_for_each(batch, lambda sample: on_value(to_serialized(sample)))

        ring: Ring = zenoh.handlers.RingChannel(CAPACITY)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session.zenoh,
            keyexpr,
            ring,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        self._receiver = Receiver(session, subscriber, hand_over, CAPACITY)

    @property
    def failures(self) -> int:
        """How often ``on_value`` raised."""
        return self._receiver.failures

    def close(self) -> None:
        """Stop within a second, also from inside ``on_value``. A second call does nothing."""
        self._receiver.close()
