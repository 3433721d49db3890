"""RecorderMetrics and BridgeMetrics: what is written into files, and what is carried to and from ROS."""

from __future__ import annotations

from collections.abc import Iterable

from zstate.bridge import Bridge
from zstate.metrics.families import MOST_ROBOTS, Families
from zstate.metrics.library import Collector, Metric
from zstate.recording.recorder import Recorder

_MOST_STREAMS = 5 * MOST_ROBOTS


class RecorderMetrics(Collector):
    """Reads ``recorder`` when it is asked."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def collect(self) -> Iterable[Metric]:
        families, stats = Families(), self._recorder.stats
        for (robot, stream), count in sorted(stats.messages.items())[:_MOST_STREAMS]:
            text = "Messages written."
            families.count("zstate_recorder_messages", text, count, robot=robot, stream=stream)
        families.gauge("zstate_recorder_size_bytes", "Size of all files.", stats.bytes)
        families.gauge("zstate_recorder_files", "Files of the recording.", len(stats.files))
        for what in ("dropped", "missed", "unwritten"):
            text = f"Samples {what}, as Recorder.stats counts them."
            families.count(f"zstate_recorder_{what}", text, getattr(stats, what))
        for reason, count in stats.refused.items():
            families.count(
                "zstate_recorder_refused", "Messages that cannot be written.", count, reason=reason
            )
        yield from families


class BridgeMetrics(Collector):
    """Reads ``bridge`` when it is asked."""

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge

    def collect(self) -> Iterable[Metric]:
        families = Families()
        for carrier in sorted(self._bridge.carriers, key=lambda carrier: carrier.robot)[:MOST_ROBOTS]:
            text = "Robots that are carried, by way."
            families.gauge(
                "zstate_bridge_carried", text, carrier.has_begun, robot=carrier.robot, way=carrier.source.way
            )
            for reason, count in carrier.refused.items():
                text = "What could not be carried."
                families.count("zstate_bridge_refused", text, count, robot=carrier.robot, reason=reason)
        yield from families
