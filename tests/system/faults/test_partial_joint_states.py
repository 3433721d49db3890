"""Drivers of one robot that are killed or claim one joint, behind a router with access control.

The joints turn at constant rates, so each pose has one true value, whatever samples are missing.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, started
from helpers.fault_processes import FaultProcess, Site, Start, print_figures
from helpers.processes import until

pytestmark = pytest.mark.processes

ROUNDS = 2
CLAIMS = 20
STREAM = "partial_joint_states"


@pytest.fixture
def site(tmp_path: Path, start: Start) -> Site:
    return Site(tmp_path, start)


@pytest.fixture
def publish(site: Site, spawn: Spawn) -> None:
    """``zstate publish`` of r1, which merges its drivers."""
    certificates = ("--certs", str(site.folder), "--identity", "r1")
    started(spawn, "publish", "rrbot", "--name", "r1", "--connect", site.endpoint, *certificates)


def start_driver(start: Start, site: Site, joint: str) -> FaultProcess:
    return start("driver", robot="r1", session=site.join("r1"), joint=joint, writer=f"{joint}-driver")


def events(reader: FaultProcess) -> list[str]:
    """Without the pauses of drivers on a busy machine."""
    pauses = ("stale", "resumed")
    return [kind for kind, stream, _ in reader.query("events") if stream == STREAM and kind not in pauses]


def assert_all_true(reader: FaultProcess, *motions: str) -> None:
    """Ends the watch of the reader; no pose was wrong at any time."""
    for motion in motions:
        watched = reader.query(f"{motion} watched", "r1")
        wrong = (watched["wrong"], watched["went_back"], watched["old_as_fresh"])
        assert wrong == (0, 0, 0), (motion, watched)


@pytest.mark.usefixtures("publish")
def test_router_killed_while_two_drivers_publish_shows_no_wrong_pose_and_history_fills_the_gap(
    start: Start, site: Site
):
    drivers = [start_driver(start, site, joint) for joint in ("shoulder", "elbow")]
    reader = start("reader", session=site.join("desk"), robot="r1")
    merged = start("reader", session=site.join("desk"), robot="r1", follow="tf")
    for one in (reader, merged):
        assert one.query("joints after", "r1", 0)
        one.query("joints watch", "r1")
    first = reader.query("joints newest", "r1")
    answered: list[float] = []
    for number in range(1, ROUNDS + 1):
        site.router.kill()
        site.start_router()
        for one in (reader, merged):
            received_at = one.query("joints after", "r1", site.router.ready_at)
            answered.append((received_at - site.router.ready_at) * 1e-9)
        until(lambda number=number: events(reader).count("back") == 2 * number)
    last = min(driver.query("pause") for driver in drivers)
    assert reader.query("joints after", "r1", last - 1)
    for driver, joint in zip(drivers, ("shoulder", "elbow"), strict=True):
        sent = driver.query("sent")
        until(lambda joint=joint, sent=sent: reader.query(f"{joint} count", "r1") == sent)
    print_figures("router killed: all joints again after the new one is ready", answered)
    assert reader.query("joints wrong", "r1", first, last) == []
    assert_all_true(reader, "joints")
    assert_all_true(merged, "joints")
    assert sorted(events(reader)) == sorted(["joined", *["cut off", "back"] * ROUNDS] * 2)
    assert reader.query("stats")["refused"] == merged.query("stats")["refused"] == {}


@pytest.mark.usefixtures("publish")
def test_killed_driver_leaves_exactly_its_links_behind_until_it_is_restarted(start: Start, site: Site):
    start_driver(start, site, "shoulder")
    killed = start_driver(start, site, "elbow")
    reader = start("reader", session=site.join("desk"), robot="r1")
    assert reader.query("joints after", "r1", 0)
    for motion in ("joints", "shoulder", "elbow"):
        reader.query(f"{motion} watch", "r1")
    killed.kill()
    until(lambda: reader.query("elbow problem", "r1").startswith("Stale"))
    problem = reader.query("elbow problem", "r1")
    assert "'r1/upper' -> 'r1/lower'" in problem
    assert f"pid {killed.child.process.pid}" in problem
    assert reader.query("joints problem", "r1").startswith("Stale")
    assert reader.query("shoulder after", "r1", time.time_ns())
    assert reader.query("shoulder problem", "r1") == ""
    restarted = start_driver(start, site, "elbow")
    assert reader.query("joints after", "r1", restarted.ready_at)
    assert_all_true(reader, "shoulder", "elbow")
    # The first sample of the new driver may be newer than the newest of the other: then there is no pose.
    watched = reader.query("joints watched", "r1")
    assert (watched["wrong"], watched["old_as_fresh"]) == (0, 0)
    assert reader.query("stats")["refused"] == {}
    assert events(reader) == ["joined", "joined", "left", "restarted"]


def test_one_of_two_programs_that_claim_a_joint_at_the_same_moment_gets_it(start: Start, site: Site):
    rivals = [start("claimant", robot="r1", session=site.join("r1"), joint="elbow") for _ in range(2)]
    for _ in range(CLAIMS):
        moment = time.time_ns() + 20_000_000
        for rival in rivals:
            rival.send("claim", moment)
        errors = [rival.receive() for rival in rivals]
        assert errors.count("") == 1, errors
        (loser,) = filter(None, errors)
        winner = rivals[errors.index("")].child.process
        assert loser.startswith("SecondWriter")
        assert f"pid {winner.pid}' already publishes the joint 'elbow' of 'r1'" in loser
        for rival in rivals:
            rival.query("release")
