"""PublisherMetrics: what publishers say, and how punctually."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence

from zstate.metrics.families import Families
from zstate.metrics.library import Collector, Metric
from zstate.metrics.pace import Paces
from zstate.nodes.publisher import StatePublisher


class PublisherMetrics(Collector):
    """Reads ``publishers`` when it is asked."""

    def __init__(self, publishers: Sequence[StatePublisher]) -> None:
        self._publishers = publishers
        self._paces = Paces()
        self.look()

    def look(self) -> None:
        """Note how far the counts have come, from which rates are made; the endpoint does, each second."""
        for publisher in self._publishers:
            for (wire, stream), said in publisher.stats.streams.items():
                self._paces.note((id(publisher), wire, stream), said.samples)

    def collect(self) -> Iterable[Metric]:
        families = Families()
        for publisher in self._publishers:
            if publisher.stats.streams:
                self._add(families, publisher)
        yield from families

    def _add(self, families: Families, publisher: StatePublisher) -> None:
        robot, stats = publisher.robot, publisher.stats
        count, gauge = families.count, families.gauge
        for (wire, stream), said in stats.streams.items():
            labels = {"robot": robot, "wire": wire, "stream": stream}
            count("zstate_publisher_samples", "Samples put on the network.", said.samples, **labels)
            count("zstate_publisher_bytes", "Their payloads [bytes].", said.bytes, **labels)
            text = "Samples not said, since nobody reads the stream."
            count("zstate_publisher_suppressed", text, said.suppressed, **labels)
            key: Hashable = id(publisher), wire, stream
            rate_hz = self._paces.rate_hz(key, said.samples)
            gauge("zstate_publisher_rate_hertz", "Samples put a second.", rate_hz, **labels)
        count("zstate_publisher_refused", "Samples that could not be published.", stats.refused, robot=robot)
        if stats.rate is not None:
            rate = stats.rate
            text = "The rate that the publisher is to keep."
            gauge("zstate_publisher_commanded_hertz", text, rate.commanded_hz, robot=robot)
            count("zstate_publisher_ticks", "Ticks of that rate.", rate.ticks, robot=robot)
            text = "Ticks more than a period late."
            count("zstate_publisher_late_ticks", text, rate.late, robot=robot)
            text = "Ticks given up after a long delay."
            count("zstate_publisher_skipped_ticks", text, rate.skipped, robot=robot)
