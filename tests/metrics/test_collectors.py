"""Collectors report the values of the stats, with a bounded number of labels."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
from helpers.processes import until
from helpers.prometheus_text import collected, row
from helpers.robots import RRBOT, wait_for_stream_readers
from prometheus_client.core import CounterMetricFamily

from zstate.errors import InFuture, InvalidInput
from zstate.metrics.collectors import (
    MAX_ROBOTS,
    Collector,
    MetricFamilies,
    add_connections,
    add_listeners,
    add_publishers,
    add_writers,
)
from zstate.metrics.endpoint import MetricsEndpoint
from zstate.net.discovery import RobotInfo, connections, discover
from zstate.net.presence import local_writer
from zstate.net.session import connect
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.metered_buffer import InstrumentedBuffer
from zstate.nodes.publisher import StatePublisher
from zstate.sources import SineSource
from zstate.wire.messages import JointState
from zstate.wire.native import encoding_of

JOINTS = {"robot": "r1", "wire": "native", "stream": "joint_states"}
TF = {**JOINTS, "stream": "tf"}


def test_publisher_samples_suppressed_and_refused_are_counted(sessions):
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        for _ in range(3):
            publisher.publish([0.0, 0.0])
        with pytest.raises(InvalidInput):
            publisher.publish([0.0])
        rows = collected(lambda families: add_publishers(families, [publisher]))
        size = publisher.stats.streams["native", "joint_states"].bytes
    assert rows[row("zstate_publisher_samples_total", **JOINTS)] == 3
    assert rows[row("zstate_publisher_bytes_total", **JOINTS)] == size > 3 * 2 * 8
    assert rows[row("zstate_publisher_suppressed_total", **JOINTS)] == 0
    assert rows[row("zstate_publisher_samples_total", **TF)] == 0
    assert rows[row("zstate_publisher_suppressed_total", **TF)] == 3
    assert rows[row("zstate_publisher_refused_total", robot="r1")] == 1
    assert row("zstate_publisher_ticks_total", robot="r1") not in rows


def test_publisher_with_a_rate_reports_late_and_skipped_ticks(sessions):
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        report = publisher.run(SineSource(RRBOT), 200.0, seconds=0.05)
        rows = collected(lambda families: add_publishers(families, [publisher]))
    assert rows[row("zstate_publisher_commanded_hertz", robot="r1")] == 200.0
    assert rows[row("zstate_publisher_ticks_total", robot="r1")] == report.ticks
    assert rows[row("zstate_publisher_late_ticks_total", robot="r1")] == report.late
    assert rows[row("zstate_publisher_skipped_ticks_total", robot="r1")] == report.skipped


def test_an_endpoint_does_not_slow_a_publisher_down(sessions):
    def tick_ns() -> float:
        before = time.thread_time_ns()
        for _ in range(300):
            publisher.publish([0.0, 0.0])
        return time.thread_time_ns() - before

    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        tick_ns()
        alone: list[float] = []
        served: list[float] = []
        for _ in range(15):
            alone.append(tick_ns())
            with MetricsEndpoint([Collector(lambda families: add_publishers(families, [publisher]))]):
                served.append(tick_ns())
    # The fastest of each, alternating: other load of the machine is in neither.
    assert min(served) < 1.5 * min(alone)


def test_listener_stats_age_latency_and_lookups_are_reported(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1", InstrumentedBuffer(), history_on_join=False) as listener,
        KeyPublisher(writer, "zstate/r1/joint_states", encoding_of(JointState)) as noise,
    ):
        wait_for_stream_readers(writer, "r1")
        noise.put(b"noise")
        for _ in range(4):
            publisher.publish([0.0, 0.0])
        until(lambda: listener.stats.received == 4 and listener.stats.refused)
        listener.buffer.lookup("base", "lower")
        with pytest.raises(InFuture):
            listener.buffer.lookup("base", "lower", time.time_ns() + 10**9)
        rows = collected(lambda families: add_listeners(families, [listener]))
    assert rows[row("zstate_listener_received_total", robot="r1")] == 4
    for lost in ("dropped", "missed", "late"):
        assert rows[row(f"zstate_listener_{lost}_total", robot="r1")] == 0
    assert rows[row("zstate_listener_refused_total", robot="r1", reason="malformed")] == 1
    assert 0.0 < rows[row("zstate_listener_age_seconds", robot="r1")] < 60.0
    assert rows[row("zstate_listener_latency_seconds_count", robot="r1")] == 4
    assert rows[row("zstate_listener_lookups_total", robot="r1")] == 2
    assert rows[row("zstate_listener_lookup_errors_total", robot="r1", kind="InFuture")] == 1


def test_listener_of_all_robots_reports_the_age_of_each(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, history_on_join=False) as listener,
        StatePublisher(writer, RRBOT, "r1") as one,
        StatePublisher(writer, RRBOT, "r2") as two,
    ):
        wait_for_stream_readers(writer, "r1")

        def all_received() -> bool:
            for publisher in (one, two):
                publisher.publish([0.0, 0.0])
            return listener.robots() == ("r1", "r2") and all(
                listener.buffer.can_lookup(f"{robot}/base", f"{robot}/lower") for robot in ("r1", "r2")
            )

        until(all_received)
        rows = collected(lambda families: add_listeners(families, [listener]))
    assert {labels for name, labels in rows if name == "zstate_listener_age_seconds"} == {
        frozenset({("robot", "r1")}),
        frozenset({("robot", "r2")}),
    }
    assert row("zstate_listener_received_total", robot="*") in rows


def test_restarts_of_a_writer_add_no_rows(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", InstrumentedBuffer(), history_on_join=False) as listener:
        wait_for_stream_readers(writer, "r1")

        def add(families: MetricFamilies) -> None:
            add_listeners(families, [listener])
            add_writers(families, discover(reader))

        seen: list[set[object]] = []
        for number in range(1, 6):
            with StatePublisher(writer, RRBOT, "r1") as publisher:
                until(lambda: discover(reader))
                publisher.publish([0.0, 0.0])
                until(lambda: listener.stats.received == number)  # noqa: B023 - called in this round
                seen.append(set(collected(add)))
    assert all(rows == seen[0] for rows in seen)


def test_robots_beyond_the_limit_are_counted_without_rows():
    writer = local_writer(1)
    robots = [
        RobotInfo(f"r{number:04}", (("joint_states", replace(writer, session=number)),))
        for number in range(MAX_ROBOTS + 3)
    ]
    rows = collected(lambda families: add_writers(families, robots))
    assert rows[row("zstate_robots")] == MAX_ROBOTS + 3
    assert len([name for name, _ in rows if name == "zstate_writers"]) == MAX_ROBOTS


def test_two_writers_of_a_stream_count_as_two():
    writers = (("tf_static", local_writer(1)), ("tf_static", local_writer(2)))
    rows = collected(lambda families: add_writers(families, [RobotInfo("r1", writers)]))
    assert rows[row("zstate_writers", robot="r1", stream="tf_static")] == 2


def test_rows_with_the_same_labels_add_up_and_counter_names_end_in_total():
    families = MetricFamilies()
    for value in (2, 3):
        families.count("zstate_things", "Things.", value, robot="r1")
    (family,) = families
    assert isinstance(family, CounterMetricFamily)
    assert [(sample.name, sample.value) for sample in family.samples] == [("zstate_things_total", 5)]


def test_router_reports_its_sessions_and_links(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with connect(mode="router", listen=endpoint) as router:
        with connect(mode="client", endpoints=endpoint), connect(mode="peer", endpoints=endpoint):
            until(lambda: connections(router).sessions == {"client": 1, "peer": 1, "router": 0})
            rows = collected(lambda families: add_connections(families, router))
            assert rows[row("zstate_router_sessions", mode="client")] == 1
            assert rows[row("zstate_router_links", protocol="tcp")] == 2
        until(lambda: not any(connections(router).sessions.values()))
