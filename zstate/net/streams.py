"""Streams: each sample matters less than the next one. Newest wins, nobody waits.

One daemon thread that drains a Zenoh channel in batches.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Generic, Protocol, TypeAlias, TypeVar

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import Closed
from zstate.net.at_exit import join_at_exit
from zstate.net.session import Session, Undeclarable
from zstate.wire.protocol import SerializedSample
from zstate.wire.sizes import ATTACHMENT_BYTES, LATCHED_BYTES, SAMPLE_BYTES

JOIN_WITHIN_S = 0.8

Ring: TypeAlias = "zenoh.handlers.RingChannel[zenoh.Sample]"

T = TypeVar("T")


class Subscribed(Undeclarable, Protocol[T]):
    """A Zenoh subscriber or queryable of any kind that delivers into a channel."""

    @property
    def handler(self) -> zenoh.Handler[T]: ...


def call_for_each(batch: Iterable[T], take: Callable[[T], object]) -> None:
    """Call ``take`` with each item of ``batch``; an exception of one is raised after the last item."""
    failure: Exception | None = None
    for item in batch:
        try:
            take(item)
        except Exception as error:  # noqa: PERF203 - the other items are not to blame
            failure = error
    if failure is not None:
        raise failure


class Receiver(Generic[T]):
    """Hands what arrives to ``on_batch``, everything that waits at once, oldest first.

    A ring of ``capacity`` lies between: when it is full the oldest samples are lost. A batch that
    fills it is counted in ``full_batches``, so that a gap in front of it, or in it, can be told from
    one of the network. An exception of ``on_batch`` is counted in ``failures``; the first also goes to
    ``threading.excepthook``. The thread goes on.
    """

    def __init__(
        self,
        session: Session,
        subscribed: Subscribed[T],
        on_batch: Callable[[list[T]], None],
        capacity: int,
    ) -> None:
        self.full_batches = 0
        self.failures = 0
        self._session = session
        self._subscribed = subscribed
        self._on_batch = on_batch
        self._capacity = capacity
        self._closed = False
        thread = threading.Thread(target=self._run, name="zstate receiver", daemon=True)
        self._thread = join_at_exit(thread)
        self._thread.start()

    def close(self) -> None:
        """Stop within a second; nothing is handed over afterwards. May be called from ``on_batch``."""
        self._closed = True
        self._session.release(self._subscribed)
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_WITHIN_S)

    def _run(self) -> None:
        handler = self._subscribed.handler
        while not self._closed:
            try:
                batch = [handler.recv()]
                while len(batch) < self._capacity and (sample := handler.try_recv()) is not None:
                    batch.append(sample)
            except zenoh.ZError:
                return  # undeclared, or the session was closed
            self._hand_over(batch)

    def _hand_over(self, batch: list[T]) -> None:
        if len(batch) >= self._capacity:
            self.full_batches += 1
        if self._closed:
            return
        try:
            self._on_batch(batch)
        except Exception:
            self.failures += 1
            if self.failures == 1:
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))


CAPACITY = 1024
"""So many samples of one key wait for a reader that is held up: a second at 1 kHz."""

WILDCARD_CAPACITY = 4096
"""And so many of an expression that hears many keys: 0.8 s of 100 robots at 50 Hz.

Not more, because a sample that waits holds the memory it was received in, 10 to 20 kB.
"""

_MOST_KEYS = 4096

_Statuses: TypeAlias = "zenoh.handlers.Handler[zenoh.MatchingStatus]"


def capacity_for(keyexpr: str) -> int:
    """How many samples of ``keyexpr`` wait for who reads them; of more the oldest are lost."""
    return WILDCARD_CAPACITY if "*" in keyexpr else CAPACITY


def to_serialized(sample: zenoh.Sample, key: str = "", max_bytes: int = LATCHED_BYTES) -> SerializedSample:
    """What came, as the wires read it; ``key`` is on which, where that is known.

    A payload of more than ``max_bytes`` is not copied: of such a one only the size is given.
    """
    payload, beside = sample.payload, sample.attachment
    key = key or str(sample.key_expr)
    if len(payload) > max_bytes or (beside is not None and len(beside) > ATTACHMENT_BYTES):
        return SerializedSample(key, b"\0", str(sample.encoding), None, max(len(payload), LATCHED_BYTES + 1))
    return SerializedSample(
        key, payload.to_bytes(), str(sample.encoding), None if beside is None else beside.to_bytes()
    )


def _arrivals(batch: Sequence[zenoh.Sample], key: str) -> list[SerializedSample]:
    arrivals = [to_serialized(sample, key, 4 * SAMPLE_BYTES) for sample in batch]
    if all(arrival.payload for arrival in arrivals):
        return arrivals
    # What is deleted has no payload either; to ask every sample which kind it is costs as much as its key.
    puts = zenoh.SampleKind.PUT
    return [arrival for arrival, sample in zip(arrivals, batch, strict=True) if sample.kind == puts]


class StreamPublisher(Closeable):
    """Publishes samples on one key. Under congestion samples are dropped; the writer is never delayed."""

    def __init__(self, session: Session, key: str, encoding: str) -> None:
        self._session = session
        self._key = key
        self._publisher = session.zenoh.declare_publisher(
            key,
            encoding=encoding or None,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=False,
        )
        self._has_readers = False
        self._changes: zenoh.MatchingListener[_Statuses] | None = None

    @property
    def has_readers(self) -> bool:
        """Whether this key has a subscriber now. Cheap enough to check before each sample."""
        if self._changes is None:
            # Zenoh reports each change, beginning with the first subscriber; only the newest is kept.
            ring: zenoh.handlers.RingChannel[zenoh.MatchingStatus] = zenoh.handlers.RingChannel(1)
            self._changes = self._publisher.declare_matching_listener(ring)
        change = self._changes.handler.try_recv()
        if change is not None:
            self._has_readers = change.matching
        return self._has_readers

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Send one sample with its attachment. Raises Closed."""
        self._session.check()
        try:
            self._publisher.put(payload, attachment=attachment)
        except zenoh.ZError:
            raise Closed(f"the publisher of {self._key!r} is closed") from None

    def close(self) -> None:
        """Undeclare the publisher. A second call does nothing."""
        if self._changes is not None:
            self._session.release(self._changes)
        self._session.release(self._publisher)


class StreamSubscriber(Closeable):
    """Hears a key expression; ``on_samples`` gets all that waits as a list, oldest first.

    It is called from one thread of this subscriber. See ``Receiver`` for what happens when it is
    slow or raises.
    """

    def __init__(
        self,
        session: Session,
        keyexpr: str,
        on_samples: Callable[[list[SerializedSample]], None],
        capacity: int | None = None,
    ) -> None:
        self._keys = keys = _DeclaredKeys(session, keyexpr)
        key = "" if "*" in keyexpr else keyexpr

        def hand_over(batch: list[zenoh.Sample]) -> None:
            arrivals = _arrivals(batch, key)
            if not key:
                keys.declare({arrival.key for arrival in arrivals})
            on_samples(arrivals)

        capacity = capacity or capacity_for(keyexpr)
        ring: Ring = zenoh.handlers.RingChannel(capacity)
        self._receiver = Receiver(
            session, session.zenoh.declare_subscriber(keyexpr, ring), hand_over, capacity
        )

    @property
    def full_batches(self) -> int:
        """How often the ring was found full: samples of ours, not of the network, were lost there."""
        return self._receiver.full_batches

    @property
    def failures(self) -> int:
        """How often ``on_samples`` raised."""
        return self._receiver.failures

    def close(self) -> None:
        """Stop within a second, also from inside ``on_samples``. A second call does nothing."""
        self._receiver.close()
        self._keys.close()


class _DeclaredKeys:
    """The keys on which samples of an expression come, which are declared to Zenoh.

    It keeps the way of samples on keys that it knows. On others it searches all that was declared under
    them for each sample anew: beside the tokens of 100 robots that is a quarter of what a reader's sample
    costs.
    """

    def __init__(self, session: Session, keyexpr: str) -> None:
        self._session = session
        self._known: dict[str, _Key] = {}
        self._most = _MOST_KEYS

    def declare(self, keys: set[str]) -> None:
        """Samples have come on ``keys``."""
        if len(self._known) < self._most:
            for key in keys.difference(self._known):
                with suppress(Closed, zenoh.ZError):  # closed meanwhile: then nothing more will come
                    self._known[key] = _Key(self._session, key)

    def close(self) -> None:
        """Declare them no more. A second call does nothing."""
        self._most = 0
        while self._known:
            self._session.release(self._known.popitem()[1])


class _Key:
    """A key that is declared to Zenoh."""

    def __init__(self, session: Session, key: str) -> None:
        self._session = session.zenoh
        self._expression: zenoh.KeyExpr = self._session.declare_keyexpr(key)

    def undeclare(self) -> None:
        self._session.undeclare(self._expression)
