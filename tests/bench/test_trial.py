"""A real run of one second, and the measurements from outside."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.processes import Child, until

from bench.measure import cpu_ns, growth, loopback_bytes, process_tree, status, usage
from bench.process import Process, RunFailed, free_ports
from bench.recording import percentile
from bench.scenario import Scenario
from bench.subjects import all_subjects
from bench.trial import run_trial

SUBJECTS = all_subjects()
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the harness reads /proc")


@pytest.mark.processes
@pytest.mark.robots
def test_floor_at_50_hz_loses_nothing_and_reports_its_costs() -> None:
    rates: list[float] = []
    while not rates or (abs(rates[-1] - 50.0) > 5.0 and len(rates) < 4):  # a stall of the machine lowers it
        facts = run_trial(SUBJECTS["raw_zenoh"], Scenario("panda", 50.0, seconds=1.0))
        assert "failed" not in facts, facts
        [reader] = facts["readers"]
        assert (reader["lost"], reader["answered"]) == (0, facts["sent"])
        rates.append(reader["rate_hz"])
    assert rates[-1] == pytest.approx(50.0, rel=0.1), rates
    assert 0.0 < percentile(reader["latency_us"], 50) <= percentile(reader["latency_us"], 100)
    assert set(facts["cpu_percent"]) == {"writer", "reader"}
    assert all(percent > 0.0 for percent in facts["cpu_percent"].values())
    assert all(megabytes > 10.0 for megabytes in facts["peak_memory_mb"].values())
    assert facts["bytes_per_s"] > 50 * 8 * 8  # eight joints


@pytest.mark.processes
@pytest.mark.robots
@pytest.mark.long
def test_zstate_answers_correctly_and_a_late_joiner_gets_the_whole_tree() -> None:
    subject = SUBJECTS["zstate_peer"]
    facts = run_trial(subject, Scenario("panda", 50.0, seconds=1.0, joins=1))
    assert "failed" not in facts, facts
    assert facts["readers"][0]["lost"] == 0
    assert facts["joins_ms"][0] > 0.0
    assert facts["poses"]["compared"] >= 10
    assert facts["poses"]["errors"] == 0
    assert facts["poses"]["most_m"] < 1e-12
    assert facts["poses"]["most_rad"] < 1e-12


@pytest.mark.processes
@pytest.mark.robots
@pytest.mark.long
def test_soak_of_a_small_fleet_loses_nothing_and_measures_growth() -> None:
    scenario = Scenario("panda", 50.0, fleet=3, writers=2, seconds=4.0, soaks=True)
    facts = run_trial(SUBJECTS["zstate_router"], scenario)
    assert "failed" not in facts, facts
    soak = facts["soak"]
    assert soak["count"] == soak["sent"] > 100
    assert soak["latched_lost"] == 0
    assert len(soak["joins_ms"]) == 1
    assert set(soak["processes"]) == {"router", "reader", "writer 0", "writer 1"}
    assert all(one["threads"][0] > 1 for one in soak["processes"].values())


@pytest.mark.processes
@pytest.mark.robots
def test_failed_worker_fails_the_run_with_its_last_output() -> None:
    subject = replace(SUBJECTS["raw_zenoh"], name="no_such_subject")
    facts = run_trial(subject, Scenario("panda", 50.0, seconds=1.0))
    assert "KeyError: 'no_such_subject'" in facts["failed"]


@pytest.mark.processes
def test_cpu_time_of_a_process_equals_its_own_measurement(spawn: Callable[..., Child]) -> None:
    child = spawn(
        """
        import sys, threading, time
        def work():
            end = time.thread_time() + 0.2
            while time.thread_time() < end: pass
        thread = threading.Thread(target=work); thread.start(); thread.join()  # an ended thread counts too
        print(time.process_time_ns(), flush=True)
        sys.stdin.readline()
        """
    )
    own_ns = int(child.line())
    assert 200_000_000 <= own_ns <= cpu_ns(child.process.pid) <= own_ns + 50_000_000
    assert status(child.process.pid)["VmHWM"] >= status(child.process.pid)["VmRSS"] > 1000


def test_loopback_traffic_is_counted() -> None:
    before = loopback_bytes()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(10):
            sender.sendto(bytes(1000), ("127.0.0.1", 9))
    assert loopback_bytes() - before >= 10 * 1028


def test_growth_is_the_slope_of_memory_without_the_first_fifth() -> None:
    seconds = range(0, 600, 5)
    samples = [(float(s), 100_000 + (50_000 if s < 60 else s // 60 * 60), 3, 7 + s // 300) for s in seconds]
    found = growth(samples)
    slope, error = found["slope_kb_per_minute"]
    assert slope == pytest.approx(60.0, abs=1.0)
    assert error < 2.0  # the memory grows in steps of a minute
    assert found["memory_mb"] == [97.8, 98.2]
    assert (found["threads"], found["descriptors"]) == ([3, 3], [7, 8])


def test_usage_of_this_process_has_its_memory_threads_and_descriptors() -> None:
    _, memory_kb, threads, descriptors = usage(os.getpid())
    assert memory_kb > 10_000
    assert threads >= 1
    assert descriptors >= 3


@pytest.mark.processes
def test_stopping_a_process_ends_its_descendants() -> None:
    script = "sleep 60 & echo started; wait"
    process = Process("shell", ["sh", "-c", script], {}, is_service=True)
    process.wait_for_text("started", 10.0)
    members = process_tree(process.pid)
    assert len(members) == 2
    process.stop()
    until(lambda: not any(_is_alive(pid) for pid in members))


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.processes
def test_service_that_ends_early_is_reported_with_its_last_output() -> None:
    process = Process("router", ["sh", "-c", "echo port is busy; exit 1"], {}, is_service=True)
    with pytest.raises(
        RunFailed, match="the router ended before it sent 'listens'; its last output: port is busy"
    ):
        process.wait_for_text("listens", 10.0)
    process.stop()


def test_free_ports_differ() -> None:
    assert len(set(free_ports(6))) == 6
