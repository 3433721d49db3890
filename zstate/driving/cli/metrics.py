"""Metrics of drivers, by their states."""

from __future__ import annotations

from typing import TYPE_CHECKING

from zstate.cli.metrics import PluginMetrics
from zstate.driving.driver_state import DriverStateListener

if TYPE_CHECKING:
    from zstate.metrics.collectors import MetricFamilies
    from zstate.net.session import Session

_STATES = ("off", "ready", "active", "holding", "stopped", "fault", "silent")


class DriverMetrics(PluginMetrics):
    """Those of the drivers of ``robot``, or of all robots."""

    def __init__(self, session: Session, robot: str) -> None:
        super().__init__(session, robot)
        self._listener = DriverStateListener(session, robot)

    def close(self) -> None:
        self._listener.close()

    def add(self, families: MetricFamilies) -> None:
        count, gauge = families.count, families.gauge
        for robot, received in list(self._listener.states().items())[: families.max_robots]:
            state = received.state
            present = state.state if received.is_live else "silent"
            text = "1 for the present state of a driver; silent if it does not publish any."
            for name in _STATES:
                gauge("zstate_driver_state", text, name == present, robot=robot, state=name)
            gauge("zstate_driver_rate_hertz", "The rate of its loop.", state.rate_hz, robot=robot)
            count("zstate_driver_ticks", "Ticks of its loop.", state.ticks, robot=robot)
            count("zstate_driver_skipped_ticks", "Ticks that were missed.", state.skipped, robot=robot)
            count("zstate_driver_faults", "Calls of the driver that failed.", state.faults, robot=robot)
            for reason, number in state.refused.items():
                text = "Commands that were refused."
                count("zstate_driver_refused", text, number, robot=robot, reason=reason)
            if state.command_age is not None:
                age_s = state.command_age * 1e-9 + received.age_s
                text = "The time since the newest command arrived."
                gauge("zstate_driver_command_age_seconds", text, age_s, robot=robot)
            if state.transit_excess is not None:
                text = "How much longer the newest command was under way than the fastest of its session."
                excess_s = state.transit_excess * 1e-9
                gauge("zstate_driver_transit_excess_seconds", text, excess_s, robot=robot)
