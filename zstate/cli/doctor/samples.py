"""Statistics and contents of the samples that arrive on one stream of one robot."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate.model.robot import RobotModel, coordinate_names
from zstate.net.session import Session
from zstate.net.topic_statistics import IntervalStatistics, TopicStatistics, Window
from zstate.wire.keys import Stream
from zstate.wire.messages import JointState, Sample, TransformSample, from_block, order_digest
from zstate.wire.protocol import Wire

_ALL = ""


class Ranges:
    """The least and greatest positions of the samples of one writer."""

    def __init__(self) -> None:
        self._kind: object = None
        self._names: tuple[str, ...] | None = None
        self._order = b""
        self._extremes = np.empty((2, 0))

    def add(self, state: JointState) -> None:
        """Include the positions of ``state``; those of another writer or joint order replace all before."""
        positions = from_block(state.positions)
        kind = (state.session, state.order, positions.size)
        if kind != self._kind:
            self._kind, self._names, self._order = kind, state.names, state.order
            self._extremes = np.stack((positions, positions))
        np.fmin(self._extremes[0], positions, out=self._extremes[0])
        np.fmax(self._extremes[1], positions, out=self._extremes[1])

    def positions(self, model: RobotModel) -> NDArray[np.float64]:
        """Two position vectors of ``model``, the least and the greatest; NaN for what the samples lack."""
        wanted = coordinate_names(model)
        names = self._names
        if names is None:
            names = wanted if self._order == order_digest(model.joint_names) else ()
        places = {name: column for column, name in enumerate(names)}
        found = np.full((2, len(wanted)), np.nan)
        for column, name in enumerate(wanted):
            if name in places:
                found[:, column] = self._extremes[:, places[name]]
        return found


@dataclass
class WriterSamples:
    """Statistics of one writer, its joints or child frames, and the ranges of its joint positions."""

    statistics: IntervalStatistics
    names: dict[str, None] = field(default_factory=dict[str, None])
    ranges: Ranges = field(default_factory=Ranges)

    @property
    def rate_hz(self) -> float | None:
        """By arrivals; None for fewer than two samples."""
        window = self.statistics.window()
        return None if window is None else window.rate_hz


class StreamSamples(Closeable):
    """Subscribes to ``stream`` of ``robot``. ROS nodes share a stream; else the newest writer counts."""

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: Stream,
        wire: Wire,
        on_change: Callable[[], object] = lambda: None,
    ) -> None:
        self._writers: dict[int, WriterSamples] = {}
        self._on_change = on_change
        self.topic = TopicStatistics(session, wire, sources=_sources, on_sample=self._on_sample)
        self.topic.subscribe(stream, robot)

    def close(self) -> None:
        self.topic.close()

    def _on_sample(self, stream: Stream, sample: Sample) -> None:
        writer = self._writers.get(sample.session)
        if writer is None:
            statistics = self.topic.get(sample.session)
            assert statistics is not None
            writer = self._writers[sample.session] = WriterSamples(statistics)
        if isinstance(sample, JointState):
            writer.names.update(dict.fromkeys(sample.names or ()))
            writer.ranges.add(sample)
        elif isinstance(sample, TransformSample):
            writer.names.update(dict.fromkeys(child for _, child in sample.edges or ()))
        self._on_change()

    @property
    def statistics(self) -> IntervalStatistics:
        """Of all writers together."""
        return self.topic.get(_ALL) or IntervalStatistics()

    @property
    def window(self) -> Window | None:
        """The samples of all writers together; None if none has arrived."""
        return self.statistics.window()

    @property
    def writers(self) -> dict[int, WriterSamples]:
        """By session, each writer whose samples have arrived."""
        return self._writers.copy()


def _sources(robot: str, stream: Stream, sample: Sample) -> Iterator[str | int]:
    yield from (_ALL, sample.session)
