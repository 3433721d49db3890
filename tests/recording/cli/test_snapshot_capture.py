"""Capture of robots on the network; the files it becomes are tested in commands/test_snapshot.py."""

from __future__ import annotations

import threading
from contextlib import ExitStack

import pytest
from helpers.processes import new_threads, repeated
from helpers.robots import RRBOT

from zstate import StatePublisher, StaticPublisher, Transform
from zstate.cli.session import SessionOptions
from zstate.net.session import Session
from zstate.recording.cli.snapshot_capture import capture

MOUNT = Transform("upper", "camera", (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))


def threads_of_a_capture(session: Session, robots: list[str]) -> int:
    """The largest number of additional threads while the robots are captured."""
    before, most = threading.enumerate(), 0

    def count() -> None:
        nonlocal most
        most = max(most, len(new_threads(before)) - 1)  # without this thread

    with repeated(count):
        snapshot = capture(session, SessionOptions(), robots, "native", 10.0)
    assert len(snapshot.robot) == (len(robots) or 12)
    for robot in snapshot.robot:
        assert robot.positions == {"shoulder": float(robot.name[1:]), "elbow": 0.0}
    assert [edge.robot for edge in snapshot.static] == ["r1"]
    assert snapshot.static[0].transform() == MOUNT
    return most


@pytest.mark.parametrize("robots", [[f"r{number}" for number in range(12)], []], ids=["named", "all"])
def test_capture_of_twelve_robots_needs_less_than_one_thread_a_robot(
    sessions: tuple[Session, Session], robots: list[str]
):
    ours, theirs = sessions
    with ExitStack() as opened:
        publishers = [
            opened.enter_context(StatePublisher(theirs, RRBOT, robot=f"r{number}")) for number in range(12)
        ]
        opened.enter_context(StaticPublisher(theirs, "r1", "calibration")).set(MOUNT)
        opened.enter_context(
            repeated(lambda: [one.publish([float(number), 0.0]) for number, one in enumerate(publishers)])
        )
        assert threads_of_a_capture(ours, robots) < len(publishers)
