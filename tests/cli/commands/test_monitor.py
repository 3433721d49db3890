from __future__ import annotations

import json
import os

import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, published_robot, run_cli, started
from helpers.processes import until

from zstate import StatePublisher, StaticPublisher, Transform, connect, load_model
from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.edge_statistics import EdgeMeasure, EdgeRow, EdgeStatistics, overview_text, path_text
from zstate.clock import ClockOffset, ManualClock
from zstate.net.streams import KeyPublisher
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.native import encode, encoding_of

DRIVER = "driver@jetson pid 412"

MODEL = load_model(RRBOT)
FIXED = str(len(MODEL.links) - 1 - len(MODEL.joint_names))


CLOCK = ManualClock(1_789_000_000_000_000_000)


def frame(name: str, parent: str | None, kind: str = "joint", writer: str = DRIVER) -> FrameInfo:
    return FrameInfo(name, parent, kind, writer, None, None, None, 0)


TREE = (
    frame("r1/base", None, "root"),
    frame("r1/torso", "r1/base", "static"),
    frame("r1/left", "r1/torso"),
    frame("r1/hand", "r1/left"),
    frame("r1/right", "r1/torso"),
)
MEASURE = EdgeMeasure(99.96, 0.0004, 0.0021, 0.00011, 3, 0.004)


def rows(offset: ClockOffset | None = None) -> list[EdgeRow]:
    measured = [
        EdgeRow(edge.name, edge, MEASURE if edge.kind == "joint" else None, offset) for edge in TREE[1:4]
    ]
    return [EdgeRow("r1/base", None, None, None), *measured]


def test_joints_of_one_robot_have_their_numbers_once():
    assert path_text(rows(ClockOffset(10_000, 200_000))).splitlines() == [
        "frame  edge    rate      latency   max     jitter    missed  clock  writer",
        "base",
        "torso  static                                                       driver@jetson pid 412",
        "left   joint   100.0 Hz  400.0 us  2.1 ms  110.0 us  3       0      driver@jetson pid 412",
        "hand   joint",
    ]


def test_each_of_two_drivers_of_a_robot_has_its_own_numbers():
    other = frame("r1/hand", "r1/left", writer="hand@jetson pid 413")
    *_, left, hand = path_text([*rows()[:3], EdgeRow("r1/hand", other, MEASURE, None)]).splitlines()
    assert left.endswith(DRIVER)
    assert hand.split()[:4] == ["hand", "joint", "100.0", "Hz"]
    assert hand.endswith("hand@jetson pid 413")


def test_wrong_clock_gets_a_note():
    *table, note = path_text(rows(ClockOffset(-1_200_000_000, 100_000))).splitlines()
    assert "  -1.2 s  " in table[3]
    assert note == (
        f"the clock of {DRIVER} is 1.2 s behind the one here (± 100.0 us), and its latencies are off by that"
    )


def test_narrow_terminal_gets_fewer_columns_and_abbreviated_writers():
    lines = path_text(rows(), width=52).splitlines()
    assert (
        lines[0] == "frame  edge    rate      latency   jitter    missed  writer"
        or max(map(len, lines)) <= 52
    )
    assert max(map(len, lines)) <= 52
    assert lines[-1] == f"a: {DRIVER}"
    assert lines[3].endswith(" a")


def test_stale_edge_has_its_silence_instead_of_a_rate():
    silent = EdgeMeasure(100.0, 0.0004, 0.0021, 0.00011, 0, 12.0, is_stale=True)
    text = path_text([EdgeRow("r1/left", frame("r1/left", "r1/base"), silent, None)])
    assert "silent 12.0 s" in text


def test_each_edge_has_its_rate_latency_writer_and_clock():
    with published_robot(), connect() as session, StaticPublisher(session, "rrbot", "mount") as statics:
        statics.set(Transform("tool", "gauge", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
        report = json.loads(run_cli("monitor", "world", "gauge", "--once", "--json").stdout)
    edges = {edge["child"].partition("/")[2]: edge for edge in report["edges"]}
    assert list(edges) == ["base", "upper", "lower", "tool", "gauge"]
    assert [edge["kind"] for edge in edges.values()] == ["static", "joint", "joint", "static", "static"]
    lower = edges["lower"]
    assert f"pid {os.getpid()}" in lower["writer"]
    assert 20.0 < lower["rate_hz"] < 200.0
    assert 0.0 < lower["latency_s"] <= lower["latency_max_s"] < 1.0
    assert lower["missed"] == 0
    assert abs(lower["clock_offset_s"]) <= lower["clock_uncertainty_s"] + 0.05
    assert edges["gauge"]["writer"] == "mount"


def test_fixed_edges_belong_to_the_writer_of_the_model():
    with (
        published_robot(streams=("joint_states",)),
        connect() as session,
        StatePublisher(session, MODEL, "rrbot", streams=("robot_description", "tf_static"), program="model"),
    ):
        report = json.loads(run_cli("monitor", "world", "tool", "--once", "--json").stdout)
    writers = {(edge["kind"], edge["writer"].startswith("model@")) for edge in report["edges"]}
    assert writers == {("joint", False), ("static", True)}


@pytest.mark.processes
def test_it_continues_and_reports_silent_writers(spawn: Spawn):
    command = started(spawn, "monitor", "base", "tool")
    until(lambda: "waiting: " in command.stderr)
    with published_robot():
        assert command.line().startswith("pose of tool in base: the newest is ")
        lines = [command.line() for _ in range(6)]
        assert [line.split()[0] for line in lines[:5]] == ["frame", "base", "upper", "lower", "tool"]
    until(lambda: "silent" in command.line())
    interrupted(command)


def test_missing_numbers_and_latency_are_measured():
    with (
        connect() as writer,
        connect() as reader,
        EdgeStatistics(reader, "r1", "native", "joint_states", CLOCK) as statistics,
    ):
        key, order = "zstate/r1/joint_states", order_digest(("swing",))
        with KeyPublisher(writer, key, encoding_of(JointState)) as stream:
            until(lambda: stream.has_readers)
            for seq in (0, 1, 5):
                stream.put(encode(JointState(CLOCK.now() - 10_000_000, seq, 7, order, to_block([0.5]))))
            until(lambda: (measure := statistics.measure(TREE[2])) is not None and measure.missed == 3)
        measure = statistics.measure(TREE[2])
    assert measure is not None
    assert measure.latency_s == pytest.approx(0.01)
    assert statistics.measure(frame("r2/left", "r2/torso")) is None


def test_once_gives_up_with_the_reason():
    message = failure("monitor", "base", "tool", "--once", "--timeout", "0.7")
    assert "gave up after 0.7 s: no robot is announced" in message


def test_each_edge_is_measured_on_a_ros_wire(ros_router: str):
    with published_robot(wire="ros2", router=ros_router):
        report = json.loads(run_cli("monitor", "base", "tool", "--once", "--json").stdout)
    assert [edge["kind"] for edge in report["edges"]] == ["pose", "pose", "static"]
    assert all(edge["rate_hz"] > 0.0 for edge in report["edges"][:2])


def test_overview_has_one_line_for_joints_and_one_for_fixed_edges():
    frames = (*TREE[1:], frame("r2/odom", "map", "pose", "odometry"), frame("r2/laser", "r2/odom", "static"))
    rows_of_all = [EdgeRow(one.name, one, MEASURE if one.kind != "static" else None, None) for one in frames]
    assert overview_text(rows_of_all).splitlines() == [
        "frame    edge      rate      latency   max     jitter    missed  clock  writer",
        f"r1/*     3 joints  100.0 Hz  400.0 us  2.1 ms  110.0 us  3              {DRIVER}",
        f"r1/*     1 static                                                       {DRIVER}",
        "r2/odom  pose      100.0 Hz  400.0 us  2.1 ms  110.0 us  3              odometry",
        f"r2/*     1 static                                                       {DRIVER}",
    ]
    narrow = overview_text(rows_of_all, width=52).splitlines()
    assert max(map(len, narrow)) <= 52
    assert narrow[0].split()[:2] == ["frame", "edge"]
    assert narrow[-2:] == [f"a: {DRIVER}", "b: odometry"]


def test_without_frames_all_received_edges_are_monitored():
    with published_robot("left"), published_robot("right"):
        lines = run_cli("monitor", "--once").stdout.splitlines()
        edges = json.loads(run_cli("monitor", "--once", "--json").stdout)["edges"]
        (only,) = run_cli("monitor", "--robot", "left", "--once").stdout.splitlines()[1:2]
    assert [line.split()[:3] for line in lines[1:5]] == [
        ["left/*", "2", "joints"],
        ["left/*", FIXED, "static"],
        ["right/*", "2", "joints"],
        ["right/*", FIXED, "static"],
    ]
    assert f"pid {os.getpid()}" in lines[1]
    assert only.startswith("left/*")
    assert {edge["child"] for edge in edges} == {
        f"{robot}/{link}" for robot in ("left", "right") for link in MODEL.links if link != MODEL.root
    }
    assert all(edge["rate_hz"] > 0.0 for edge in edges if edge["kind"] == "joint")


def test_without_frames_and_robots_the_error_names_the_reason():
    message = failure("monitor", "--once", "--timeout", "0.7")
    assert "gave up after 0.7 s: no robot is announced" in message


def test_one_frame_is_not_enough():
    assert "'base' is one frame; give two frames, or none" in failure("monitor", "base", code=2)


def test_all_edges_on_ros_side_have_their_ros_names(ros_router: str):
    with published_robot(wire="ros2", router=ros_router):
        lines = run_cli("monitor", "--once").stdout.splitlines()
    assert [line.split()[:2] for line in lines[1:4]] == [["lower", "pose"], ["upper", "pose"], ["*", FIXED]]


@pytest.mark.parametrize("what", [(), ("base", "lower"), ("--robots",)])
def test_it_ends_after_the_seconds_that_are_given(what: tuple[str, ...]):
    with published_robot():
        ended = run_cli("monitor", *what, "--seconds", "2", "--json")
    assert 1 <= len(ended.stdout.splitlines()) <= 2


@pytest.mark.parametrize("what", [(), ("base", "lower"), ("--robots",)])
def test_without_robots_it_fails_after_the_seconds_with_the_reason(what: tuple[str, ...]):
    assert "gave up after 0.5 s" in failure("monitor", *what, "--seconds", "0.5")


def test_seconds_are_refused_with_once():
    assert "--timeout limits the wait" in failure("monitor", "--once", "--seconds", "1", code=2)
