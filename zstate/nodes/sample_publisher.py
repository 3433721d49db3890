"""What the publishers of samples have in common: counts, samples at a fixed rate, and the end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TypeVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.clock import SYSTEM, Clock, SystemClock
from zstate.errors import Closed
from zstate.net.clock_offset import ClockService
from zstate.net.sample_history import SampleCache
from zstate.net.session import Session
from zstate.net.writer import SampleWriter
from zstate.nodes.publisher_status import LimitWatch, PublisherStats, StreamStats
from zstate.rate import Rate, RateReport
from zstate.wire.identity import WriterId
from zstate.wire.keys import Stream, check_robot
from zstate.wire.registry import as_wire_names

T = TypeVar("T")

_NEWEST_ONLY_S = 1e-9
"""Span of a cache that has no room for a second sample."""


class SamplePublisher(Closeable):
    """Base of the publishers of one robot's samples, numbered from 0 on in the session ``session_id``."""

    def __init__(self, robot: str, wires: str | Sequence[str], clock: Clock | None, session_id: int) -> None:
        self.robot = check_robot(robot)
        self._wires = as_wire_names(wires)
        self._clock: Clock = clock or SystemClock()
        self._session_id = session_id
        self._writers: dict[tuple[str, Stream], SampleWriter] = {}
        self._limits: LimitWatch | None = None
        self._seq: int = 0
        self._refused = 0
        self._last_refusal = ""
        self._rate: Rate | None = None
        self._opened = ExitStack()
        self._lock = fork_safe_lock()
        self._stop = fork_safe(threading.Event())

    def _serve_clock(self, session: Session, writer: WriterId, opening: ExitStack) -> None:
        """Reply to readers that measure this clock, unless it is simulated.

        Called before ``writer`` is announced: readers that see its token measure its clock at once.
        """
        if self._clock.domain == SYSTEM:
            opening.enter_context(ClockService(session, self.robot, writer, self._clock))

    def _new_cache(self, cache_s: float, numbers: int) -> SampleCache:
        """For the samples of the last ``cache_s`` seconds; 0: for the newest one."""
        return SampleCache(cache_s or _NEWEST_ONLY_S, numbers, self._session_id)

    @property
    def stats(self) -> PublisherStats:
        """Counts of published, suppressed and refused samples."""
        streams = {
            place: StreamStats(*(sent := writer.sent), self._sent - sent[0])
            for place, writer in self._writers.items()
        }
        rate = None if self._rate is None else self._rate.report()
        outside, excess = (0, "") if self._limits is None else self._limits.counted()
        return PublisherStats(self._sent, self._refused, self._last_refusal, streams, rate, outside, excess)

    @property
    def _sent(self) -> int:
        """How many samples were published."""
        return self._seq

    def _count_refusal(self, error: Exception) -> None:
        self._last_refusal = str(error)
        self._refused += 1

    def _publish_at(
        self,
        rate_hz: float,
        seconds: float | None,
        read: Callable[[int], T | None],
        publish: Callable[[T, int], None],
    ) -> RateReport:
        """Publish what ``read`` returns at ``rate_hz``, for ``seconds`` or until ``close()``.

        Both get the present instant [ns]. Raises Closed if the session is closed, or not of this process.
        """
        self._rate = rate = Rate(rate_hz, self._clock, self._stop, seconds)
        for now in rate:
            sample = read(now)
            if sample is not None:
                try:
                    publish(sample, now)
                except Closed:
                    if not self._stop.is_set():
                        raise
                    break
        return rate.report()

    def close(self) -> None:
        """Stop publishing; ``run`` returns. A second call does nothing."""
        self._stop.set()
        with self._lock:
            self._opened.close()
