"""Shared code of the foreign subjects, and ROS 1 itself if it is installed."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from bench import robot
from bench.job import Job
from bench.robot import write_motion
from bench.scenario import Scenario
from bench.subjects import all_subjects, tf_messages
from bench.subjects.tf_messages import HISTORY_NS, TfBytes, TfReader
from bench.trial import run_trial
from zstate import load_model
from zstate.model.kinematics import Kinematics

MODELS = Path(__file__).parents[2] / "models"
ROS2 = get_typestore(Stores.ROS2_JAZZY)
STAMP = 1_234_567_890_123_456_789


@pytest.fixture(params=["rrbot", "gripper", "diffbot"])
def job(request: pytest.FixtureRequest, tmp_path: Path) -> Job:
    """A job from the root to the last link with three rows of positions."""
    model = load_model(MODELS / f"{request.param}.urdf")
    rows = np.random.default_rng(5).uniform(-1.5, 1.5, (3, len(model.joint_names)))
    write_motion(tmp_path / "robot", model, rows)
    return Job(
        subject="none",
        urdf=str(tmp_path / "robot.urdf"),
        motion=str(tmp_path / "robot"),
        joints=model.joint_names,
        base=model.root,
        tip=model.links[-1],
        links=model.links,
        rows=tuple(map(tuple, rows.tolist())),
        rate_hz=10.0,
    )


def read(content: bytes) -> Any:
    return ROS2.deserialize_cdr(content, "tf2_msgs/msg/TFMessage")


def test_precomputed_transforms_give_the_same_tip_pose_as_zstate(job: Job):
    answered: list[int] = []
    tfs, reader = TfBytes(job), TfReader(job, answered.append)
    reader.on_statics(read(tfs.static))
    for number, row in enumerate(job.rows):
        reader.on_transforms(read(tfs.message(number, STAMP + number)))
        assert answered[-1] == STAMP + number
        expected = Kinematics(load_model(Path(job.urdf))).link_poses(row)[-1]
        found = np.array(reader.pose(STAMP + number))
        assert np.allclose(found[:3], expected[:3], atol=1e-12)
        assert abs(found[3:] @ expected[3:]) == pytest.approx(1.0, abs=1e-12)


def test_every_edge_of_a_message_has_the_stamp(job: Job):
    transforms = read(TfBytes(job).message(0, STAMP)).transforms
    stamps = {at.sec * 10**9 + at.nanosec for at in (edge.header.stamp for edge in transforms)}
    assert stamps == {STAMP}


def test_tree_is_complete_after_moving_and_static_edges(job: Job):
    answered: list[int] = []
    tfs, reader = TfBytes(job), TfReader(job, answered.append)
    reader.on_transforms(read(tfs.message(0, STAMP)))
    has_statics = bool(read(tfs.static).transforms)
    assert (reader.has_tree(), answered) == ((False, []) if has_statics else (True, [STAMP]))
    reader.on_statics(read(tfs.static))
    assert reader.has_tree()


def test_history_keeps_ten_seconds(job: Job):
    answered: list[int] = []
    tfs, reader = TfBytes(job), TfReader(job, answered.append)
    reader.on_statics(read(tfs.static))
    for stamp in (STAMP, STAMP + HISTORY_NS, STAMP + HISTORY_NS + 1):
        reader.on_transforms(read(tfs.message(0, stamp)))
    with pytest.raises(KeyError):
        reader.pose(STAMP)
    reader.pose(STAMP + HISTORY_NS)


def test_free_domain_skips_a_used_domain():
    first = tf_messages.free_domain((1,))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * first + 10))
        tf_messages.free_domain.cache_clear()
        assert tf_messages.free_domain((1,)) != first
    tf_messages.free_domain.cache_clear()


@pytest.mark.ros1
def test_ros_1_answers_equal_the_poses_of_zstate(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(robot.MODELS, "rrbot", str(MODELS / "rrbot.urdf"))
    facts = run_trial(all_subjects()["ros1"], Scenario("rrbot", 50.0, seconds=0.5))
    assert "failed" not in facts, facts["failed"]
    assert facts["readers"][0]["answered"] > 0
    assert facts["poses"]["compared"] > 0
    assert facts["poses"]["errors"] == 0
    assert facts["poses"]["most_m"] < 1e-9
    assert {"master", "state publisher", "writer", "reader"} <= facts["cpu_percent"].keys()
