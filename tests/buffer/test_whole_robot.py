"""All joints and all links of a robot at one instant."""

from __future__ import annotations

import numpy as np
import pytest

from zstate import InFuture, InPast, Kinematics, NoData, Stale, Transform, TransformBuffer, load_model

MS = 1_000_000


def test_link_poses_are_those_of_the_interpolated_joints() -> None:
    model = load_model("gripper")
    buffer = TransformBuffer()
    track = buffer.add_robot(model, "left")
    first, second = np.full(model.position_count, 0.01), np.full(model.position_count, 0.03)
    buffer.insert_joints(track, 0, first)
    buffer.insert_joints(track, 10 * MS, second)
    positions, stamp = buffer.joint_positions(track, 5 * MS)
    assert stamp == 5 * MS
    np.testing.assert_allclose(positions, np.full(model.position_count, 0.02), atol=1e-15)
    poses, stamp = buffer.link_poses(track, 5 * MS)
    assert stamp == 5 * MS
    np.testing.assert_allclose(poses, Kinematics(model).link_poses(positions), atol=1e-15)


def test_link_poses_agree_with_lookups_link_by_link() -> None:
    model = load_model("gripper")
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    for k in range(3):
        buffer.insert_joints(track, k * 10 * MS, np.full(model.position_count, 0.01 * k))
    poses, stamp = buffer.link_poses(track)
    assert stamp == 20 * MS
    for link, pose in zip(model.links, poses, strict=True):
        looked_up = buffer.lookup(model.root, link, 20 * MS)
        np.testing.assert_allclose(pose[:3], looked_up.translation, atol=1e-12)
        assert abs(pose[3:] @ looked_up.rotation) == pytest.approx(1.0, abs=1e-12)


def test_outside_the_history_the_error_is_that_of_a_lookup() -> None:
    model = load_model("rrbot")
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    with pytest.raises(NoData):
        buffer.joint_positions(track)
    buffer.insert_joints(track, 10, np.zeros(2))
    with pytest.raises(InPast) as past:
        buffer.link_poses(track, 9)
    assert past.value.edge == ("base", "upper")
    with pytest.raises(InFuture):
        buffer.link_poses(track, 11)


def test_an_error_names_the_track_at_fault() -> None:
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
