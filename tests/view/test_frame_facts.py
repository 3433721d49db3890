"""What the panels know of frames: edges, rates, what can be looked at, and the past of joints."""

from __future__ import annotations

import numpy as np
import pytest
from live import RRBOT, SECOND

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import ManualClock
from zstate.transform import Transform
from zstate.view.fixed_frame import FixedFrame, default_fixed_frame
from zstate.view.frame_facts import FrameFacts
from zstate.view.joint_history import joint_history
from zstate.view.replay_clock import Span
from zstate.view.world import World


def filled(history_s: float = 10.0, seconds: float = 1.0, rate_hz: int = 100) -> TransformBuffer:
    """rrbot's shoulder turns by one radian a second, its elbow rests."""
    buffer = TransformBuffer(history_s, ManualClock())
    track = buffer.add_robot(RRBOT, "r1")
    for tick in range(round(seconds * rate_hz) + 1):
        buffer.insert_joints(track, tick * SECOND // rate_hz, [tick / rate_hz, 0.0])
    return buffer


def test_a_frame_is_told_of_with_its_edge_and_the_rate_of_its_samples():
    facts = FrameFacts(filled(rate_hz=50))
    (moving,) = [joint for joint in RRBOT.joints if joint.name == RRBOT.joint_names[0]]
    info = facts.info(f"r1/{moving.child}")
    assert info is not None
    assert (info.parent, info.kind, info.newest) == (f"r1/{moving.parent}", "joint", SECOND)
    assert info.rate_hz == pytest.approx(50.0)
    assert facts.rate_hz("r1") == pytest.approx(50.0)
    assert facts.info("r1/nowhere") is None
    assert facts.rate_hz("r2") is None


def test_a_frame_that_comes_later_is_known_then():
    buffer = filled()
    facts = FrameFacts(buffer)
    assert facts.info("camera") is None
    buffer.insert_static(Transform("r1/base", "camera", [1, 0, 0], [0, 0, 0, 1]))
    info = facts.info("camera")
    assert info is not None
    assert info.kind == "static"


def test_what_can_be_looked_at_reaches_from_the_oldest_sample_to_the_newest():
    assert FrameFacts(filled(seconds=2.0)).span() == Span(0, 2 * SECOND)
    assert FrameFacts(TransformBuffer()).span() is None


def test_a_robot_that_went_silent_long_ago_does_not_stretch_what_can_be_looked_at():
    buffer = filled(history_s=10.0)
    buffer.insert(Transform("map", "odom", [0, 0, 0], [0, 0, 0, 1], stamp=100 * SECOND))
    assert FrameFacts(buffer).span() == Span(90 * SECOND, 100 * SECOND)


def test_the_past_of_joints_ends_at_the_instant_that_is_looked_at():
    track = FrameFacts(filled(seconds=3.0)).track("r1")
    assert track is not None
    history = joint_history(track, until=2 * SECOND, seconds=1.0, points=1000)
    assert (history.stamps[0], history.stamps[-1]) == (1 * SECOND, 2 * SECOND)
    np.testing.assert_allclose(history.positions[:, 0], history.stamps / SECOND)
    assert not history.positions[:, 1].any()


def test_the_past_of_joints_is_thinned_to_what_can_be_drawn():
    track = FrameFacts(filled(seconds=9.0)).track("r1")
    assert track is not None
    history = joint_history(track, until=9 * SECOND, seconds=8.0, points=100)
    assert 80 <= len(history.stamps) <= 101
    assert len(set(np.diff(history.stamps).tolist())) == 1


def test_everything_is_seen_from_the_root_with_the_most_frames():
    buffer = filled()
    buffer.insert_static(Transform("map", "odom", [0, 0, 0], [0, 0, 0, 1]))
    with World(None, buffer=buffer) as world:
        assert default_fixed_frame(world.moment().tree) == f"r1/{RRBOT.root}"


def test_a_chosen_frame_is_kept_while_it_is_there():
    with World(None, buffer=filled()) as world:
        tree, fixed = world.moment().tree, FixedFrame()
        fixed.chosen = tree.names[2]
        assert fixed.of(tree) == tree.names[2]
        fixed.chosen = "gone"
        assert fixed.of(tree) == f"r1/{RRBOT.root}"


def test_where_there_is_no_frame_there_is_none_to_see_from():
    with World(None, buffer=TransformBuffer()) as world:
        assert FixedFrame().of(world.moment().tree) == ""
