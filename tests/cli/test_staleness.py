"""All commands, the view and listener events agree on which robot is stale."""

from __future__ import annotations

import time

import pytest

from zstate import Transform, TransformBuffer, connect
from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.commands.ls import robots_text
from zstate.cli.commands.tree import tree_drawing
from zstate.cli.doctor.robot_probe import StreamCollector
from zstate.cli.edge_statistics import EdgeRow, EdgeStatistics, path_text
from zstate.cli.output.drawing import ALARM, draw
from zstate.clock import SystemClock
from zstate.ingest.deadline import Deadline, DeadlineMonitor, is_stale
from zstate.net.discovery import RobotInfo
from zstate.net.topic_statistics import Arrival, TopicStatistics
from zstate.nodes.metered_buffer import MeteredBuffer
from zstate.wire.identity import WriterId
from zstate.wire.messages import JointState, order_digest
from zstate.wire.registry import get_wire

# Times between arrivals [s], as recorded over Wi-Fi: jitter, one loss, one pause.
INTERVALS_50_HZ = [0.020, 0.019, 0.023, 0.018, 0.041, 0.020, 0.016, 0.022, 0.021, 0.085, 0.002, 0.001] * 8
INTERVALS_2_HZ = [0.50, 0.49, 0.53, 0.47, 0.52, 0.50, 0.48]
SESSION = 7
WRITER = WriterId("driver", "jetson", 412, 0, SESSION)
INFO = RobotInfo("r1", (("joint_states", WRITER),))


def staleness(arrivals: list[int], stamps: list[int]) -> dict[str, bool]:
    """By consumer, whether a writer is stale now; its samples arrived at ``arrivals`` [ns, monotonic]."""
    now_s = time.monotonic_ns() * 1e-9
    native, order = get_wire("native"), order_digest(())
    edge = FrameInfo("r1/tool", "r1/base", "joint", str(WRITER), None, None, None, 0)
    found: dict[str, bool] = {}
    with (
        connect() as session,
        TopicStatistics(session, native) as listed,
        EdgeStatistics(session, "r1", "native", "joint_states", SystemClock()) as edges,
        StreamCollector(session, [INFO], "native", lambda: None) as examined,
    ):
        events, answered, metered = DeadlineMonitor(), Deadline(unknown_s=2.0), MeteredBuffer()
        events.register(("r1", SESSION))
        buffer = TransformBuffer()
        for seq, (at, stamp) in enumerate(zip(arrivals, stamps, strict=True)):
            sample = JointState(stamp, seq, SESSION, order, b"")
            for topic in (listed, edges.topic, examined.topic):
                topic.add("r1", "joint_states", sample, at, stamp)
            events.on_sample(("r1", SESSION), at * 1e-9)
            answered.on_sample(at * 1e-9)
            metered.statistics_of("r1").add(Arrival(at, stamp, seq, 0))
            buffer.insert(Transform("r1/base", "r1/tool", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp))
        (tool,) = [frame for frame in buffer.frames() if frame.name == "r1/tool"]
        found["events"] = bool(events.expired(now_s)[0])
        found["ls"] = "silent" in robots_text((INFO,), listed)
        found["monitor"] = "silent" in path_text([EdgeRow("r1/tool", edge, edges.measure(edge), None)])
        found["monitor --robots, demo"] = metered.measure("r1").rate_hz == 0.0
        samples = examined.samples("r1", "joint_states")
        found["doctor"] = samples.statistics.is_stale()
        found["doctor, ROS"] = samples.writers[SESSION].statistics.is_stale()
        found["tf"] = answered.is_missed(now_s)
        found["view"] = is_stale(now_s - arrivals[-1] * 1e-9, tool.rate_hz)
        found["tree"] = ALARM in draw(tree_drawing(buffer.frames(), time.time_ns(), in_full=True), "svg", "")
    return found


@pytest.mark.parametrize(
    ("intervals", "silent_s", "expected"),
    [
        (INTERVALS_50_HZ, 0.1, False),
        (INTERVALS_50_HZ, 0.7, True),
        (INTERVALS_50_HZ, 30.0, True),
        (INTERVALS_2_HZ, 0.7, False),
        (INTERVALS_2_HZ, 3.5, False),
        (INTERVALS_2_HZ, 6.5, True),
    ],
)
def test_all_consumers_agree_on_staleness(intervals: list[float], silent_s: float, expected: bool):
    ages_s = [silent_s + sum(intervals[number:]) for number in range(len(intervals) + 1)]
    now, system = time.monotonic_ns(), time.time_ns()
    arrivals = [now - round(age_s * 1e9) for age_s in ages_s]
    found = staleness(arrivals, [system - round(age_s * 1e9) for age_s in ages_s])
    assert set(found.values()) == {expected}, found
