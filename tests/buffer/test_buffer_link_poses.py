"""All joints and all links of a robot at one instant."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from zstate import InFuture, InPast, Kinematics, NoData, Stale, Transform, TransformBuffer, load_model
from zstate.buffer.buffer import feed_of
from zstate.buffer.tracks import JointTrack, PoseTrack
from zstate.errors import InsertRefused

MS = 1_000_000


def test_link_poses_follow_the_interpolated_joints() -> None:
    model = load_model("gripper")
    buffer = TransformBuffer()
    track = buffer.add_robot(model, "left")
    first, second = np.full(model.position_count, 0.01), np.full(model.position_count, 0.03)
    buffer.insert_joints(track, 0, first)
    buffer.insert_joints(track, 10 * MS, second)
    positions, stamp = buffer.joint_positions("left", 5 * MS)
    assert stamp == 5 * MS
    np.testing.assert_allclose(positions, np.full(model.position_count, 0.02), atol=1e-15)
    poses, stamp = buffer.link_poses("left", 5 * MS)
    assert stamp == 5 * MS
    np.testing.assert_allclose(poses, Kinematics(model).link_poses(positions), atol=1e-15)


def test_link_poses_agree_with_lookups_link_by_link() -> None:
    model = load_model("gripper")
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    for k in range(3):
        buffer.insert_joints(track, k * 10 * MS, np.full(model.position_count, 0.01 * k))
    poses, stamp = buffer.link_poses("gripper")
    assert stamp == 20 * MS
    for link, pose in zip(model.links, poses, strict=True):
        looked_up = buffer.lookup(model.root, link, 20 * MS)
        np.testing.assert_allclose(pose[:3], looked_up.translation, atol=1e-12)
        assert abs(pose[3:] @ looked_up.rotation) == pytest.approx(1.0, abs=1e-12)


def test_link_poses_outside_the_history_raise_as_lookup() -> None:
    model = load_model("rrbot")
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    with pytest.raises(NoData):
        buffer.joint_positions("rrbot")
    buffer.insert_joints(track, 10, np.zeros(2))
    with pytest.raises(InPast) as past:
        buffer.link_poses("rrbot", 9)
    assert past.value.edge == ("base", "upper")
    with pytest.raises(InFuture):
        buffer.link_poses("rrbot", 11)


def test_error_names_the_failing_track() -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model("rrbot"), "left")
    buffer.insert_joints(track, 10, np.zeros(2))
    for stamp in (8, 20):
        buffer.insert(Transform("map", "left/world", (0, 0, 0), (0, 0, 0, 1), stamp=stamp))
    with pytest.raises(InFuture) as robot:
        buffer.lookup("map", "tool", 15)
    assert robot.value.track == "left"
    with pytest.raises(InPast) as map_edge:
        buffer.lookup("map", "world", 5)
    assert map_edge.value.track == "map -> left/world"
    with pytest.raises(Stale) as stale:
        buffer.lookup("base", "tool", max_age_s=1.0)
    assert stale.value.track == "left"


def calls_on(buffer: TransformBuffer, track: JointTrack) -> dict[str, Callable[[], object]]:
    """Every call that takes a track."""
    zeros = np.zeros(2)
    return {
        "insert_joints": lambda: buffer.insert_joints(track, 5, zeros),
        "insert_joints of a list": lambda: buffer.insert_joints(track, 5, [0.0, 0.0]),
        "insert_joints of a block": lambda: buffer.insert_joints(track, 5, zeros.tobytes()),
        "insert_joints with velocities": lambda: buffer.insert_joints(track, 5, zeros, zeros),
        "restart": lambda: feed_of(buffer).restart(track),
        "remove_robot": lambda: buffer.remove_robot(track),
    }


def test_track_of_a_removed_robot_is_refused_with_that_reason() -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model("rrbot"), "r1")
    buffer.insert_joints(track, 0, np.zeros(2))
    buffer.remove_robot(track)
    for name, call in calls_on(buffer, track).items():
        with pytest.raises(InsertRefused, match=r"'r1' was removed .* add_robot") as caught:
            call()
        assert (caught.value.reason, caught.value.edge) == ("removed robot", ("r1", "r1/world")), name
    again = buffer.add_robot(load_model("rrbot"), "r1")
    assert buffer.insert_joints(again, 7, np.zeros(2))
    assert buffer.lookup("r1/world", "r1/tool").stamp == 7


def test_track_of_another_buffer_is_refused_and_unchanged() -> None:
    ours, theirs = TransformBuffer(), TransformBuffer()
    ours.add_robot(load_model("rrbot"))
    track = theirs.add_robot(load_model("rrbot"))
    theirs.insert_joints(track, 3, np.zeros(2))
    for name, call in calls_on(ours, track).items():
        with pytest.raises(InsertRefused, match="belongs to another buffer") as caught:
            call()
        assert caught.value.reason == "another buffer", name
    assert theirs.lookup("world", "tool").stamp == 3
    poses = PoseTrack((("a", "b"),), 10, None)
    with pytest.raises(InsertRefused, match="'a -> b' belongs to another buffer"):
        feed_of(ours).restart(poses)
