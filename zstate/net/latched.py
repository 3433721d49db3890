"""Latched values (ROS 1; transient local in DDS): late joiners receive the current value of each key.

Zenoh's advanced publisher caches its value and announces itself by a liveliness token. Zenoh's advanced
subscriber queries all caches at once when it opens: a reader of a thousand robots then receives tens of
megabytes in one burst, and the router forwards no robot's samples until they are through. So the caches are
queried here, a few at a time.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial

import zenoh

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import Closed, InvalidInput
from zstate.net.queryable import Queryable, Reply, query
from zstate.net.sample_history import RoundRobinQueue
from zstate.net.session import Session
from zstate.net.streams import Receiver, SharedSubscription, call_for_each, subscribe_to_all, to_serialized
from zstate.wire.protocol import SerializedSample

CAPACITY = 4096
HEARTBEAT_S = 0.5

_LOG = logging.getLogger("zstate")

_TOKENS = 16_384
"""Waiting announcements of publishers; more arrive together only if so many publishers exist."""
_MAX_IN_FLIGHT = 8
_MAX_ATTEMPTS = 3
_ANSWER_WITHIN_S = 2.0
_HANDLED_WITHIN_S = 0.5
"""For a cached value that a full ring has dropped; a slow callback then has a few more waiting."""


class LatchedPublisher(Closeable):
    """Publisher of one value on one key for current and later subscribers, while this publisher lives.

    Once it closes or dies, late joiners do not receive the value. Subscribers that have it keep it, unless it
    was withdrawn. An ``urgent`` value overtakes all samples that wait for the network. ``is_large`` is for
    values above 1 MB; it takes a thread.
    """

    def __init__(
        self, session: Session, key: str, encoding: str, *, urgent: bool = False, is_large: bool = False
    ) -> None:
        self._session = session
        self._key = key
        if is_large:
            self._publisher = _LargeValuePublisher(session, key, encoding)
            return
        misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session.zenoh,
            key,
            encoding=encoding or None,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.REAL_TIME if urgent else zenoh.Priority.DATA,
            express=urgent,
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


def cached_values(session: Session, keyexpr: str, timeout_s: float) -> Iterator[SerializedSample]:
    """The values that latched publishers on ``keyexpr`` cache for late joiners now."""
    cached = f"{keyexpr}/@adv/**"
    for reply in query(session.zenoh, cached, timeout_s, accept_replies=zenoh.ReplyKeyExpr.ANY):
        if reply.ok is not None:
            yield to_serialized(reply.ok)


# zenoh 1.10, the cache of an advanced publisher replies in the task that receives: delete when fixed
class _LargeValuePublisher:
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


@dataclass(frozen=True)
class _CachedValue:
    """The reply of a publisher's cache, in the order in which it arrived among the live samples."""

    sample: zenoh.Sample
    on_handled: Callable[[], None]


class LatchedSubscriber(Receiver[zenoh.Sample | _CachedValue]):
    """Subscriber to the current value of every matching key, then to each change.

    ``on_value(sample)`` is called from one thread of this subscriber, for several key expressions too; the
    payload is empty if the value was withdrawn. ``on_batch_end()`` is called after those that have arrived
    together. ``Receiver`` describes slow and failing callbacks; ``capacity`` values wait at most.

    In ROS each message of a writer of /tf_static adds to the ones before, and its cache has the last one: so
    a cached value is not handled before the live samples that arrived earlier.
    """

    def __init__(
        self,
        session: Session,
        keyexprs: str | Sequence[str],
        on_value: Callable[[SerializedSample], None],
        *,
        on_batch_end: Callable[[], object] | None = None,
        capacity: int = CAPACITY,
    ) -> None:
        self._on_value = on_value
        self._on_batch_end = on_batch_end
        self._numbers: BoundedDict[str, int | zenoh.Timestamp] = BoundedDict()
        keyexprs = (keyexprs,) if isinstance(keyexprs, str) else keyexprs
        recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        declare = partial(zenoh.ext.declare_advanced_subscriber, session.zenoh, recovery=recovery)
        live: SharedSubscription[zenoh.Sample | _CachedValue] = SharedSubscription(
            keyexprs, capacity, declare
        )
        self._arrived = live.handler
        super().__init__(session, live, capacity)
        try:
            # After subscribing, so that no change falls between a cached value and the live ones.
            self._cached = _CachedValues(session, keyexprs, self._add_cached)
        except BaseException:
            super().close()
            raise

    def _add_cached(self, sample: zenoh.Sample) -> None:
        """Add the reply of a cache to what has arrived; wait until it is handled, at most half a second."""
        handled = threading.Event()
        self._arrived.put(_CachedValue(sample, handled.set))
        handled.wait(_HANDLED_WITHIN_S)

    def _on_batch(self, batch: list[zenoh.Sample | _CachedValue]) -> None:
        try:
            call_for_each(batch, self._on_arrival)
        finally:
            if self._on_batch_end is not None:
                self._on_batch_end()

    def _on_arrival(self, arrival: zenoh.Sample | _CachedValue) -> None:
        if not isinstance(arrival, _CachedValue):
            self._on_sample(arrival)
            return
        try:
            self._on_sample(arrival.sample)
        finally:
            arrival.on_handled()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if self._is_newer(sample):
            # A delete has no payload, and Zenoh's cache replays it to late joiners as an empty put.
            self._on_value(to_serialized(sample))

    def _is_newer(self, sample: zenoh.Sample) -> bool:
        """Whether ``sample`` is newer than the others of its publisher: a cached one may come after them."""
        source, number = sample.source_info, sample.timestamp
        if source is not None:
            publisher, number = str(source.source_id), source.source_sn
        elif number is not None:  # another program's: its publishers have no numbers
            publisher = f"{sample.key_expr} {number.get_id()}"
        else:
            return True
        before = self._numbers.get(publisher)
        if before is not None and number <= before:  # pyright: ignore[reportOperatorIssue] # both of one kind
            return False
        self._numbers[publisher] = number
        return True

    def close(self) -> None:
        self._closed = True  # what is cached is no longer handled
        self._cached.close()
        super().close()


@dataclass(eq=False)
class _Request:
    """The requests to the cache of one publisher, on the key of its token."""

    token: str
    attempts: int = 0
    replies: Iterator[zenoh.Reply] | None = None


# zenoh 1.10, an advanced subscriber queries all caches at once: delete when it has a limit
class _CachedValues(Receiver[zenoh.Sample]):
    """Requests the cached value of each publisher on ``keyexprs`` once it is announced, now or later.

    At most eight requests are in flight. Keys take turns, so that many silent publishers of one key do not
    delay the others. A request that times out is repeated twice; the third timeout is logged as a warning.
    """

    def __init__(
        self, session: Session, keyexprs: Sequence[str], on_value: Callable[[zenoh.Sample], None]
    ) -> None:
        self._on_value = on_value
        tokens = [f"{keyexpr}/@adv/pub/**" for keyexpr in keyexprs]
        declare = partial(session.zenoh.liveliness().declare_subscriber, history=True)
        super().__init__(session, subscribe_to_all(tokens, _TOKENS, declare), _TOKENS)

    def _on_batch(self, batch: list[zenoh.Sample]) -> None:
        call_for_each(self._values(batch), self._on_value)

    def _values(self, tokens: list[zenoh.Sample]) -> Iterator[zenoh.Sample]:
        """The values of the publishers with these ``tokens``, and of those announced while waiting."""
        waiting: RoundRobinQueue[_Request] = RoundRobinQueue()
        in_flight: deque[_Request] = deque()
        # Undeclared, also at this moment by another thread (RuntimeError), or the session was closed.
        with suppress(Closed, zenoh.ZError, RuntimeError):
            while not self._closed:
                for token in tokens:
                    if token.kind == zenoh.SampleKind.PUT:
                        self._add(waiting, _Request(str(token.key_expr)))
                while len(in_flight) < _MAX_IN_FLIGHT and (request := waiting.pop(0.0)) is not None:
                    self._send(request)
                    in_flight.append(request)
                if not in_flight:
                    return
                request = in_flight.popleft()
                for reply in request.replies or ():
                    if reply.ok is not None:
                        yield reply.ok
                    elif request.attempts < _MAX_ATTEMPTS:  # Zenoh's own reply at the timeout
                        self._add(waiting, request)
                    else:
                        _log_silent_publisher(request.token)
                tokens = list(iter(self._subscribed.handler.try_recv, None))

    @staticmethod
    def _add(waiting: RoundRobinQueue[_Request], request: _Request) -> None:
        waiting.add(request.token.partition("/@adv/")[0], request)

    def _send(self, request: _Request) -> None:
        request.attempts += 1
        request.replies = query(
            self._session.zenoh,
            f"{request.token}?_max=1",
            _ANSWER_WITHIN_S,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
        )


def _log_silent_publisher(token: str) -> None:
    key = token.partition("/@adv/")[0]
    facts = {"event": "no latched value", "key": key}
    text = (
        "the publisher of %r is announced, but its current value did not arrive in %d requests of %g s each; "
        "it is received when it changes. Its process is suspended, or the link is too slow for its size"
    )
    _LOG.warning(text, key, _MAX_ATTEMPTS, _ANSWER_WITHIN_S, extra=facts)
