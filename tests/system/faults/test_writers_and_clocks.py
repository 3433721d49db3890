"""Conflicting writers of one robot, and writers with clock steps."""

from __future__ import annotations

import time

import pytest
from helpers.fault_processes import RECOVERED_WITHIN_S, Start, client

pytestmark = pytest.mark.processes

HOUR = 3600 * 1_000_000_000


def test_second_writer_process_ends_naming_the_first_which_continues(start: Start, endpoint: str):
    start("router", listen=endpoint)
    first = start("publisher", robot="r1", session=client(endpoint))
    reader = start("reader", session=client(endpoint))
    assert reader.query("after", "r1", 0)
    second = start("publisher", robot="r1", session=client(endpoint), wait=False)
    assert second.child.wait() != 0
    assert "SecondWriter" in second.child.stderr
    assert f"pid {first.child.process.pid}" in second.child.stderr
    assert reader.query("after", "r1", time.time_ns())
    stats = reader.query("stats")
    assert (stats["missed"], stats["refused"]) == (0, {})


def test_newer_of_two_conflicting_writers_is_used_and_samples_of_the_other_are_counted(
    start: Start, endpoint: str
):
    start("router", listen=endpoint)
    start("publisher", robot="r1", session=client(endpoint))
    reader = start("reader", session=client(endpoint))
    assert reader.query("after", "r1", 0)
    second = start("publisher", robot="r1", session=client(endpoint), takeover=True, mark=2.0)
    assert reader.query("after", "r1", second.ready_at)
    reader.query("watch", "r1")
    reader.query("after", "r1", time.time_ns() + 1_000_000_000)
    watched = reader.query("watched", "r1")
    stats = reader.query("stats")
    print(f"two conflicting writers for a second: {stats}, newest went back {watched['went_back']} times")
    assert (watched["went_back"], watched["old_as_fresh"], watched["stale"]) == (0, 0, 0)
    assert stats["missed"] == 0
    assert stats["refused"]["second writer"] > 50
    second.kill()
    assert reader.query("after", "r1", time.time_ns())  # the first is received again


@pytest.mark.parametrize(
    "step",
    [
        pytest.param(-HOUR, id="-1h"),
        pytest.param(85_000, id="+85us"),
        pytest.param(HOUR, id="+1h", marks=pytest.mark.soak),
        pytest.param(-85_000, id="-85us", marks=pytest.mark.soak),
    ],
)
def test_writer_with_a_clock_step_is_received_again_also_after_the_step_back(
    start: Start, endpoint: str, step: int
):
    start("router", listen=endpoint)
    publisher = start("publisher", robot="r1", session=client(endpoint))
    start("publisher", robot="r2", session=client(endpoint))  # its clock is correct throughout
    reader = start("reader", session=client(endpoint))
    for robot in ("r1", "r2"):
        assert reader.query("after", robot, 0)
    reader.query("watch", "r2")
    for shift in (step, 0):
        stepped = publisher.query("shift", shift)
        began = time.monotonic()
        assert reader.query("near", "r1", stepped)
        assert reader.query("after", "r1", stepped + 50_000_000)
        print(f"clock of the writer set {shift:+} ns: answers after {time.monotonic() - began:.3f} s")
        assert time.monotonic() - began < RECOVERED_WITHIN_S
    watched, stats = reader.query("watched", "r2"), reader.query("stats")
    print(stats)
    assert (watched["went_back"], watched["old_as_fresh"], watched["stale"]) == (0, 0, 0)
    assert stats["missed"] <= 1
