"""--metrics: serves Prometheus metrics while a command runs. Libraries load when something is served."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, TypeAlias

from zstate._util.closeable import Closeable
from zstate._util.lazy_names import loaded
from zstate.cli.output.console import print_status
from zstate.plugins import built_in_plugins

if TYPE_CHECKING:
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.metrics.collectors import Listened, MetricFamilies
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.session import Session
    from zstate.nodes.sample_publisher import SamplePublisher

AddRows: TypeAlias = "Callable[[MetricFamilies], None]"
"""Adds rows at a scrape."""


class PluginMetrics(Closeable):
    """What `zstate monitor --metrics` serves of the streams of one plugin, for ``robot``, or "*" for all."""

    def __init__(self, session: Session, robot: str) -> None:
        self.session, self.robot = session, robot

    def add(self, families: MetricFamilies) -> None:
        """Add its rows, at a scrape."""

    def close(self) -> None:
        """End what it has opened."""


@contextmanager
def serve_metrics(address: BindAddress | None, *rows: AddRows) -> Generator[None]:
    """Serve ``rows`` at ``address``, which is printed; nothing for None."""
    if address is None:
        yield
        return
    from zstate.metrics.collectors import Collector
    from zstate.metrics.endpoint import MetricsEndpoint

    with MetricsEndpoint([Collector(add) for add in rows], *address) as endpoint:
        print_status(f"metrics at {endpoint.url}", event="metrics")
        yield


@contextmanager
def plugin_rows(session: Session, robot: str) -> Generator[list[AddRows]]:
    """What plugins measure of ``robot``, or "*", while it is open."""
    with ExitStack() as opened:
        references = [plugin.metrics for plugin in built_in_plugins() if plugin.metrics]
        yield [opened.enter_context(loaded(reference)(session, robot)).add for reference in references]


def publisher_rows(*publishers: SamplePublisher) -> AddRows:
    """Those of publishers."""
    return lambda families: _collectors().add_publishers(families, publishers)


def listener_rows(listeners: Callable[[], Sequence[Listened]]) -> AddRows:
    """Those of the listeners that exist at each scrape."""
    return lambda families: _collectors().add_listeners(families, listeners())


def writer_rows(directory: RobotDirectory) -> AddRows:
    """Those of the announced writers."""
    return lambda families: _collectors().add_writers(families, directory.robots())


def connection_rows(session: Session) -> AddRows:
    """Those of the connections of a router."""
    return lambda families: _collectors().add_connections(families, session)


def _collectors():
    from zstate.metrics import collectors

    return collectors
