from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import RRBOT, Spawn, failure, interrupted, run_cli, started
from helpers.processes import DEADLINE_S, until
from helpers.recording_builder import MS, START, RecordingBuilder, swing_positions

from zstate import NoData, StatePublisher, Transform, TransformListener, connect, discover, load_model
from zstate.errors import Unreachable
from zstate.net.queryable import query_lookup

DERIVED = {"robot_description", "tf_static", "tf"}


def streams_of(robot: str) -> set[str]:
    with connect() as session:
        return {stream for info in discover(session) if info.name == robot for stream, _ in info.writers}


@pytest.mark.processes
def test_joints_writes_joint_states_and_nothing_else(spawn: Spawn):
    started(spawn, "joints", RRBOT).line()
    assert streams_of("rrbot") == {"joint_states"}


@pytest.mark.processes
def test_publish_follows_joint_states_and_writes_the_rest(spawn: Spawn):
    assert started(spawn, "publish", RRBOT).line() == (
        "publishing 'rrbot' (7 links, 2 joints) on zstate/rrbot/{robot_description,tf_static,tf}"
    )
    assert streams_of("rrbot") == DERIVED


@pytest.mark.processes
def test_publish_with_its_own_source_writes_joint_states_too(spawn: Spawn):
    started(spawn, "publish", RRBOT, "--source", "sine").line()
    assert streams_of("rrbot") == DERIVED | {"joint_states"}


@pytest.mark.processes
def test_writers_have_the_name_of_their_command(spawn: Spawn):
    child = started(spawn, "joints", RRBOT)
    child.line()
    with connect() as session:
        ((_, writer),) = discover(session)[0].writers
    assert (writer.program, writer.pid) == ("zstate-joints", child.process.pid)


@pytest.mark.processes
def test_every_joint_state_becomes_transforms_of_the_same_stamp(spawn: Spawn):
    child = started(spawn, "publish", RRBOT)
    child.line()
    model = load_model(RRBOT)
    with (
        connect() as session,
        StatePublisher(session, model, "rrbot", streams=("joint_states",)) as joints,
        TransformListener(session, "rrbot", follow="tf") as listener,
    ):
        stamp = 0

        def moved() -> bool:
            nonlocal stamp
            stamp += 1_000
            joints.publish([0.5, 0.0], stamp=stamp)
            return listener.buffer.can_lookup("base", "upper")

        until(moved)
        newest = listener.buffer.lookup("base", "upper")
        assert newest.stamp is not None
        assert newest.stamp % 1_000 == 0
        # The shoulder turns about y.
        assert math.isclose(newest.rpy[1], 0.5, abs_tol=1e-12)
    interrupted(child)
    assert " published, " in child.line()
    assert "receiving zstate/rrbot/joint_states: 2 positions" in child.stderr


@pytest.mark.processes
@pytest.mark.parametrize("source", ["joints", "sine"])
def test_publish_answers_lookups_for_devices_without_a_buffer(spawn: Spawn, source: str):
    publisher = started(spawn, "publish", RRBOT, "--source", source)
    publisher.line()
    if source == "joints":
        started(spawn, "joints", RRBOT).line()

    answers: list[Transform] = []

    def has_reply_in_buffer() -> bool:
        try:
            answers.append(query_lookup(session, "rrbot", "world", "tool"))
        except (NoData, Unreachable):  # not discovered yet, or without a sample
            return False
        return listener.buffer.can_lookup("world", "tool", answers[-1].stamp)

    with connect() as session, TransformListener(session, "rrbot") as listener:
        until(has_reply_in_buffer)
        reply = answers[-1]
        expected = listener.buffer.lookup("world", "tool", reply.stamp)
        assert np.allclose(reply.pose7, expected.pose7, rtol=0.0, atol=1e-12)
    interrupted(publisher)


def test_publish_at_a_rate_reports_the_achieved_rate():
    output = run_cli("publish", RRBOT, "--source", "sine", "--rate", "50", "--seconds", "0.2").stdout
    # Ten ticks, 20 ms apart; a busy machine may skip some, which are then counted.
    assert "; commanded 50 Hz, achieved " in output.splitlines()[-1]


def test_missing_joint_states_are_a_failure_with_a_hint():
    message = failure("publish", RRBOT, "--seconds", "0.3")
    assert "waiting for zstate/rrbot/joint_states" in message
    assert "received nothing on zstate/rrbot/joint_states in 0.3 s; `zstate ls`" in message


@pytest.mark.processes
def test_joint_states_of_another_model_are_reported(spawn: Spawn):
    child = started(spawn, "publish", RRBOT)
    child.line()
    gripper = load_model("gripper")
    with connect() as session, StatePublisher(session, gripper, "rrbot", streams=("joint_states",)) as other:

        def refused() -> bool:
            other.publish(gripper.neutral)
            return "joint_states refused" in child.stderr

        until(refused)


def test_unknown_wire_error_lists_known_wires():
    message = failure("publish", RRBOT, "--source", "sine", "--wire", "carrier-pigeon", code=2)
    assert "'carrier-pigeon'" in message
    assert "'native'" in message


def test_a_recording_is_published_with_present_stamps(tmp_path: Path):
    with RecordingBuilder(tmp_path / "run.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(100):
            builder.joints("arm", START + n * 10 * MS, swing_positions(n))
    with connect() as session, TransformListener(session, "rrbot") as listener:
        before = time.time_ns()
        ended = run_cli("publish", RRBOT, "--source", str(tmp_path / "run.mcap"), "--rate", "200")
        newest = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S).stamp
        assert newest is not None
        assert before < newest < time.time_ns()
    assert ended.code == 0, ended.stderr
    assert "commanded 200 Hz" in ended.stdout


def test_source_file_that_is_not_a_recording_is_wrong_usage():
    assert "neither 'joints' nor 'sine' nor a recording" in failure(
        "publish", RRBOT, "--source", "nope.mcap", code=2
    )
