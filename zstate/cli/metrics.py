"""--metrics: what a command serves for Prometheus while it runs."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from zstate.cli.output.console import print_status

if TYPE_CHECKING:
    from zstate.bridges.ros2 import Bridge
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.metrics.collectors import Listened
    from zstate.metrics.endpoint import BindAddress, MetricsCollector
    from zstate.net.session import Session
    from zstate.nodes.publisher import StatePublisher
    from zstate.recording.recorder import Recorder


@contextmanager
def serve_metrics(
    address: BindAddress | None, *collectors: Callable[[], MetricsCollector]
) -> Generator[None]:
    """What ``collectors`` make is served at ``address`` meanwhile, and where is said; None serves nothing."""
    if address is None:
        yield
        return
    from zstate.metrics.endpoint import MetricsEndpoint

    with MetricsEndpoint([make() for make in collectors], *address) as endpoint:
        print_status(f"metrics at {endpoint.url}", event="metrics")
        yield


# Each loads its library when something is served.


def publisher_collector(*publishers: StatePublisher) -> Callable[[], MetricsCollector]:
    """What publishers say."""

    def make() -> MetricsCollector:
        from zstate.metrics.collectors import PublisherMetrics

        return PublisherMetrics(publishers)

    return make


def listener_collector(listeners: Callable[[], Sequence[Listened]]) -> Callable[[], MetricsCollector]:
    """What the listeners that there are by then hear."""

    def make() -> MetricsCollector:
        from zstate.metrics.collectors import ListenerMetrics

        return ListenerMetrics(listeners)

    return make


def writer_collector(roster: RobotDirectory) -> Callable[[], MetricsCollector]:
    """Who writes."""

    def make() -> MetricsCollector:
        from zstate.metrics.collectors import WriterMetrics

        return WriterMetrics(roster.robots)

    return make


def connection_collector(session: Session) -> Callable[[], MetricsCollector]:
    """Who is connected to a router."""

    def make() -> MetricsCollector:
        from zstate.metrics.collectors import ConnectionMetrics

        return ConnectionMetrics(session)

    return make


def recorder_collector(recorder: Recorder) -> Callable[[], MetricsCollector]:
    """What is recorded."""

    def make() -> MetricsCollector:
        from zstate.metrics.collectors import RecorderMetrics

        return RecorderMetrics(recorder)

    return make


def bridge_collector(bridge: Bridge) -> Callable[[], MetricsCollector]:
    """What is carried."""

    def make() -> MetricsCollector:
        from zstate.metrics.collectors import BridgeMetrics

        return BridgeMetrics(bridge)

    return make
