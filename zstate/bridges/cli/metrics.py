"""Metrics of the bridge to ROS 2."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from zstate.bridges.ros2 import Bridge
    from zstate.cli.metrics import AddRows
    from zstate.metrics.collectors import MetricFamilies


def bridge_rows(bridge: Bridge) -> AddRows:
    """The robots that it carries, and what it could not carry."""

    def add(families: MetricFamilies) -> None:
        carriers = sorted(bridge.carriers, key=lambda carrier: carrier.robot)
        for carrier in carriers[: families.max_robots]:
            robot, way, text = carrier.robot, carrier.source.direction, "Bridged robots by direction."
            families.gauge("zstate_bridge_carried", text, carrier.has_model, robot=robot, way=way)
            for reason, count in carrier.refused.items():
                text = "Messages that could not be bridged."
                families.count("zstate_bridge_refused", text, count, robot=robot, reason=reason)

    return add
