"""What doctor checks of maps: whether each announced one has arrived."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from zstate.cli.doctor.check import Check, broken, ok
from zstate.cli.doctor.plugin_checks import PluginChecks, ProbedRobot
from zstate.net.discovery import RobotInfo
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.scans.messages import OccupancyGrid
from zstate.scans.plugin import MAP
from zstate.wire.keys import ANY, full_name
from zstate.wire.registry import get_wire


class MapChecks(PluginChecks):
    """Those of the maps of ``robots``."""

    def __init__(
        self, session: Session, robots: Sequence[RobotInfo], wire: str, on_change: Callable[[], object]
    ) -> None:
        super().__init__(session, robots, wire, on_change)
        self._maps: dict[str, dict[str, OccupancyGrid]] = {}
        self._wire, self._subscriber = get_wire(wire), None
        if any(info.named(MAP.name) for info in robots):
            robot = robots[0].name if len(robots) == 1 else ANY
            self._subscriber = subscribe(session, self._wire, robot, MAP.name, self._on_maps)

    def close(self) -> None:
        if self._subscriber is not None:
            self._subscriber.close()

    def _on_maps(self, received: list[Received]) -> None:
        for robot, key, message in received:
            if isinstance(message, OccupancyGrid):
                self._maps.setdefault(robot, {})[self._wire.edge_writer_name(key) or ""] = message
        self.on_change()

    def is_complete(self, robot: RobotInfo) -> bool:
        return {name for name, _ in robot.named(MAP.name)} <= self._maps.get(robot.name, {}).keys()

    def has_data(self, robot: str) -> bool:
        return robot in self._maps

    def checks(self, probe: ProbedRobot) -> Iterator[Check]:
        info = probe.info
        for name, writer in info.named(MAP.name):
            grid = self._maps.get(info.name, {}).get(name)
            if grid is None:
                text = f"{writer} announces the map {name!r}, which has not arrived"
                yield broken(MAP.name, text, f"zstate doctor{probe.argument} --timeout 10")
            else:
                frame = full_name(info.name, grid.frame)
                size = f"{grid.width} x {grid.height} cells of {grid.resolution:g} m"
                yield ok(MAP.name, f"{name!r}: {size} in {frame!r}, from {writer}")
