"""Metrics for Prometheus: their rows, and those of publishers, listeners, writers and connections.

Functions add rows from existing counters at a scrape. Rates are for PromQL to compute, by ``rate(...[10s])``.
Plugins have functions of their own, in the module ``metrics`` of their ``cli``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Protocol

from zstate.buffer.buffer import TransformBuffer
from zstate.ingest.counters import ListenerStats
from zstate.net.discovery import connections
from zstate.nodes.metered_buffer import Histogram, InstrumentedBuffer
from zstate.wire.keys import ANY

if TYPE_CHECKING:
    from prometheus_client.core import Metric

    from zstate.net.discovery import RobotInfo
    from zstate.net.session import Session
    from zstate.nodes.sample_publisher import SamplePublisher

MAX_ROBOTS = 500
"""Robots with their own rows. Names come from the network, so further robots are only counted."""


class MetricFamilies:
    """Metric rows grouped by name. Rows with the same name and labels are added.

    Of robots ``max_robots`` have rows of their own: their names come from the network.
    """

    max_robots = MAX_ROBOTS

    def __init__(self) -> None:
        self._rows: dict[tuple[str, str, str], dict[tuple[tuple[str, str], ...], float]] = {}
        self._histograms: dict[tuple[str, str], dict[tuple[tuple[str, str], ...], Histogram]] = {}

    def count(self, name: str, text: str, value: float, **labels: str) -> None:
        """A counter; ``_total`` is appended to its name."""
        self._add("counter", name, text, value, labels)

    def gauge(self, name: str, text: str, value: float, **labels: str) -> None:
        """A value that rises and falls."""
        self._add("gauge", name, text, value, labels)

    def histogram(self, name: str, text: str, histogram: Histogram, **labels: str) -> None:
        """A distribution of values."""
        self._histograms.setdefault((name, text), {})[tuple(labels.items())] = histogram

    def _add(self, kind: str, name: str, text: str, value: float, labels: dict[str, str]) -> None:
        rows = self._rows.setdefault((kind, name, text), {})
        row = tuple(labels.items())
        rows[row] = rows.get(row, 0.0) + value

    def __iter__(self) -> Iterator[Metric]:
        from prometheus_client.core import (  # noqa: PLC0415
            CounterMetricFamily,
            GaugeMetricFamily,
            HistogramMetricFamily,
        )

        for (kind, name, text), rows in self._rows.items():
            named = [label for label, _ in next(iter(rows))]
            family_type = CounterMetricFamily if kind == "counter" else GaugeMetricFamily
            family = family_type(name, text, labels=named)
            for row, value in rows.items():
                family.add_metric([label for _, label in row], value)
            yield family
        for (name, text), histograms in self._histograms.items():
            family = HistogramMetricFamily(name, text, labels=[label for label, _ in next(iter(histograms))])
            for row, histogram in histograms.items():
                buckets, total = histogram.read()
                family.add_metric([label for _, label in row], buckets, total)
            yield family


class Collector:
    """A collector of prometheus-client: the rows that ``add`` adds at each scrape."""

    def __init__(self, add: Callable[[MetricFamilies], None]) -> None:
        self._add = add

    def collect(self) -> Iterable[Metric]:
        families = MetricFamilies()
        self._add(families)
        return families


def add_publishers(families: MetricFamilies, publishers: Sequence[SamplePublisher]) -> None:
    """Rows of publishers."""
    count, gauge = families.count, families.gauge
    for publisher in publishers:
        robot, stats = publisher.robot, publisher.stats
        if not stats.streams:
            continue
        for (wire, stream), counts in stats.streams.items():
            labels = {"robot": robot, "wire": wire, "stream": stream}
            count("zstate_publisher_samples", "Samples published.", counts.samples, **labels)
            count("zstate_publisher_bytes", "Their payloads [bytes].", counts.bytes, **labels)
            text = "Samples not published because the stream has no reader."
            count("zstate_publisher_suppressed", text, counts.suppressed, **labels)
        text = "Samples that could not be published."
        count("zstate_publisher_refused", text, stats.refused, robot=robot)
        if (rate := stats.rate) is not None:
            text = "The commanded rate."
            gauge("zstate_publisher_commanded_hertz", text, rate.commanded_hz, robot=robot)
            count("zstate_publisher_ticks", "Ticks of that rate.", rate.ticks, robot=robot)
            count("zstate_publisher_late_ticks", "Ticks over a period late.", rate.late, robot=robot)
            text = "Ticks skipped after a long delay."
            count("zstate_publisher_skipped_ticks", text, rate.skipped, robot=robot)


class Listened(Protocol):
    """A TransformListener, or the part of one for a single robot."""

    @property
    def robot(self) -> str: ...
    @property
    def stats(self) -> ListenerStats: ...
    @property
    def buffer(self) -> TransformBuffer: ...


def add_listeners(families: MetricFamilies, listeners: Sequence[Listened]) -> None:
    """Rows of listeners.

    Counts are those of each listener: for one of all robots they are totals with the robot "*". Latency and
    lookups need an InstrumentedBuffer.
    """
    listeners = sorted(listeners, key=lambda listener: listener.robot)
    for listener in listeners[:MAX_ROBOTS]:
        robot, counts, buffer = listener.robot, asdict(listener.stats), listener.buffer
        text = "Messages that could not be used."
        for reason, count in counts.pop("refused").items():
            families.count("zstate_listener_refused", text, count, robot=robot, reason=reason)
        for name, count in counts.items():
            text = f"Samples {name.replace('_', ' ')}, as TransformListener.stats counts them."
            families.count(f"zstate_listener_{name}", text, count, robot=robot)
        _add_ages(families, listener)
        if isinstance(buffer, InstrumentedBuffer):
            text = "Time from a sample's stamp until it could be looked up."
            latency = buffer.latency_of(robot)
            families.histogram("zstate_listener_latency_seconds", text, latency, robot=robot)
            text = "Lookups in the buffer."
            families.count("zstate_listener_lookups", text, buffer.lookups, robot=robot)
            for kind, count in buffer.failures.items():
                text = "Failed lookups by the kind of the error."
                families.count("zstate_listener_lookup_errors", text, count, robot=robot, kind=kind)
    left_out = max(0, len(listeners) - MAX_ROBOTS)
    families.gauge("zstate_listener_robots_left_out", "Robots without their own rows.", left_out)


def _add_ages(families: MetricFamilies, listener: Listened) -> None:
    buffer, newest = listener.buffer, dict[str, int]()
    for frame in buffer.frames():
        robot = frame.name.partition("/")[0]
        stamp = frame.newest_in(buffer.clock.domain)
        if stamp is not None and listener.robot in (ANY, robot):
            newest[robot] = max(newest.get(robot, stamp), stamp)
    text = "The age of a robot's newest sample, by the clocks of both machines."
    for robot, stamp in sorted(newest.items())[:MAX_ROBOTS]:
        age_s = (buffer.clock.now() - stamp) * 1e-9
        families.gauge("zstate_listener_age_seconds", text, age_s, robot=robot)


def add_writers(families: MetricFamilies, robots: Sequence[RobotInfo]) -> None:
    """The number of writers of each stream of ``robots``."""
    families.gauge("zstate_robots", "Robots with a writer.", len(robots))
    for robot in robots[:MAX_ROBOTS]:
        for stream, _ in robot.writers:
            families.gauge("zstate_writers", "Live writers.", 1, robot=robot.name, stream=stream)


def add_connections(families: MetricFamilies, session: Session) -> None:
    """The number of connections of a session: for a router its clients, peers and other routers."""
    current = connections(session)
    for mode, count in current.sessions.items():
        families.gauge("zstate_router_sessions", "Connected sessions.", count, mode=mode)
    for protocol, count in current.links.items():
        families.gauge("zstate_router_links", "Links to them.", count, protocol=protocol)
