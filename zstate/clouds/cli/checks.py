"""What doctor checks of clouds: whether their points are stamped by the clock of the robot."""

from __future__ import annotations

from collections.abc import Iterator

from zstate.cli.doctor.check import Check, ok, warning
from zstate.cli.doctor.plugin_checks import PluginChecks, ProbedRobot
from zstate.clouds.cloud import cloud_from_message
from zstate.clouds.messages import PointCloud
from zstate.clouds.plugin import CLOUD
from zstate.errors import InvalidInput, format_duration

_LONGEST_NS = 10 * 10**9
"""Points are measured within this time before or after the stamp of their cloud."""


class CloudChecks(PluginChecks):
    """Those of the newest cloud of each sensor."""

    def checks(self, probe: ProbedRobot) -> Iterator[Check]:
        for sensor, message in probe.newest(CLOUD.name).items():
            yield _times_check(probe, sensor, message)


def _times_check(probe: ProbedRobot, sensor: str, message: PointCloud) -> Check:
    echo = f"zstate echo{probe.argument} --stream {CLOUD.name} --once"
    try:
        cloud = cloud_from_message(message, probe.info.name)
        distance = cloud.end_stamp - cloud.stamp
    except InvalidInput as error:
        return warning(CLOUD.name, f"{sensor!r}: {error}", echo)
    if cloud.is_rigid:
        return ok(CLOUD.name, f"{sensor!r}: {len(cloud)} points without times, placed by one pose")
    if abs(distance) > _LONGEST_NS:
        order = "after" if distance > 0 else "before"
        text = (
            f"the field {cloud.time_field!r} of {sensor!r} stamps its points "
            f"{format_duration(abs(distance))} {order} their cloud: the sensor has a clock of its own, and "
            "points are placed by no pose; synchronise it by PTP, or let its driver stamp them by the host"
        )
        return warning(CLOUD.name, text, echo)
    return ok(CLOUD.name, f"{sensor!r}: {len(cloud)} points, each with its time")
