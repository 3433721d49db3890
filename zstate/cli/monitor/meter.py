"""PathMeter: when the samples of moving edges came, and what their numbers and stamps say."""

from __future__ import annotations

import threading
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from statistics import median, pstdev
from typing import TYPE_CHECKING, NamedTuple

from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.following.bounded import remember
from zstate.net.streams import StreamSubscriber
from zstate.net.wires import wire_named
from zstate.wire.keys import ANY, Stream, full_name
from zstate.wire.messages import JointState, Sample, TransformSample
from zstate.wire.wire import Arrival

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.clock import Clock
    from zstate.net.session import Session

# Five seconds of the fastest robots.
_KEPT = 10_000
_WINDOW_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class Measure:
    """What the last five seconds say of one edge's samples; times are in seconds.

    ``latency_s`` is the median time from stamp to arrival, by the clocks of both machines, and
    ``latency_max_s`` the longest; ``jitter_s`` is the standard deviation of the time between arrivals.
    ``missed`` counts the gaps in its writer's numbers since the start, ``silent_s`` goes since the last
    arrival. None where nothing tells it.
    """

    rate_hz: float | None
    latency_s: float | None
    latency_max_s: float | None
    jitter_s: float | None
    missed: int
    silent_s: float


class _Came(NamedTuple):
    at: int
    latency: int


class _Record:
    """The samples of one edge, or of one robot's joints."""

    def __init__(self) -> None:
        self.came: deque[_Came] = deque(maxlen=_KEPT)
        self.session = 0


class PathMeter(Closing):
    """Hears ``stream`` of ``robot`` ("*": of all) on ``wire``; ``clock`` is that of the stamps."""

    def __init__(self, session: Session, robot: str, wire: str, stream: Stream, clock: Clock) -> None:
        self._robot = robot
        self._wire = wire_named(wire)
        self._stream: Stream = stream
        self._clock = clock
        self._lock = threading.Lock()
        self._records: defaultdict[str, _Record] = defaultdict(_Record)
        self._seqs: dict[int, int] = {}
        self._missed: dict[int, int] = {}
        expression = self._wire.expression(robot, stream)
        self._subscriber = StreamSubscriber(session, expression, self._take)

    def close(self) -> None:
        """Hear no more. A second call does nothing."""
        self._subscriber.close()

    def measure(self, edge: FrameInfo) -> Measure | None:
        """What is known of the samples of ``edge``; None when none has come."""
        with self._lock:
            record = self._records.get(self.source(edge))
            if record is None:
                return None
            came, missed = list(record.came), self._missed.get(record.session, 0)
        now = time.monotonic_ns()
        silent_s = (now - came[-1].at) * 1e-9
        recent = [one for one in came if now - one.at < _WINDOW_NS]
        steps = [(later.at - earlier.at) * 1e-9 for earlier, later in pairwise(recent)]
        is_told = edge.domain in (None, self._clock.domain)
        latencies = [one.latency * 1e-9 for one in recent] if is_told else []
        return Measure(
            rate_hz=len(steps) / sum(steps) if sum(steps) else None,
            latency_s=median(latencies) if latencies else None,
            latency_max_s=max(latencies, default=None),
            jitter_s=pstdev(steps) if steps else None,
            missed=missed,
            silent_s=silent_s,
        )

    @staticmethod
    def source(edge: FrameInfo) -> str:
        """What edges have in common whose samples are the same: the joints of a robot come together."""
        return edge.name.partition("/")[0] + "/" if edge.kind == "joint" else edge.name

    def _take(self, arrivals: list[Arrival]) -> None:
        at, now = time.monotonic_ns(), self._clock.now()
        with self._lock:
            for arrival in arrivals:
                for robot, sample in self._samples(arrival):
                    self._note(robot, sample, at, now)

    def _samples(self, arrival: Arrival) -> Iterator[tuple[str, Sample]]:
        try:
            robot = self._wire.robot_of(arrival.key) if self._robot == ANY else self._robot
            messages = self._wire.decode(self._stream, arrival, robot)
        except (InvalidInput, MessageError):
            return  # the listener beside this one says so
        yield from ((robot, message) for message in messages if isinstance(message, Sample))

    def _note(self, robot: str, sample: Sample, at: int, now: int) -> None:
        before = self._seqs.get(sample.session)
        if before is None:
            before = sample.seq
            remember(self._missed, sample.session, 0)
        elif sample.seq > before + 1:
            self._missed[sample.session] = self._missed.get(sample.session, 0) + sample.seq - before - 1
        remember(self._seqs, sample.session, max(sample.seq, before))
        for source in _sources(robot, sample):
            record = self._records[source]
            record.session = sample.session
            record.came.append(_Came(at, now - sample.stamp))


def _sources(robot: str, sample: Sample) -> Iterator[str]:
    if isinstance(sample, JointState):
        yield f"{robot}/"
    elif isinstance(sample, TransformSample):
        with suppress(InvalidInput):  # refused by the listener
            yield from [full_name(robot, child) for _, child in sample.edges or ()]
