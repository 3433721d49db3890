from __future__ import annotations

import itertools
import math
import os
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import RRBOT, Ended, failure, found_pose, published_robot, run_cli, run_until
from helpers.lookup_client import query_lookup
from helpers.processes import DEADLINE_S, repeated
from helpers.recording_builder import MS, START, RecordingBuilder, swing_positions

from zstate import NoData, StatePublisher, Transform, TransformListener, connect, discover, load_model
from zstate.errors import Unreachable
from zstate.wire.identity import WriterId

DERIVED = {"robot_description", "tf_static", "tf"}


def writers_of(*arguments: str, after: str) -> tuple[Ended, dict[str, WriterId]]:
    """A command and the writers of rrbot by stream, once it has written ``after``."""
    with connect() as session:

        def found() -> dict[str, WriterId] | None:
            return next((dict(one.writers) for one in discover(session) if one.name == "rrbot"), None)

        return run_until(found, *arguments, after=after)


def test_joints_writes_joint_states_and_nothing_else():
    _, writers = writers_of("joints", RRBOT, after="rrbot: ")
    assert writers.keys() == {"joint_states"}
    writer = writers["joint_states"]
    assert (writer.program, writer.pid) == ("zstate-joints", os.getpid())


def test_publish_follows_joint_states_and_writes_the_rest():
    sentence = "publishing 'rrbot' (7 links, 2 joints) on zstate/rrbot/{robot_description,tf_static,tf}\n"
    ended, writers = writers_of("publish", RRBOT, after=sentence)
    assert ended.stdout.startswith(sentence)
    assert writers.keys() == DERIVED


def test_publish_with_its_own_source_writes_joint_states_too():
    _, writers = writers_of("publish", RRBOT, "--source", "sine", after="publishing 'rrbot'")
    assert writers.keys() == DERIVED | {"joint_states"}


def test_every_joint_state_becomes_transforms_of_the_same_stamp():
    stamps = itertools.count(1_000, 1_000)
    model = load_model(RRBOT)
    with (
        connect() as session,
        StatePublisher(session, model, "rrbot", streams=("joint_states",)) as joints,
        TransformListener(session, "rrbot", follow="tf") as listener,
        repeated(lambda: joints.publish([0.5, 0.0], stamp=next(stamps))),
    ):
        ended, newest = run_until(
            lambda: found_pose(listener, "base", "upper"),
            *("publish", RRBOT),
            after="receiving zstate/rrbot/joint_states: 2 positions",
        )
    assert newest.stamp is not None
    assert newest.stamp % 1_000 == 0
    # The shoulder turns about y.
    assert math.isclose(newest.rpy[1], 0.5, abs_tol=1e-12)
    assert " published, " in ended.stdout.splitlines()[1]


@pytest.mark.parametrize("source", ["joints", "sine"])
def test_publish_answers_lookups_for_devices_without_a_buffer(source: str):
    def reply_and_lookup() -> tuple[Transform, Transform] | None:
        try:
            reply = query_lookup(session, "rrbot", "world", "tool")
        except (NoData, Unreachable):  # not discovered yet, or without a sample
            return None
        is_known = listener.buffer.can_lookup("world", "tool", reply.stamp)
        return (reply, listener.buffer.lookup("world", "tool", reply.stamp)) if is_known else None

    with (
        published_robot(streams=("joint_states",)) if source == "joints" else nullcontext(),
        connect() as session,
        TransformListener(session, "rrbot") as listener,
    ):
        _, (reply, expected) = run_until(reply_and_lookup, "publish", RRBOT, "--source", source)
    assert np.allclose(reply.pose7, expected.pose7, rtol=0.0, atol=1e-12)


def test_publish_at_a_rate_reports_the_achieved_rate():
    output = run_cli("publish", RRBOT, "--source", "sine", "--rate", "50", "--seconds", "0.2").stdout
    # Ten ticks, 20 ms apart; a busy machine may skip some, which are then counted.
    assert "; commanded 50 Hz, achieved " in output.splitlines()[-1]


def test_missing_joint_states_are_a_failure_with_a_hint():
    message = failure("publish", RRBOT, "--seconds", "0.3")
    assert "waiting for zstate/rrbot/joint_states" in message
    assert "received nothing on zstate/rrbot/joint_states in 0.3 s; `zstate ls`" in message


def test_joint_states_of_another_model_are_reported():
    gripper = load_model("gripper")
    with (
        connect() as session,
        StatePublisher(session, gripper, "rrbot", streams=("joint_states",)) as other,
        repeated(lambda: other.publish(gripper.neutral)),
    ):
        run_until(lambda: True, "publish", RRBOT, after="joint_states refused")


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
