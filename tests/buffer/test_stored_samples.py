"""Samples that are taken from a buffer and loaded into another one in bulk: no number changes."""

from __future__ import annotations

import numpy as np
from helpers.robots import RRBOT

from zstate import TransformBuffer
from zstate.buffer.buffer import feed_of
from zstate.buffer.stored_samples import load_joints, load_poses, take_before


def swinging(count: int) -> tuple[np.ndarray, np.ndarray]:
    stamps = np.arange(count) * 1000
    return stamps, np.stack([np.sin(stamps), np.cos(stamps)], axis=1)


def test_what_is_taken_from_a_track_gives_the_same_lookups_elsewhere():
    one, other = TransformBuffer(1e6), TransformBuffer(1e6)
    track, loaded = one.add_robot(RRBOT), other.add_robot(RRBOT)
    stamps, positions = swinging(50)
    pose = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.9273618495495704])
    for stamp, row in zip(stamps.tolist(), positions, strict=True):
        one.insert_joints(track, stamp, row, row * 2.0)
        one.insert_many([("map", "world")], stamp, [pose + np.array([stamp, 0, 0, 0, 0, 0, 0])])
    edge = feed_of(one).edge_of("world")
    instants = np.arange(0, 49_000, 333)
    expected = one.lookup_many("map", "tool", instants)
    twist = one.twist("tool", "map", 5_500)
    view, poses = take_before(feed_of(one), track, 10**9), take_before(feed_of(one), edge.track, 10**9)
    rows = view.kept_rows()
    load_joints(feed_of(other), loaded, view.kept_stamps(), rows[:, :2], rows[:, 2:])
    load_poses(feed_of(other), ("map", "world"), poses.kept_stamps(), poses.kept_rows(), None)
    found = other.lookup_many("map", "tool", instants)
    assert expected[1].all()
    assert all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))
    assert np.array_equal(other.twist("tool", "map", 5_500).linear, twist.linear)


def test_the_last_sample_that_is_taken_stays_as_the_first():
    buffer = TransformBuffer(1e6)
    track = buffer.add_robot(RRBOT)
    stamps, positions = swinging(50)
    for stamp, row in zip(stamps.tolist(), positions, strict=True):
        buffer.insert_joints(track, stamp, row)
    feed = feed_of(buffer)
    assert take_before(feed, track, 20_001).kept_stamps().tolist() == stamps[:21].tolist()
    assert take_before(feed, track, 20_001).kept_stamps().tolist() == [20_000]
    assert take_before(feed, track, 0).size == 0
    assert buffer.joint_states(RRBOT.name).stamps.tolist() == stamps[20:].tolist()


def test_loaded_edges_keep_their_covariances():
    buffer = TransformBuffer(1e6)
    covariance = np.eye(6)[np.triu_indices(6)]
    pose = [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]
    load_poses(feed_of(buffer), ("map", "base"), np.array([5]), np.array(pose), covariance[None])
    assert np.array_equal(buffer.lookup("map", "base", 5).covariance, np.eye(6))
