"""The checks of batteries in `zstate doctor`."""

from collections.abc import Iterator

from zstate.cli.doctor.check import Check, warning
from zstate.cli.doctor.plugin_checks import PluginChecks, ProbedRobot


class BatteryChecks(PluginChecks):
    """Whether each battery of a robot is charged."""

    def checks(self, probe: ProbedRobot) -> Iterator[Check]:
        for name, battery in probe.newest("battery").items():
            if battery.charge < 0.2:
                yield warning("charge", f"{name!r} is at {battery.charge:.0%}", "charge it")
