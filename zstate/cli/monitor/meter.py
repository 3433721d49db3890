"""Statistics of moving edges, or of the joints of each robot, whose samples arrive together."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from zstate.closing import Closing
from zstate.errors import InvalidInput
from zstate.net.topic_statistics import TopicStatistics
from zstate.net.wires import wire_named
from zstate.wire.keys import Stream, full_name
from zstate.wire.messages import JointState, Sample, TransformSample

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.clock import Clock
    from zstate.net.session import Session

_WINDOW_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class EdgeMeasure:
    """Statistics of one edge's samples in the last five seconds; None where they are not known.

    ``latency_s`` is the median time from stamp to arrival, by the clocks of both machines, and
    ``latency_max_s`` the longest; ``jitter_s`` is the standard deviation of the time between arrivals.
    ``missed`` counts the gaps in its writer's numbers since the start, ``silent_s`` goes since the last
    arrival, and ``is_stale`` is whether its writer has missed its deadline.
    """

    rate_hz: float | None
    latency_s: float | None
    latency_max_s: float | None
    jitter_s: float | None
    missed: int
    silent_s: float
    is_stale: bool = False

    def facts(self) -> dict[str, Any]:
        """As JSON has it."""
        return {name: value for name, value in asdict(self).items() if name != "is_stale"}


class EdgeStatistics(Closing):
    """Subscribes to ``stream`` of ``robot`` ("*": of all) on ``wire``; ``clock`` is that of the stamps."""

    def __init__(self, session: Session, robot: str, wire: str, stream: Stream, clock: Clock) -> None:
        self._clock = clock
        self.topic = TopicStatistics(session, wire_named(wire), sources=_sources, clock=clock)
        self.topic.subscribe(stream, robot)

    def close(self) -> None:
        """Unsubscribe. A second call does nothing."""
        self.topic.close()

    def measure(self, edge: FrameInfo) -> EdgeMeasure | None:
        """The statistics of ``edge``; None if no sample has arrived."""
        statistics, now = self.topic.get(self.source(edge)), time.monotonic_ns()
        if statistics is None:
            return None
        window = statistics.recent(_WINDOW_NS, now)
        is_comparable = window is not None and edge.domain in (None, self._clock.domain)
        return EdgeMeasure(
            rate_hz=None if window is None else window.rate_hz,
            latency_s=window.delay_s if window is not None and is_comparable else None,
            latency_max_s=window.delays[1] * 1e-9 if window is not None and is_comparable else None,
            jitter_s=None if window is None else window.jitter_s,
            missed=self.topic.gaps.missed(statistics.session),
            silent_s=statistics.silent_s(now),
            is_stale=statistics.is_stale(now),
        )

    @staticmethod
    def source(edge: FrameInfo) -> str:
        """What edges with the same samples have in common: the joints of a robot arrive together."""
        return edge.name.partition("/")[0] + "/" if edge.kind == "joint" else edge.name


def _sources(robot: str, stream: Stream, sample: Sample) -> Iterator[str]:
    if isinstance(sample, JointState):
        yield f"{robot}/"
    elif isinstance(sample, TransformSample):
        with suppress(InvalidInput):  # refused by the listener
            yield from [full_name(robot, child) for _, child in sample.edges or ()]
