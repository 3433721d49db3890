"""Writers of moving transforms that are killed, frozen or replaced, behind a router with access control.

The odometry has a constant velocity, so each pose has one true value, whatever samples are missing.
"""

from __future__ import annotations

import re
import signal
import time
from pathlib import Path

import pytest
from helpers.fault_processes import RECOVERED_WITHIN_S, FaultProcess, Site, Start, client, print_figures
from helpers.processes import until, without_pauses

pytestmark = pytest.mark.processes

ROUNDS = 3
RATE_HZ = 100.0
TOKEN_EXPIRY_S = 0.5
HOUR = 3600 * 1_000_000_000


@pytest.fixture
def site(tmp_path: Path, start: Start) -> Site:
    return Site(tmp_path, start)


def transform_events(reader: FaultProcess) -> list[str]:
    return [kind for kind, stream, _ in reader.query("events") if stream == "transforms"]


def await_known_rate(reader: FaultProcess) -> None:
    """Wait for a hundred samples: with few and a pause between, ten such pauses are no silence yet."""
    until(lambda: reader.query("odometry count", "r1") >= 100)


def conflicts(reader: FaultProcess) -> list[str]:
    return [text for kind, _, text in reader.query("events") if kind == "conflict"]


def assert_all_true(reader: FaultProcess, *motions: str) -> None:
    """Ends the watch of the reader; no pose was wrong at any time."""
    for motion in motions:
        watched = reader.query(f"{motion}watched", "r1")
        assert (watched["wrong"], watched["went_back"], watched["old_as_fresh"]) == (0, 0, 0), (
            motion,
            watched,
        )


def test_router_killed_while_a_robot_moves_shows_no_wrong_pose_and_history_fills_the_gap(
    start: Start, site: Site
):
    start("publisher", robot="r1", session=site.join("r1"), rate_hz=RATE_HZ)
    odometry = start("odometry", robot="r1", session=site.join("r1"), writer="odometry", rate_hz=RATE_HZ)
    reader = start("reader", session=site.join("desk"), robot="r1")
    assert reader.query("odometry after", "r1", 0)
    assert reader.query("after", "r1", 0)
    first = reader.query("odometry newest", "r1")
    for motion in ("", "odometry "):
        reader.query(f"{motion}watch", "r1")
    answered = []
    for number in range(1, ROUNDS + 1):
        site.router.kill()
        site.start_router()
        received_at = reader.query("odometry after", "r1", site.router.ready_at)
        answered.append((received_at - site.router.ready_at) * 1e-9)
        until(lambda number=number: transform_events(reader).count("back") == number)
    events = transform_events(reader)  # before the pause, in which the writer becomes stale
    last = odometry.query("pause")
    assert reader.query("odometry after", "r1", last - 1)
    until(lambda: reader.query("odometry count", "r1") == odometry.query("sent"))
    print_figures("router killed: odometry again after the new one is ready", answered)
    assert reader.query("odometry wrong", "r1", first, last) == []
    assert without_pauses(events) == ["joined", *["cut off", "back"] * ROUNDS]
    assert_all_true(reader, "", "odometry ")
    assert odometry.query("errors") == []
    assert reader.query("stats")["refused"] == {}
    assert max(answered) < RECOVERED_WITHIN_S


def test_killed_writer_is_replaced_within_the_expiry_of_its_tokens(start: Start, site: Site):
    reader = start("reader", session=site.join("desk"), robot="r1")
    answered: list[float] = []
    for lane, name in enumerate(("odometry", "odometry", None, None, "odometry")):
        odometry = start("odometry", robot="r1", session=site.join("r1"), writer=name, lane=lane)
        received_at = reader.query("odometry after", "r1", odometry.ready_at)
        answered.append((received_at - odometry.ready_at) * 1e-9)
        if not lane:
            reader.query("odometry watch", "r1")
        until(lambda lane=lane: reader.query("odometry lane", "r1") == lane)
        if lane < 4:
            odometry.kill()
    last = odometry.query("pause")
    assert reader.query("odometry after", "r1", last - 1)
    until(lambda: reader.query("odometry count", "r1") == odometry.query("sent"))
    assert_all_true(reader, "odometry ")
    print_figures("writer killed: odometry of the next one after it is ready", answered)
    stats = reader.query("stats")
    assert (stats["missed"], stats["dropped"], stats["refused"]) == (0, 0, {})
    assert conflicts(reader) == []
    assert transform_events(reader) == [
        "joined",
        *["left", "restarted"],
        *["left", "joined"] * 2,
        "left",
        "restarted",
    ]
    assert max(answered) < TOKEN_EXPIRY_S + RECOVERED_WITHIN_S


def test_writer_frozen_for_a_second_is_stale_resumes_and_keeps_its_edge(start: Start, site: Site):
    reader = start("reader", session=site.join("desk"), robot="r1")
    frozen = start("odometry", robot="r1", session=site.join("r1"), writer="wheels")
    rival = start("odometry", robot="r1", session=site.join("r1"), writer="visual", lane=1, paused=True)
    assert reader.query("odometry after", "r1", rival.ready_at)
    await_known_rate(reader)
    reader.query("odometry watch", "r1")
    frozen.freeze()
    rival.query("resume")
    until(lambda: rival.query("errors"))
    until(lambda: "stale" in transform_events(reader))
    frozen.signal(signal.SIGCONT)
    until(lambda: "resumed" in transform_events(reader))
    assert reader.query("odometry after", "r1", time.time_ns())
    assert reader.query("odometry lane", "r1") == 0
    assert_all_true(reader, "odometry ")
    (error,) = rival.query("errors")
    assert f"pid {frozen.child.process.pid}" in error
    # "is placing" if the rival sees the claim of the edge before it sees its writer
    assert re.search("(places|is placing) 'r1/world' on 'r1/odom' already, as 'wheels' of 'r1'", error)
    assert frozen.query("errors") == []
    assert reader.query("stats")["refused"] == {}


def test_writer_frozen_for_so_long_that_another_took_its_edge_continues_and_the_other_ends(
    start: Start, site: Site
):
    reader = start("reader", session=site.join("desk"), robot="r1")
    frozen = start("odometry", robot="r1", session=site.join("r1"), writer="wheels")
    await_known_rate(reader)
    reader.query("odometry watch", "r1")
    frozen.freeze()
    until(lambda: "cut off" in transform_events(reader))
    rival = start("odometry", robot="r1", session=site.join("r1"), writer="visual", lane=1)
    assert reader.query("odometry after", "r1", rival.ready_at)
    assert reader.query("odometry lane", "r1") == 1
    frozen.signal(signal.SIGCONT)
    until(lambda: rival.query("errors"))
    assert reader.query("odometry after", "r1", time.time_ns())
    until(lambda: reader.query("odometry lane", "r1") == 0)
    watched = reader.query("odometry watched", "r1")
    assert (watched["wrong"], watched["old_as_fresh"]) == (0, 0)
    (error,) = rival.query("errors")
    assert f"pid {frozen.child.process.pid}" in error
    assert "places 'r1/world' on 'r1/odom' already, as 'wheels' of 'r1'" in error
    assert frozen.query("errors") == []
    (conflict,) = conflicts(reader)
    for process in (frozen, rival):
        assert f"pid {process.child.process.pid}" in conflict


def test_denied_writer_gets_the_missing_rule_and_doctor_reports_a_denied_reader(start: Start, site: Site):
    start("odometry", robot="r1", session=site.join("r1"), writer="wheels")
    denied = start("odometry", robot="r1", session=site.join("r2"), writer="visual", wait=False)
    robot, stranger = site.doctor("r2"), site.doctor("stranger")
    assert robot.code == stranger.code == 1
    assert "none of its data arrives: the router denies zstate/r1/** to the certificate" in robot.stdout
    assert "next: zstate acl --viewer NAME" in robot.stdout
    assert "or the router shows none to the certificate" in stranger.stdout
    assert denied.child.wait() != 0
    for text in ("AccessDenied", "r2.pem", "'r1 writes'", "`zstate acl --robot r1`"):
        assert text in denied.child.stderr


def test_clock_of_one_writer_set_back_restarts_only_its_edges(start: Start, endpoint: str):
    start("router", listen=endpoint)
    odometry = start("odometry", robot="r1", session=client(endpoint), writer="wheels")
    start("publisher", robot="r1", session=client(endpoint))
    reader = start("reader", session=client(endpoint), robot="r1")
    for motion in ("", "odometry "):
        assert reader.query(f"{motion}after", "r1", 0)
    reader.query("watch", "r1")
    for shift in (-HOUR, 0):
        stepped = odometry.query("shift", shift)
        assert reader.query("odometry near", "r1", stepped)
        assert reader.query("odometry after", "r1", stepped + 50_000_000)
    assert_all_true(reader, "")
    (set_back,) = [event for event in reader.query("events") if event[0] == "set back"]
    assert set_back[1] == "transforms"
    stats = reader.query("stats")
    assert stats["refused"] == {}
    assert stats["missed"] <= 1
