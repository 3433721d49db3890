"""Topic statistics (ROS 2's term): rates, jitter, gaps, delays and ages of what writers publish.

``IntervalStatistics`` and ``SequenceGaps`` are arithmetic on samples that have arrived; ``TopicStatistics``
subscribes to streams and keeps them for each writer. Times are nanoseconds where the name does not end in
``_s`` [s] or ``_hz`` [Hz]; arrivals are stamped by a monotonic clock.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from contextlib import ExitStack
from functools import cached_property
from itertools import pairwise
from statistics import median, pstdev
from typing import TYPE_CHECKING, NamedTuple

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate.clock import Clock, SystemClock
from zstate.ingest.deadline import Deadline
from zstate.net.status import PERIOD_S
from zstate.net.status_monitor import StatusSubscriber
from zstate.net.streams import StreamSubscriber
from zstate.net.subscription import decode_samples
from zstate.stream_registry import is_bulk
from zstate.streams import StreamName
from zstate.wire.keys import ANY
from zstate.wire.messages import StampedMessage, Status

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.wire.protocol import SerializedSample, Wire

WINDOW = 10_000
"""Ten seconds at 1 kHz."""
FLEET_WINDOW = 200
"""Enough for a rate, and few enough for a large fleet."""
_MEASURABLE_NS = 200_000_000
_PUBLISHED_NS = 2_000_000_000


def mean_rate_hz(count: int, span: int) -> float | None:
    """The rate of ``count`` samples, the last ``span`` [ns] after the first; None if unknown."""
    return (count - 1) * 1e9 / span if count > 1 and span > 0 else None


class Arrival(NamedTuple):
    """When a sample arrived, its stamp, its sequence number, and how long it took from stamp to arrival."""

    at: int
    stamp: int
    seq: int
    delay: int


class Window:
    """Statistics of successive samples of one source, at least one; None where they are too few."""

    def __init__(self, received: Sequence[Arrival]) -> None:
        self.received = received

    @property
    def rate_hz(self) -> float | None:
        """By arrivals."""
        return mean_rate_hz(len(self.received), self.received[-1].at - self.received[0].at)

    @property
    def stamp_rate_hz(self) -> float | None:
        """By stamps and sequence numbers: independent of losses, and of bursts on a busy machine."""
        first, last = self.received[0], self.received[-1]
        return mean_rate_hz(last.seq - first.seq + 1, last.stamp - first.stamp)

    @property
    def stamped_hz(self) -> float | None:
        """Of the samples that arrived, by their stamps: independent of bursts, but not of losses."""
        return mean_rate_hz(len(self.received), self.received[-1].stamp - self.received[0].stamp)

    @cached_property
    def intervals_s(self) -> list[float]:
        """Between arrivals."""
        return [(later.at - earlier.at) * 1e-9 for earlier, later in pairwise(self.received)]

    @property
    def jitter_s(self) -> float | None:
        """The standard deviation of the intervals."""
        return pstdev(self.intervals_s) if self.intervals_s else None

    @property
    def delay_s(self) -> float:
        """The median."""
        return median(one.delay for one in self.received) * 1e-9

    @cached_property
    def delays(self) -> tuple[int, int]:
        """The least and the greatest."""
        delays = [one.delay for one in self.received]
        return min(delays), max(delays)


class IntervalStatistics:
    """The newest ``window`` samples of one source. One thread adds, any thread reads."""

    def __init__(self, window: int = WINDOW) -> None:
        self.count = 0
        """How many samples have arrived; the window holds the newest of them."""
        self.session = 0
        """The writer of the newest sample."""
        self.deadline = Deadline()
        self._received: deque[Arrival] = deque(maxlen=window)

    def add(self, received: Arrival, session: int = 0) -> None:
        """Count a sample."""
        self.session = session
        self.deadline.on_sample(received.at * 1e-9)
        self._received.append(received)
        self.count += 1

    def clear(self) -> None:
        """Start a new window."""
        self._received.clear()

    @property
    def newest(self) -> Arrival | None:
        """The newest sample."""
        received = self._received
        return received[-1] if received else None

    def window(self, since: int | None = None) -> Window | None:
        """The samples that arrived after ``since``, or all that are kept; None if there are none."""
        received = self._received.copy()
        while received and since is not None and received[0].at <= since:
            received.popleft()
        return Window(received) if received else None

    def recent(self, within_ns: int, now: int | None = None) -> Window | None:
        """The samples that arrived within ``within_ns`` up to now."""
        return self.window((time.monotonic_ns() if now is None else now) - within_ns)

    def published_hz(self) -> float | None:
        """The rate at which the writer publishes, from the last two seconds."""
        window = self.recent(_PUBLISHED_NS)
        return None if window is None else window.stamp_rate_hz

    def silent_s(self, now: int | None = None) -> float:
        """How long ago the newest sample arrived; 0 without samples."""
        newest = self.newest
        return 0.0 if newest is None else ((time.monotonic_ns() if now is None else now) - newest.at) * 1e-9

    def is_stale(self, now: int | None = None) -> bool:
        """Whether the writer has missed its deadline."""
        return self.deadline.is_missed((time.monotonic_ns() if now is None else now) * 1e-9)


class SequenceGaps:
    """Counts the missing samples of each session by sequence numbers."""

    def __init__(self) -> None:
        self._sessions: BoundedDict[int, list[int]] = BoundedDict()
        """The largest sequence number, and how many are missing."""

    def add(self, session: int, seq: int) -> bool:
        """Count a sample. Returns whether it is the first of its message: ROS puts several into one."""
        counted = self._sessions.get(session)
        if counted is None:
            self._sessions[session] = [seq, 0]
        elif seq == counted[0]:
            return False
        else:
            counted[1] += max(0, seq - counted[0] - 1)
            counted[0] = max(counted[0], seq)
        return True

    def missed(self, session: int | None = None) -> int:
        """How many samples of a session, or of all of them, are missing."""
        sessions = self._sessions if session is None else self._sessions.keys() & {session}
        return sum(self._sessions[one][1] for one in tuple(sessions))


class WriterKey(NamedTuple):
    """One writer of one stream."""

    robot: str
    stream: StreamName
    session: int


class TopicStatistics(Closeable):
    """Statistics of subscribed streams by source; messages that cannot be decoded are skipped.

    ``sources(robot, stream, sample)`` are the keys under which a sample is counted, by default the
    ``WriterKey`` of its writer. ``clock`` is that of the stamps. ``on_sample(robot, stream, sample)`` is
    called for each sample, in the subscriber's thread.
    """

    def __init__(
        self,
        session: Session,
        wire: Wire,
        *,
        sources: Callable[[str, StreamName, StampedMessage], Iterable[Hashable]] | None = None,
        clock: Clock | None = None,
        window: int = WINDOW,
        on_sample: Callable[[str, StreamName, StampedMessage], None] | None = None,
    ) -> None:
        self.gaps = SequenceGaps()
        self._session, self._wire = session, wire
        self._sources = sources or (lambda name, stream, one: (WriterKey(name, stream, one.session),))
        self._clock = clock or SystemClock()
        self._on_sample, self._window = on_sample, window
        self._statistics: BoundedDict[Hashable, IntervalStatistics] = BoundedDict()
        self._arrived = threading.Condition()
        self._subscriptions = ExitStack()
        self._subscribers: list[StreamSubscriber] = []
        self._statuses: StatusSubscriber | None = None
        self._stated_hz: BoundedDict[tuple[str, int], float] = BoundedDict()

    def watch(self, streams: Iterable[StreamName]) -> None:
        """Count ``streams`` of all robots, but for bulk data, whose writers state their rates."""
        for stream in streams:
            if not is_bulk(stream):
                self.subscribe(stream)

    def _subscribe_statuses(self) -> None:
        """For the first writer of bulk data: so a fleet without any publishes no status for this."""
        if self._statuses is None:
            statuses = StatusSubscriber(self._session, ANY, self._on_status)
            self._statuses = self._subscriptions.enter_context(statuses)

    def _on_status(self, robot: str, status: Status) -> None:
        with self._arrived:
            self._stated_hz[robot, status.session] = status.rate_hz
            self._arrived.notify_all()

    def subscribe(self, stream: StreamName, robot: str = ANY) -> None:
        """Count ``stream`` of ``robot``, or of all robots, from now on."""

        def on_samples(samples: list[SerializedSample]) -> None:
            at, now = time.monotonic_ns(), self._clock.now()
            with self._arrived:
                for name, _, message in decode_samples(self._wire, robot, stream, samples):
                    if isinstance(message, StampedMessage):
                        self.add(name, stream, message, at, now)
                self._arrived.notify_all()

        key = self._wire.expression(robot, stream)
        subscriber = StreamSubscriber(self._session, key, on_samples, is_bulk=is_bulk(stream))
        self._subscribers.append(self._subscriptions.enter_context(subscriber))

    @property
    def has_overrun(self) -> bool:
        """Whether more samples have arrived than were taken in here: then rates are too low."""
        return any(subscriber.full_batches for subscriber in self._subscribers)

    def add(self, robot: str, stream: StreamName, sample: StampedMessage, at: int, now: int) -> None:
        """Count a sample that arrived ``at``, when it was ``now`` by the clock of the stamps."""
        self.gaps.add(sample.session, sample.seq)
        received = Arrival(at, sample.stamp, sample.seq, now - sample.stamp)
        for source in self._sources(robot, stream, sample):
            statistics = self._statistics.get(source)
            if statistics is None:
                statistics = self._statistics[source] = IntervalStatistics(self._window)
            newest = statistics.newest
            if newest is not None and (statistics.session, newest.seq) == (sample.session, sample.seq):
                continue  # a ROS message holds several samples, counted as one
            statistics.add(received, sample.session)
        if self._on_sample is not None:
            self._on_sample(robot, stream, sample)

    def published_hz(self, writer: WriterKey) -> float | None:
        """The rate at which a writer publishes, of bulk data as it states it; None if it is not known."""
        if is_bulk(writer.stream):
            self._subscribe_statuses()
            return self._stated_hz.get((writer.robot, writer.session))
        counted = self.get(writer)
        return None if counted is None else counted.published_hz()

    def get(self, source: Hashable) -> IntervalStatistics | None:
        """The statistics of one source; None if no sample has arrived."""
        return self._statistics.get(source)

    def wait(self, sources: Collection[WriterKey], timeout_s: float) -> None:
        """Wait until each source has 0.2 s of samples, enough for a rate, or for ``timeout_s``.

        Writers of bulk data state their rate within a second, which is waited for.
        """
        if any(is_bulk(source.stream) for source in sources):
            self._subscribe_statuses()
            timeout_s = max(timeout_s, PERIOD_S)

        def is_measurable(source: WriterKey) -> bool:
            if is_bulk(source.stream):
                return self.published_hz(source) is not None
            statistics = self.get(source)
            window = None if statistics is None else statistics.window()
            return window is not None and window.received[-1].at - window.received[0].at >= _MEASURABLE_NS

        with self._arrived:
            self._arrived.wait_for(lambda: all(map(is_measurable, sources)), timeout_s)

    def close(self) -> None:
        self._subscriptions.close()
