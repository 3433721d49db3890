"""ListenerMetrics: what comes in, how late, and what is lost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Protocol

from zstate.buffer.buffer import TransformBuffer
from zstate.ingest.counters import ListenerStats
from zstate.metrics.families import MOST_ROBOTS, Families
from zstate.metrics.library import Collector, Metric
from zstate.metrics.measured_buffer import MeasuredBuffer
from zstate.metrics.pace import Paces
from zstate.wire.keys import ANY


class Listened(Protocol):
    """A TransformListener, or the part of one that follows all robots which concerns one of them."""

    @property
    def robot(self) -> str: ...
    @property
    def stats(self) -> ListenerStats: ...
    @property
    def buffer(self) -> TransformBuffer: ...


class ListenerMetrics(Collector):
    """Reads the listeners that ``listeners()`` names when it is asked.

    Counts are those of each listener: of one that follows all robots, all together, as robot "*".
    Latency and lookups are known of a listener whose buffer is a MeasuredBuffer.
    """

    def __init__(self, listeners: Callable[[], Sequence[Listened]]) -> None:
        self._listeners = listeners
        self._paces = Paces()
        self.look()

    def look(self) -> None:
        """Note how far the counts have come, from which rates are made; the endpoint does, each second."""
        for listener in self._listeners():
            self._paces.note(id(listener), listener.stats.received)

    def collect(self) -> Iterable[Metric]:
        families = Families()
        listeners = sorted(self._listeners(), key=lambda listener: listener.robot)
        for listener in listeners[:MOST_ROBOTS]:
            self._add_counts(families, listener)
            _add_ages(families, listener)
            if isinstance(listener.buffer, MeasuredBuffer):
                _add_lookups(families, listener.robot, listener.buffer)
        left_out = max(0, len(listeners) - MOST_ROBOTS)
        families.gauge("zstate_listener_robots_left_out", "Robots without rows of their own.", left_out)
        yield from families

    def _add_counts(self, families: Families, listener: Listened) -> None:
        robot, counts = listener.robot, asdict(listener.stats)
        for reason, count in counts.pop("refused").items():
            text = "Messages that could not be used."
            families.count("zstate_listener_refused", text, count, robot=robot, reason=reason)
        for what, count in counts.items():
            text = f"Samples {what.replace('_', ' ')}, as TransformListener.stats counts them."
            families.count(f"zstate_listener_{what}", text, count, robot=robot)
        rate_hz = self._paces.rate_hz(id(listener), counts["received"])
        families.gauge("zstate_listener_rate_hertz", "Samples received a second.", rate_hz, robot=robot)


def _add_ages(families: Families, listener: Listened) -> None:
    text = "How old the newest sample of a robot is, by the clocks of both machines."
    buffer = listener.buffer
    for robot, stamp in sorted(_newest_stamps(listener).items())[:MOST_ROBOTS]:
        age_s = (buffer.clock.now() - stamp) * 1e-9
        families.gauge("zstate_listener_age_seconds", text, age_s, robot=robot)


def _newest_stamps(listener: Listened) -> dict[str, int]:
    newest: dict[str, int] = {}
    for frame in listener.buffer.frames():
        robot = frame.name.partition("/")[0]
        stamp = frame.newest_in(listener.buffer.clock.domain)
        if stamp is not None and listener.robot in (ANY, robot):
            newest[robot] = max(newest.get(robot, stamp), stamp)
    return newest


def _add_lookups(families: Families, robot: str, buffer: MeasuredBuffer) -> None:
    text = "From a sample's stamp until it could be looked up."
    families.histogram("zstate_listener_latency_seconds", text, buffer.latency_of(robot), robot=robot)
    families.count("zstate_listener_lookups", "Lookups in the buffer.", buffer.lookups, robot=robot)
    for kind, count in buffer.failures.items():
        text = "Lookups without an answer, by the kind of the error."
        families.count("zstate_listener_lookup_errors", text, count, robot=robot, kind=kind)
