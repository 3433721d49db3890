"""--metrics: serves Prometheus metrics while a command runs. Libraries load when something is served."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from zstate.cli.output.console import print_status

if TYPE_CHECKING:
    from zstate.bridges.ros2 import Bridge
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.driving.driver_state import DriverStateListener
    from zstate.metrics.collectors import Listened
    from zstate.metrics.endpoint import BindAddress, MetricsCollector
    from zstate.net.session import Session
    from zstate.nodes.sample_publisher import SamplePublisher
    from zstate.recording.recorder import Recorder

Factory = Callable[[], "MetricsCollector"]


@contextmanager
def serve_metrics(address: BindAddress | None, *factories: Factory) -> Generator[None]:
    """Serve the collectors that ``factories`` make at ``address``, which is printed; nothing for None."""
    if address is None:
        yield
        return
    from zstate.metrics.endpoint import MetricsEndpoint

    with MetricsEndpoint([factory() for factory in factories], *address) as endpoint:
        print_status(f"metrics at {endpoint.url}", event="metrics")
        yield


def publisher_collector(*publishers: SamplePublisher) -> Factory:
    """Metrics of publishers."""
    return lambda: _collectors().PublisherMetrics(publishers)


def listener_collector(listeners: Callable[[], Sequence[Listened]]) -> Factory:
    """Metrics of the listeners that exist at each scrape."""
    return lambda: _collectors().ListenerMetrics(listeners)


def writer_collector(directory: RobotDirectory) -> Factory:
    """Metrics of the announced writers."""
    return lambda: _collectors().WriterMetrics(directory.robots)


def driver_collector(listener: DriverStateListener) -> Factory:
    """Metrics of the drivers of robots."""
    return lambda: _collectors().DriverMetrics(listener)


def connection_collector(session: Session) -> Factory:
    """Metrics of the connections of a router."""
    return lambda: _collectors().ConnectionMetrics(session)


def recorder_collector(recorder: Recorder) -> Factory:
    """Metrics of a recorder."""
    return lambda: _collectors().RecorderMetrics(recorder)


def bridge_collector(bridge: Bridge) -> Factory:
    """Metrics of a bridge."""
    return lambda: _collectors().BridgeMetrics(bridge)


def _collectors():
    from zstate.metrics import collectors

    return collectors
