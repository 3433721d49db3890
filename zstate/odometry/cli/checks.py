"""What doctor checks of odometry: whether robots of one map have one datum."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from zstate.cli.doctor.check import Check, broken, ok, skipped
from zstate.cli.doctor.plugin_checks import PluginChecks, ProbedRobot
from zstate.net.discovery import RobotInfo
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.odometry.geodesy import SAME_DATUM_M, Datum
from zstate.odometry.messages import MapDatum
from zstate.odometry.plugin import DATUM
from zstate.wire.keys import ANY, full_name
from zstate.wire.registry import get_wire


class DatumChecks(PluginChecks):
    """Those of the datums of maps, each of which is compared with those of other robots for the same map."""

    def __init__(
        self, session: Session, robots: Sequence[RobotInfo], wire: str, on_change: Callable[[], object]
    ) -> None:
        super().__init__(session, robots, wire, on_change)
        self._datums: dict[tuple[str, str], tuple[str, Datum]] = {}
        """The map and its datum, by robot and writer."""
        self._wire, self._subscriber = get_wire(wire), None
        if any(info.named(DATUM.name) for info in robots):
            self._subscriber = subscribe(session, self._wire, ANY, DATUM.name, self._on_datums)

    def close(self) -> None:
        if self._subscriber is not None:
            self._subscriber.close()

    def _on_datums(self, received: list[Received]) -> None:
        for robot, key, message in received:
            assert isinstance(message, MapDatum)
            writer = self._wire.edge_writer_name(key) or ""
            self._datums[robot, writer] = full_name(robot, message.frame), message.datum
        self.on_change()

    def is_complete(self, robot: RobotInfo) -> bool:
        return {(robot.name, name) for name, _ in robot.named(DATUM.name)} <= self._datums.keys()

    def has_data(self, robot: str) -> bool:
        return any(of == robot for of, _ in self._datums)

    def checks(self, probe: ProbedRobot) -> Iterator[Check]:
        datums = dict(self._datums)
        for name, writer in probe.info.named(DATUM.name):
            if (probe.info.name, name) not in datums:
                yield skipped(DATUM.name, f"{writer} has had no fix yet, which would be the datum of its map")
                continue
            frame, datum = datums[probe.info.name, name]
            others = {
                robot: other
                for (robot, _), (of, other) in datums.items()
                if of == frame and datum.distance(other) > SAME_DATUM_M
            }
            if not others:
                yield ok(DATUM.name, f"the origin of {frame!r} is at {datum}, from {writer}")
            for robot, other in others.items():
                text = (
                    f"the origin of {frame!r} is at {datum}, and by {robot!r} at {other}, "
                    f"{datum.distance(other):.2f} m away"
                )
                remedy = f"zstate odometry{probe.argument} ... --datum LAT LON ALT  # one for both"
                yield broken(DATUM.name, text, remedy)
