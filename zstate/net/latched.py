"""Latched values (ROS 1; transient local in DDS): late joiners receive the current value of each key.

Zenoh's advanced publisher caches its value and announces itself by a liveliness token. Zenoh's advanced
subscriber queries all caches at once when it opens: a reader of a thousand robots then receives tens of
megabytes in one burst, and the router forwards no robot's samples until they are through. So the caches are
queried here, a few at a time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import zenoh

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate.errors import Closed, InvalidInput
from zstate.net.queryable import query
from zstate.net.requests import ReplyHandler, Request, Requests
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.net.streams import Receiver, call_for_each, to_serialized
from zstate.wire.protocol import SerializedSample

CAPACITY = 4096
HEARTBEAT_S = 0.5

_LOG = logging.getLogger("zstate")

_MAX_IN_FLIGHT = 8
_TIMEOUTS_S = 2.0, 8.0, 60.0
"""Of a request and its repetitions: a map of 16 MB takes longer than the first over a slow link."""


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
            from zstate.net.large_value import LargeValuePublisher  # noqa: PLC0415 - maps alone are so large

            self._publisher = LargeValuePublisher(session, key, encoding)
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


class LatchedSubscriber(Receiver):
    """Subscriber to the current value of every matching key, then to each change.

    ``on_value(sample)`` is called from one thread, of this subscriber unless ``thread`` is given; the payload
    is empty if the value was withdrawn. ``on_batch_end()`` is called after those that have arrived together.
    ``Receiver`` describes slow and failing callbacks; ``capacity`` values wait at most.

    The cached value of each publisher is requested once it is announced, now or later. In ROS each message
    of a writer of /tf_static adds to the ones before, and its cache has the last one: so a cached value is
    not handled before the live samples that arrived earlier.
    """

    _is_mixed = True

    def __init__(
        self,
        session: Session,
        keyexprs: str | Sequence[str],
        on_value: Callable[[SerializedSample], None],
        *,
        on_batch_end: Callable[[], object] | None = None,
        capacity: int = CAPACITY,
        thread: ServiceThread | None = None,
    ) -> None:
        self._on_value = on_value
        self._on_batch_end = on_batch_end
        self._numbers: BoundedDict[str, int | zenoh.Timestamp] = BoundedDict()
        keyexprs = (keyexprs,) if isinstance(keyexprs, str) else keyexprs
        recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        declare = partial(zenoh.ext.declare_advanced_subscriber, session.zenoh, recovery=recovery)
        super().__init__(session, keyexprs, declare, capacity, thread=thread)
        self._requests = Requests(session, self._thread, _MAX_IN_FLIGHT)
        try:
            # After subscribing, so that no change falls between a cached value and the live ones.
            tokens = [f"{keyexpr}/@adv/pub/**" for keyexpr in keyexprs]
            declare = partial(session.zenoh.liveliness().declare_subscriber, history=True)
            self._subscribe(tokens, declare, self._on_token)
        except BaseException:
            self.close()
            raise

    def _on_token(self, token: zenoh.Sample) -> None:
        """Called in a thread of Zenoh, which must not wait."""
        if token.kind == zenoh.SampleKind.PUT:
            self._requests.add(_CacheRequest(str(token.key_expr), self._put))

    def _on_batch(self, batch: list[zenoh.Sample]) -> None:
        try:
            call_for_each(batch, self._on_sample)
        finally:
            if self._on_batch_end is not None:
                self._on_batch_end()

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


# zenoh 1.10, an advanced subscriber queries all caches at once: delete when it has a limit
class _CacheRequest(Request):
    """The requests to the cache of the publisher with ``token``; its value is ``put`` among the live ones.

    The request has ended for the thread once the value that it brought has been handled. One that times out
    is repeated twice; the third timeout is logged as a warning.
    """

    def __init__(self, token: str, put: Callable[[zenoh.Sample], None]) -> None:
        self.source = token.partition("/@adv/")[0]
        self._token = token
        self._put = put
        self._attempts = 0
        self._has_timed_out = False

    def send(self, session: zenoh.Session, handler: ReplyHandler) -> None:
        self._has_timed_out = False
        session.get(
            f"{self._token}?_max=1",
            handler,
            timeout=_TIMEOUTS_S[self._attempts],
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
        )
        self._attempts += 1

    def on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._put(reply.ok)
        else:  # Zenoh's own reply at the timeout
            self._has_timed_out = True

    def on_end(self) -> float | None:
        if not self._has_timed_out:
            return None
        if self._attempts < len(_TIMEOUTS_S):
            return 0.0
        _log_silent_publisher(self.source)
        return None


def _log_silent_publisher(key: str) -> None:
    facts = {"event": "no latched value", "key": key}
    text = (
        "the publisher of %r is announced, but its current value did not arrive in %d requests, the last of "
        "%g s; it is received when it changes. Its process is suspended, or the link is too slow for its size"
    )
    _LOG.warning(text, key, len(_TIMEOUTS_S), _TIMEOUTS_S[-1], extra=facts)
