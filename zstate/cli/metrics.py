"""--metrics: what a command serves for Prometheus while it runs."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from zstate.cli.output.console import print_status

if TYPE_CHECKING:
    from zstate.bridge import Bridge
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.metrics.address import Address
    from zstate.metrics.library import Collector
    from zstate.metrics.listening import Listened
    from zstate.net.session import Session
    from zstate.nodes.publisher import StatePublisher
    from zstate.recording.recorder import Recorder


@contextmanager
def served(address: Address | None, *collectors: Callable[[], Collector]) -> Generator[None]:
    """What ``collectors`` make is served at ``address`` meanwhile, and where is said; None serves nothing."""
    if address is None:
        yield
        return
    from zstate.metrics.endpoint import MetricsEndpoint

    with MetricsEndpoint([make() for make in collectors], *address) as endpoint:
        print_status(f"metrics at {endpoint.url}", event="metrics")
        yield


# Each loads its library when something is served.


def of_publishers(*publishers: StatePublisher) -> Callable[[], Collector]:
    """What publishers say."""

    def make() -> Collector:
        from zstate.metrics.publishing import PublisherMetrics

        return PublisherMetrics(publishers)

    return make


def of_listeners(listeners: Callable[[], Sequence[Listened]]) -> Callable[[], Collector]:
    """What the listeners that there are by then hear."""

    def make() -> Collector:
        from zstate.metrics.listening import ListenerMetrics

        return ListenerMetrics(listeners)

    return make


def of_writers(roster: RobotDirectory) -> Callable[[], Collector]:
    """Who writes."""

    def make() -> Collector:
        from zstate.metrics.presence import WriterMetrics

        return WriterMetrics(roster.robots)

    return make


def of_connections(session: Session) -> Callable[[], Collector]:
    """Who is connected to a router."""

    def make() -> Collector:
        from zstate.metrics.presence import ConnectionMetrics

        return ConnectionMetrics(session)

    return make


def of_recorder(recorder: Recorder) -> Callable[[], Collector]:
    """What is recorded."""

    def make() -> Collector:
        from zstate.metrics.carrying import RecorderMetrics

        return RecorderMetrics(recorder)

    return make


def of_bridge(bridge: Bridge) -> Callable[[], Collector]:
    """What is carried."""

    def make() -> Collector:
        from zstate.metrics.carrying import BridgeMetrics

        return BridgeMetrics(bridge)

    return make
