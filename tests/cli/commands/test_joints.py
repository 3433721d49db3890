"""zstate joints --only: drivers of some joints, merged by zstate publish."""

from __future__ import annotations

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, started
from helpers.processes import SOON_S, until

from zstate import PartialStatePublisher, TransformListener, connect, load_model
from zstate.net.discovery import discover


@pytest.mark.processes
def test_two_drivers_move_one_robot_and_publish_merges_them(spawn: Spawn):
    arm = started(spawn, "joints", "rrbot", "--only", "shoulder")
    on_stream = "rrbot: a sine on shoulder, 100 Hz, on zstate/rrbot/partial_joint_states/zstate-joints."
    assert arm.line().startswith(on_stream)
    gripper = started(spawn, "joints", "rrbot", "--only", "elbow")
    gripper.line()
    publisher = started(spawn, "publish", "rrbot")
    publisher.line()
    with (
        connect() as session,
        TransformListener(session, "rrbot") as own,
        TransformListener(session, "rrbot", follow="tf") as merged,
    ):
        own.buffer.wait("world", "tool", timeout_s=3 * SOON_S)
        merged.buffer.wait("world", "tool", timeout_s=3 * SOON_S)
        until(lambda: own.buffer.can_lookup("world", "tool"))
        (info,) = discover(session)
        assert len(info.named("partial_joint_states")) == 2
    assert "receiving zstate/rrbot/partial_joint_states: 2 positions" in publisher.stderr
    reason = failure("echo", "rrbot", "--once", "--timeout", "0.5")
    assert "`zstate echo rrbot --stream partial_joint_states`" in reason
    for child in (publisher, gripper, arm):
        interrupted(child)


def test_joint_that_has_a_driver_is_refused_with_its_name():
    with connect() as session, PartialStatePublisher(session, load_model("rrbot"), ["elbow"]):
        reason = failure("joints", "rrbot", "--only", "shoulder", "--only", "elbow")
    assert "already publishes the joint 'elbow' of 'rrbot'" in reason
    assert "unknown joint 'wrist'" in failure("joints", "rrbot", "--only", "wrist")
    assert "--takeover is for all joints" in failure(
        "joints", "rrbot", "--only", "wrist", "--takeover", code=2
    )
