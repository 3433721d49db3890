"""Who is there: the writers that are announced, and the connections of a session."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from zstate.metrics.families import MOST_ROBOTS, Families
from zstate.metrics.library import Collector, Metric
from zstate.net.connections import connections
from zstate.net.presence import RobotInfo
from zstate.net.session import Session


class WriterMetrics(Collector):
    """How many writers each stream has, of the robots that ``robots()`` names when it is asked."""

    def __init__(self, robots: Callable[[], Sequence[RobotInfo]]) -> None:
        self._robots = robots

    def collect(self) -> Iterable[Metric]:
        families, robots = Families(), self._robots()
        families.gauge("zstate_robots", "Robots that somebody writes for.", len(robots))
        for robot in robots[:MOST_ROBOTS]:
            for stream, _ in robot.writers:
                text = "Writers that are alive."
                families.gauge("zstate_writers", text, 1, robot=robot.name, stream=stream)
        yield from families


class ConnectionMetrics(Collector):
    """How many others a session is connected to: of a router, its clients, peers and fellow routers."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def collect(self) -> Iterable[Metric]:
        families, known = Families(), connections(self._session)
        for mode, count in known.sessions.items():
            families.gauge("zstate_router_sessions", "Connected sessions.", count, mode=mode)
        for protocol, count in known.links.items():
            families.gauge("zstate_router_links", "Links to them.", count, protocol=protocol)
        yield from families
