"""Sample streams (best effort, keep last): the newest sample replaces older ones, and writers never wait.

A subscriber is a ``Receiver``: a daemon thread of its own, or one that it shares with others, handles its
samples in batches. Streams of samples share none: a ring of Zenoh has one thread that waits for it, and a
callback of Python in its place delays all that arrives over the link. With odometry at 100 Hz and joint
states at 1 kHz that was a third more of CPU, and a p99 of the joint states of 4 ms instead of 1 ms.
"""

from __future__ import annotations

import sys
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, TypeAlias, TypeVar

import zenoh

from zstate._util.closeable import Closeable
from zstate.errors import Closed
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session, Undeclarable
from zstate.streams import BULK_BYTES, LATCHED_BYTES, SAMPLE_BYTES
from zstate.wire.messages import ATTACHMENT_BYTES
from zstate.wire.protocol import NO_ENVELOPE, Envelope, SerializedSample

CAPACITY = 1024
"""Samples of one key that wait for a delayed reader: a second at 1 kHz."""

WILDCARD_CAPACITY = 8192
"""The same for expressions that match many keys: 0.8 s of 1000 robots at 10 Hz, which are lost if they join
together and the thread that takes them out waits for longer.

Not more, because a waiting sample holds the memory it was received in, 10 to 20 kB.
"""

BULK_CAPACITY = 8
"""The same for streams of bulk data, whatever their keys: as large as they may be, 512 MB."""

_MAX_KEYS = 4096

_DECLARING_S = 0.005
"""The declarations after one batch delay the next one by this."""

Ring: TypeAlias = "zenoh.handlers.RingChannel[zenoh.Sample]"

T = TypeVar("T")

Declare: TypeAlias = Callable[[str, Any], Any]
"""Declares a subscriber to a key expression with a handler; what it returns depends on the handler's type."""


def call_for_each(batch: Iterable[T], function: Callable[[T], object]) -> None:
    """Call ``function`` with each item of ``batch``; an exception of one is raised after the last item."""
    failure: Exception | None = None
    for item in batch:
        try:
            function(item)
        except Exception as error:
            failure = error
    if failure is not None:
        raise failure


class Receiver(Closeable):
    """Calls ``_on_batch`` with all samples that have arrived at subscribers to ``keyexprs``, oldest first.

    Zenoh's own ring takes the samples of one key expression while other threads of Python run; it needs a
    thread that waits for it. One that ``is_dormant`` has its thread from the first sample on. Subscribers to
    several key expressions, and those with a ``thread`` that others use as well, call ``_put`` for each
    sample, and the thread has a turn. So does a receiver that ``_is_mixed``, which puts other samples among
    those that arrive.

    ``_is_handled`` is called first with the oldest sample of a ring, and the batch is without it if that
    returns True. There is no batch then unless the receiver ``_needs_batches``.

    At most ``capacity`` samples wait: if more arrive the oldest are lost. A batch of so many is counted in
    ``full_batches``, which distinguishes a gap before or in it from a loss in the network. An exception of
    ``_on_batch`` is counted in ``failures``, once for samples that arrived together, and the first goes to
    ``threading.excepthook``; the thread continues.
    """

    _is_mixed = False
    _needs_batches = True

    def __init__(
        self,
        session: Session,
        keyexprs: Sequence[str],
        declare: Declare,
        capacity: int,
        *,
        thread: ServiceThread | None = None,
        is_dormant: bool = False,
    ) -> None:
        self.full_batches = 0
        self.failures = 0
        self._session = session
        self._capacity = capacity
        self._closed = False
        self._waiting: deque[zenoh.Sample] = deque(maxlen=capacity)
        self._ring: zenoh.handlers.Handler[zenoh.Sample] | None = None
        self._has_turn = False
        self._subscribers: list[Undeclarable] = []
        self._is_shared = thread is not None
        self._thread = thread or ServiceThread(session, "receiver")
        try:
            if self._is_shared or self._is_mixed or len(keyexprs) > 1:
                self._subscribe(keyexprs, declare, self._put)
            else:
                subscriber = declare(keyexprs[0], zenoh.handlers.RingChannel(capacity))
                self._subscribers.append(subscriber)
                self._ring = subscriber.handler
                drain = partial(self._drain, subscriber.handler)
                if is_dormant:
                    self._subscribe(keyexprs, declare, lambda _: self._give_turn(drain))
                else:
                    self._give_turn(drain)
        except BaseException:
            Receiver.close(self)
            raise

    @abstractmethod
    def _on_batch(self, batch: list[zenoh.Sample]) -> None: ...

    def _is_handled(self, sample: zenoh.Sample) -> bool:
        return False

    def finish(self, timeout_s: float) -> None:
        """Unsubscribe, and wait at most ``timeout_s`` [s] until all that has arrived is delivered.

        For readers that must not lose it: ``close`` drops what waits. Not from inside a callback.
        """
        with suppress(zenoh.ZError):  # of a session that is closed
            while self._ring is not None and (sample := self._ring.try_recv()) is not None:
                self._waiting.append(sample)  # a ring is gone once its subscriber is
        for subscriber in self._subscribers:
            self._session.release(subscriber)
        self._thread.call(self._take_turn)
        delivered = threading.Event()
        self._thread.call(delivered.set)
        if self._session.is_usable:  # else the thread has ended
            delivered.wait(timeout_s)

    def close(self) -> None:
        """Stop within a second, also from inside a callback, which is not called afterwards.

        A call may still be running then if others use the thread, too.
        """
        self._closed = True
        for subscriber in self._subscribers:
            self._session.release(subscriber)
        if not self._is_shared:
            self._thread.close()

    def _subscribe(
        self, keyexprs: Sequence[str], declare: Declare, put: Callable[[zenoh.Sample], None]
    ) -> None:
        for keyexpr in keyexprs:
            # Called in a thread of Zenoh, which must not wait.
            callback = zenoh.handlers.Callback(put, self._thread.wake, indirect=False)
            self._subscribers.append(declare(keyexpr, callback))

    def _put(self, sample: zenoh.Sample) -> None:
        """Let ``sample`` wait for a turn of the thread; the oldest is lost if too many wait."""
        self._waiting.append(sample)
        self._give_turn(self._take_turn)

    def _give_turn(self, turn: Callable[[], None]) -> None:
        if not self._has_turn:
            self._has_turn = True
            self._thread.call(turn)

    def _take_turn(self) -> None:
        self._has_turn = False  # before the look: a sample that arrives after it has another turn
        batch = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if batch:
            self._deliver(batch)

    def _drain(self, ring: zenoh.handlers.Handler[zenoh.Sample]) -> None:
        """Deliver the samples of ``ring`` until it ends: undeclared, or with the session."""
        for noted_first in self._subscribers[1:]:
            self._session.release(noted_first)
        with suppress(zenoh.ZError):
            while not self._closed:
                first = ring.recv()
                is_handled = not self._closed and self._is_handled(first)
                if is_handled and not self._needs_batches:
                    continue
                batch = [] if is_handled else [first]
                while len(batch) < self._capacity and (sample := ring.try_recv()) is not None:
                    batch.append(sample)
                if batch:
                    self._deliver(batch)

    def _deliver(self, batch: list[zenoh.Sample]) -> None:
        if len(batch) >= self._capacity:
            self.full_batches += 1
        if self._closed:
            return
        try:
            self._on_batch(batch)
        except Exception:
            self._count_failure()

    def _count_failure(self) -> None:
        """Count the exception that is handled now; report the first."""
        self.failures += 1
        if self.failures == 1:
            threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), threading.current_thread())))


def capacity_for(keyexprs: Sequence[str], *, is_bulk: bool = False) -> int:
    """The number of samples of ``keyexprs`` that wait for their reader; beyond it the oldest are lost."""
    if is_bulk:
        return BULK_CAPACITY
    return WILDCARD_CAPACITY if len(keyexprs) > 1 or "*" in keyexprs[0] else CAPACITY


def to_serialized(sample: zenoh.Sample, key: str = "", max_bytes: int = LATCHED_BYTES) -> SerializedSample:
    """``sample`` as wire formats decode it; ``key`` is its key if that is known.

    A payload of more than ``max_bytes`` is not copied: only its size is kept.
    """
    payload, attachment, encoding = sample.payload, sample.attachment, str(sample.encoding)
    key = key or str(sample.key_expr)
    if len(payload) > max_bytes or (attachment is not None and len(attachment) > ATTACHMENT_BYTES):
        size = max(len(payload), LATCHED_BYTES + 1, max_bytes + 1)  # more than any stream here may have
        return SerializedSample(key, b"\0", encoding, None, size)
    attached = None if attachment is None else attachment.to_bytes()
    return SerializedSample(key, payload.to_bytes(), encoding, attached)


class KeyPublisher(Closeable):
    """Publisher of samples on one key. Under congestion samples are dropped; the writer is never delayed.

    Those of a publisher that ``is_bulk`` wait in the queues of Zenoh until all others are sent.
    """

    def __init__(self, session: Session, key: str, encoding: str, *, is_bulk: bool = False) -> None:
        self._session = session
        self._key = key
        self._publisher = session.zenoh.declare_publisher(
            key,
            encoding=encoding or None,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW if is_bulk else zenoh.Priority.INTERACTIVE_HIGH,
            express=False,
        )
        self.zenoh_put: Callable[..., object] = self._publisher.put  # pyright: ignore  # its result has no type
        self._has_readers = False
        self.on_readers: Callable[[], None] | None = None
        """Called in a thread of Zenoh after each change of ``has_readers``."""
        self._changes: zenoh.MatchingListener[None] | None = None

    @property
    def has_readers(self) -> bool:
        """Whether this key has a subscriber now. Cheap enough to check before each sample."""
        if self._changes is None:
            # Zenoh reports each change, beginning with the first subscriber, in a thread of its own.
            handler = zenoh.handlers.Callback(self._on_change, indirect=False)
            self._changes = self._publisher.declare_matching_listener(handler)
        return self._has_readers

    def _on_change(self, status: zenoh.MatchingStatus) -> None:
        self._has_readers = status.matching
        if self.on_readers is not None:
            self.on_readers()

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Send one sample with its attachment. Raises Closed."""
        if not self._session.is_usable:
            self._session.check()
        try:
            self._publisher.put(payload, attachment=attachment)
        except zenoh.ZError:
            raise Closed(f"the publisher of {self._key!r} is closed") from None

    def close(self) -> None:
        if self._changes is not None:
            self._session.release(self._changes)
        self._session.release(self._publisher)


class StreamSubscriber(Receiver):
    """Subscriber to key expressions; ``on_samples`` is called with all waiting samples, oldest first.

    It is called from one thread of this subscriber, for all of its expressions, which starts with the first
    sample if it ``is_dormant``. ``Receiver`` describes slow and failing callbacks.

    ``insert_next(key, message)`` is called before it with each sample by itself, and returns True if it
    handled the sample: then ``on_samples`` does not get it. ``message`` is the payload with the attachment
    behind it, None in another envelope than ``envelope``. Samples of a full batch go to ``on_samples`` only.

    A subscriber that ``is_bulk`` receives samples of up to 64 MB, others of up to 1 MB, and fewer wait.

    The keys of received samples, up to 4096, are declared to Zenoh, which keeps the route of samples on
    declared keys. On others it searches all declarations under them for each sample: with the tokens of 100
    robots that is a quarter of what a reader's sample costs. A declaration takes up to 5 ms while the tokens
    of 1000 robots arrive, so the keys of one batch are declared over several.
    """

    def __init__(
        self,
        session: Session,
        keyexprs: str | Sequence[str],
        on_samples: Callable[[list[SerializedSample]], None],
        capacity: int | None = None,
        *,
        insert_next: Callable[[str, bytes | None], bool] | None = None,
        envelope: Envelope = NO_ENVELOPE,
        is_dormant: bool = False,
        is_bulk: bool = False,
    ) -> None:
        keyexprs = (keyexprs,) if isinstance(keyexprs, str) else keyexprs
        self._key = "" if len(keyexprs) > 1 or "*" in keyexprs[0] else keyexprs[0]
        self._declared: dict[str, _DeclaredKey | None] = {}
        """By key; None for one that waits for its declaration."""
        self._undeclared: deque[str] = deque()
        self._on_samples = on_samples
        self._insert_next = insert_next
        # A sample after a gap is not handled at once. What a full ring has lost leaves a gap before the next
        # sample of a single key of the native wire; elsewhere, the next sample may be of another writer.
        self._needs_batches = not self._key or envelope.attachment_bytes > 0
        self._encoding = zenoh.Encoding(envelope.encoding)
        self._attachment_bytes = envelope.attachment_bytes
        self._max_bytes = BULK_BYTES if is_bulk else 4 * SAMPLE_BYTES
        capacity = capacity or capacity_for(keyexprs, is_bulk=is_bulk)
        declare = session.zenoh.declare_subscriber
        super().__init__(session, keyexprs, declare, capacity, is_dormant=is_dormant)

    def _is_handled(self, sample: zenoh.Sample) -> bool:
        if self._insert_next is None:
            return False
        payload, attachment = sample.payload, sample.attachment
        is_usual = (
            len(payload) <= SAMPLE_BYTES
            and (0 if attachment is None else len(attachment)) == self._attachment_bytes
            and sample.encoding == self._encoding
        )
        try:
            key = self._key or str(sample.key_expr)
            message = payload.to_bytes() if is_usual else None
            if message is not None and attachment is not None:
                message += attachment.to_bytes()
            return self._insert_next(key, message)
        except Exception:
            self._count_failure()
            return True

    def _on_batch(self, batch: list[zenoh.Sample]) -> None:
        if self._insert_next is not None and len(batch) < self._capacity:
            batch = [sample for sample in batch if not self._is_handled(sample)]
        samples = [to_serialized(sample, self._key, self._max_bytes) for sample in batch]
        if not all(sample.payload for sample in samples):
            # A delete has no payload; reading the kind of every sample would cost as much as its key.
            puts = zenoh.SampleKind.PUT
            samples = [one for one, sample in zip(samples, batch, strict=True) if sample.kind == puts]
        try:
            if samples:
                self._on_samples(samples)
        finally:
            if not self._key:
                self._declare_keys(samples)

    # zenoh 1.10, samples on keys that are not declared have no cached route: delete when fixed
    def _declare_keys(self, samples: Iterable[SerializedSample]) -> None:
        """Declare the keys of ``samples`` and of earlier ones, as many as there is time for."""
        if len(self._declared) < _MAX_KEYS:
            new = {sample.key for sample in samples}.difference(self._declared)
            self._declared.update(dict.fromkeys(new))
            self._undeclared.extend(new)
        deadline = time.monotonic() + _DECLARING_S
        with suppress(Closed, zenoh.ZError):  # closed at the same time: no more samples will arrive
            while self._undeclared and time.monotonic() < deadline:
                key = self._undeclared.popleft()
                self._declared[key] = _DeclaredKey(self._session.zenoh, key)

    def close(self) -> None:
        super().close()
        while self._declared:
            declared = self._declared.popitem()[1]
            if declared is not None:
                self._session.release(declared)


class _DeclaredKey:
    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._session = session
        self._expression: zenoh.KeyExpr = session.declare_keyexpr(key)

    def undeclare(self) -> None:
        self._session.undeclare(self._expression)
