"""Shared code of the foreign subjects, and ROS 1 itself if it is installed."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from bench import robot
from bench.job import Job
from bench.scenario import Scenario
from bench.subjects import dds, ros1
from bench.subjects.tf_messages import HISTORY_NS, TfBytes, TfHistory
from bench.subjects.wakeup_reader import WakeupReader
from bench.trial import run_trial
from zstate import load_model
from zstate.model.kinematics import Kinematics

MODELS = Path(__file__).parents[2] / "models"
FOREIGN = ("ros1", "ros1_default", "ros1_cpp", "ros2", "cyclone")
ROS2 = get_typestore(Stores.ROS2_JAZZY)
STAMP = 1_234_567_890_123_456_789


def a_job(name: str) -> Job:
    """A job from the root to the last link with three rows of positions."""
    urdf = MODELS / f"{name}.urdf"
    model = load_model(urdf)
    rows = np.random.default_rng(5).uniform(-1.5, 1.5, (3, len(model.joint_names)))
    return Job(
        subject="none",
        urdf=str(urdf),
        joints=model.joint_names,
        base=model.root,
        tip=model.links[-1],
        links=model.links,
        rows=tuple(map(tuple, rows.tolist())),
        rate_hz=10.0,
    )


def read(content: bytes) -> Any:
    return ROS2.deserialize_cdr(content, "tf2_msgs/msg/TFMessage")


@pytest.mark.parametrize("name", ["rrbot", "gripper", "diffbot"])
def test_precomputed_transforms_give_the_same_tip_pose_as_zstate(name: str):
    job = a_job(name)
    tfs, history = TfBytes(job), TfHistory(job)
    history.add_statics(read(tfs.static))
    for number, row in enumerate(job.rows):
        assert history.add(read(tfs.message(number, STAMP + number))) == STAMP + number
        expected = Kinematics(load_model(job.urdf)).link_poses(row)[-1]
        found = np.array(history.pose(STAMP + number))
        assert np.allclose(found[:3], expected[:3], atol=1e-12)
        assert abs(found[3:] @ expected[3:]) == pytest.approx(1.0, abs=1e-12)


def test_every_edge_of_a_message_has_the_stamp():
    transforms = read(TfBytes(a_job("rrbot")).message(0, STAMP)).transforms
    stamps = {at.sec * 10**9 + at.nanosec for at in (edge.header.stamp for edge in transforms)}
    assert stamps == {STAMP}


def test_tree_is_complete_after_moving_and_static_edges():
    job = a_job("rrbot")
    tfs, history = TfBytes(job), TfHistory(job)
    history.add(read(tfs.message(0, STAMP)))
    assert not history.has_tree()
    assert not history.has_pose(STAMP)
    history.add_statics(read(tfs.static))
    assert history.has_tree()
    assert history.has_pose(STAMP)


def test_history_keeps_ten_seconds():
    job = a_job("rrbot")
    tfs, history = TfBytes(job), TfHistory(job)
    history.add_statics(read(tfs.static))
    for stamp in (STAMP, STAMP + HISTORY_NS, STAMP + HISTORY_NS + 1):
        history.add(read(tfs.message(0, stamp)))
    assert not history.has_pose(STAMP)
    assert history.has_pose(STAMP + HISTORY_NS)


def test_fast_user_is_called_in_the_receiving_thread():
    threads: list[int] = []
    WakeupReader(a_job("rrbot"), lambda _: threads.append(threading.get_ident())).on_sample(1)
    assert threads == [threading.get_ident()]


def test_slow_user_answers_the_newest_sample_without_blocking_the_receiver():
    answered: list[int] = []
    is_in, may_go, is_done = threading.Event(), threading.Event(), threading.Event()

    def user(stamp: int) -> None:
        answered.append(stamp)
        is_in.set()
        may_go.wait(10)
        if stamp == 4:
            is_done.set()

    wakeup = WakeupReader(replace(a_job("rrbot"), load="slow"), user)
    wakeup.on_sample(1)
    assert is_in.wait(10)
    for stamp in (2, 3, 4):
        wakeup.on_sample(stamp)  # returns while the user is at 1
    may_go.set()
    assert is_done.wait(10)
    wakeup.close()
    assert answered == [1, 4]


def test_free_domain_skips_a_used_domain():
    first = dds.free_domain((1,))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * first + 10))
        dds.free_domain.cache_clear()
        assert dds.free_domain((1,)) != first
    dds.free_domain.cache_clear()


def test_subject_modules_import_only_the_standard_library():
    code = f"""
import sys
from importlib import import_module
for name in {FOREIGN}:
    subject = import_module("bench.subjects." + name).SUBJECT
    assert subject.name == name and subject.settings and subject.install, name
outside = {{name.partition(".")[0] for name in sys.modules}} - sys.stdlib_module_names
print(*sorted(outside - {{"__main__", "bench"}}))
"""
    # -S: without site-packages only the standard library can be imported
    result = subprocess.run(
        [sys.executable, "-S", "-c", code],
        cwd=MODELS.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


@pytest.mark.ros1
def test_ros_1_answers_equal_the_poses_of_zstate(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(robot.MODELS, "rrbot", str(MODELS / "rrbot.urdf"))
    facts = run_trial(ros1.SUBJECT, Scenario("rate", "rrbot", 50.0, seconds=0.5))
    assert "failed" not in facts, facts["failed"]
    assert facts["readers"][0]["answered"] > 0
    assert facts["poses"]["compared"] > 0
    assert facts["poses"]["errors"] == 0
    assert facts["poses"]["most_m"] < 1e-9
    assert {"master", "state publisher", "writer", "reader"} <= facts["cpu_percent"].keys()
