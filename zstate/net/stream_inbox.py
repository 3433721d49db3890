"""Samples that wait until their reader asks for them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import zenoh

from zstate._util.closeable import Closeable
from zstate.net.session import Session
from zstate.net.streams import to_serialized
from zstate.streams import SAMPLE_BYTES
from zstate.wire.protocol import SerializedSample


class StreamInbox(Closeable):
    """The newest ``capacity`` samples on ``key``, which wait until ``drain`` is called, such as at each tick.

    No thread of Python is in between: one that waits for a sample takes 50 us and more to wake, and competes
    with the loop for the interpreter lock. ``on_overrun()`` is called, in a thread of Zenoh, for each sample
    that is lost because too many have arrived.
    """

    def __init__(self, session: Session, key: str, capacity: int, on_overrun: Callable[[], object]) -> None:
        self._session = session
        self._key = key
        self._on_overrun = on_overrun
        self._waiting: deque[tuple[int, zenoh.Sample]] = deque(maxlen=capacity)
        callback = zenoh.handlers.Callback(self._add, indirect=False)
        self._subscriber = session.zenoh.declare_subscriber(key, callback)

    def drain(self) -> list[tuple[int, SerializedSample]]:
        """The samples since the last call, oldest first, each with its arrival on the monotonic clock [ns].

        One of more than four times ``SAMPLE_BYTES`` has no payload, only its size.
        """
        drained: list[tuple[int, SerializedSample]] = []
        for _ in range(len(self._waiting)):
            arrived, sample = self._waiting.popleft()
            serialized = to_serialized(sample, self._key, 4 * SAMPLE_BYTES)
            if serialized.payload or sample.kind == zenoh.SampleKind.PUT:  # a delete has no payload
                drained.append((arrived, serialized))
        return drained

    def close(self) -> None:
        """Receive no more samples. A second call does nothing."""
        self._session.release(self._subscriber)

    def _add(self, sample: zenoh.Sample) -> None:
        if len(self._waiting) == self._waiting.maxlen:
            self._on_overrun()
        self._waiting.append((time.monotonic_ns(), sample))
