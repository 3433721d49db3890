"""Metrics of a recorder."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from zstate.cli.metrics import AddRows
    from zstate.metrics.collectors import MetricFamilies
    from zstate.recording.recorder import Recorder

_STREAMS_PER_ROBOT = 5
"""So many have rows on average."""


def recorder_rows(recorder: Recorder) -> AddRows:
    """What it has written, and what it could not write."""

    def add(families: MetricFamilies) -> None:
        stats, count = recorder.stats, families.count
        for (robot, stream), number in sorted(stats.messages.items())[
            : _STREAMS_PER_ROBOT * families.max_robots
        ]:
            count("zstate_recorder_messages", "Messages written.", number, robot=robot, stream=stream)
        families.gauge("zstate_recorder_size_bytes", "Size of all files.", stats.bytes)
        families.gauge("zstate_recorder_files", "Files of the recording.", len(stats.files))
        for name in ("dropped", "missed", "unwritten"):
            text = f"Samples {name}, as Recorder.stats counts them."
            count(f"zstate_recorder_{name}", text, getattr(stats, name))
        for reason, number in stats.refused.items():
            count("zstate_recorder_refused", "Messages that cannot be written.", number, reason=reason)

    return add
