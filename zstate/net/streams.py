"""Sample streams (best effort, keep last): the newest sample replaces older ones, and writers never wait.

A ``Receiver`` is one daemon thread that drains a Zenoh channel in batches.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Generic, Protocol, TypeAlias, TypeVar

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import Closed
from zstate.net.at_exit import join_at_exit
from zstate.net.session import Session, Undeclarable
from zstate.wire.messages import ATTACHMENT_BYTES, LATCHED_BYTES, SAMPLE_BYTES
from zstate.wire.protocol import SerializedSample

CAPACITY = 1024
"""Samples of one key that wait for a delayed reader: a second at 1 kHz."""

WILDCARD_CAPACITY = 4096
"""The same for an expression that matches many keys: 0.8 s of 100 robots at 50 Hz.

Not more, because a waiting sample holds the memory it was received in, 10 to 20 kB.
"""

JOIN_WITHIN_S = 0.8
_MAX_KEYS = 4096

Ring: TypeAlias = "zenoh.handlers.RingChannel[zenoh.Sample]"

T = TypeVar("T")


class Subscribed(Undeclarable, Protocol[T]):
    """A Zenoh subscriber or queryable of any kind that delivers into a channel."""

    @property
    def handler(self) -> zenoh.Handler[T]: ...


def call_for_each(batch: Iterable[T], function: Callable[[T], object]) -> None:
    """Call ``function`` with each item of ``batch``; an exception of one is raised after the last item."""
    failure: Exception | None = None
    for item in batch:
        try:
            function(item)
        except Exception as error:  # noqa: PERF203 - the other items still get their call
            failure = error
    if failure is not None:
        raise failure


class Receiver(Generic[T]):
    """Calls ``on_batch`` with all waiting items, oldest first.

    The ring in between holds ``capacity`` items: if it is full the oldest are lost. A batch that fills it is
    counted in ``full_batches``, which distinguishes a gap before or in it from a loss in the network. An
    exception of ``on_batch`` is counted in ``failures``, and the first goes to ``threading.excepthook``; the
    thread continues.
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
        """Stop within a second; ``on_batch``, from which this may be called, is not called afterwards."""
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


_Statuses: TypeAlias = "zenoh.handlers.Handler[zenoh.MatchingStatus]"


def capacity_for(keyexpr: str) -> int:
    """The number of samples of ``keyexpr`` that wait for their reader; beyond it the oldest are lost."""
    return WILDCARD_CAPACITY if "*" in keyexpr else CAPACITY


def to_serialized(sample: zenoh.Sample, key: str = "", max_bytes: int = LATCHED_BYTES) -> SerializedSample:
    """``sample`` as wire formats decode it; ``key`` is its key if that is known.

    A payload of more than ``max_bytes`` is not copied: only its size is kept.
    """
    payload, attachment, encoding = sample.payload, sample.attachment, str(sample.encoding)
    key = key or str(sample.key_expr)
    if len(payload) > max_bytes or (attachment is not None and len(attachment) > ATTACHMENT_BYTES):
        return SerializedSample(key, b"\0", encoding, None, max(len(payload), LATCHED_BYTES + 1))
    attached = None if attachment is None else attachment.to_bytes()
    return SerializedSample(key, payload.to_bytes(), encoding, attached)


class StreamPublisher(Closeable):
    """Publisher of samples on one key. Under congestion samples are dropped; the writer is never delayed."""

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
    """Subscriber to a key expression; ``on_samples`` is called with all waiting samples, oldest first.

    It is called from one thread of this subscriber. ``Receiver`` describes slow and failing callbacks.
    """

    def __init__(
        self,
        session: Session,
        keyexpr: str,
        on_samples: Callable[[list[SerializedSample]], None],
        capacity: int | None = None,
    ) -> None:
        self._keys = keys = _DeclaredKeys(session)
        key = "" if "*" in keyexpr else keyexpr

        def on_batch(batch: list[zenoh.Sample]) -> None:
            samples = [to_serialized(sample, key, 4 * SAMPLE_BYTES) for sample in batch]
            if not all(sample.payload for sample in samples):
                # A delete has no payload; reading the kind of every sample would cost as much as its key.
                puts = zenoh.SampleKind.PUT
                samples = [one for one, sample in zip(samples, batch, strict=True) if sample.kind == puts]
            if not key:
                keys.declare({sample.key for sample in samples})
            on_samples(samples)

        capacity = capacity or capacity_for(keyexpr)
        ring: Ring = zenoh.handlers.RingChannel(capacity)
        subscriber = session.zenoh.declare_subscriber(keyexpr, ring)
        self._receiver = Receiver(session, subscriber, on_batch, capacity)

    @property
    def full_batches(self) -> int:
        """How often the ring was full: samples were lost in this process, not in the network."""
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
    """Keys of received samples, declared to Zenoh.

    Zenoh keeps the route of samples on declared keys. On others it searches all declarations under them for
    each sample: with the tokens of 100 robots that is a quarter of what a reader's sample costs.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._keys: dict[str, _Key] = {}
        self._max = _MAX_KEYS

    def declare(self, keys: set[str]) -> None:
        """Declare ``keys``, up to 4096 in all."""
        if len(self._keys) < self._max:
            for key in keys.difference(self._keys):
                with suppress(Closed, zenoh.ZError):  # closed at the same time: no more samples will arrive
                    self._keys[key] = _Key(self._session, key)

    def close(self) -> None:
        """Undeclare them. A second call does nothing."""
        self._max = 0
        while self._keys:
            self._session.release(self._keys.popitem()[1])


class _Key:
    """A key expression that is declared to Zenoh."""

    def __init__(self, session: Session, key: str) -> None:
        self._session = session.zenoh
        self._expression: zenoh.KeyExpr = self._session.declare_keyexpr(key)

    def undeclare(self) -> None:
        self._session.undeclare(self._expression)
