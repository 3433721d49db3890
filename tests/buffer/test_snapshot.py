"""Snapshots: the poses of all frames in any other, their edges, and the span."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from helpers.robots import RRBOT, SECOND
from hypothesis import given
from hypothesis import strategies as st

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.buffer.tracks import TimeSpan
from zstate.clock import ManualClock
from zstate.errors import UnknownFrame
from zstate.transform import Transform

QUARTER = np.sqrt(0.5)
AHEAD = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
AHEAD_AND_LEFT = (1.0, 0.0, 0.0, 0.0, 0.0, QUARTER, QUARTER)
STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def filled(history_s: float = 10.0, seconds: float = 1.0, rate_hz: int = 100) -> TransformBuffer:
    """rrbot's shoulder turns by one radian a second, its elbow rests."""
    buffer = TransformBuffer(history_s, ManualClock())
    track = buffer.add_robot(RRBOT, "r1")
    for tick in range(round(seconds * rate_hz) + 1):
        buffer.insert_joints(track, tick * SECOND // rate_hz, [tick / rate_hz, 0.0])
    return buffer


def test_frame_table_lists_the_edge_and_its_writer():
    buffer = filled(rate_hz=50)
    (moving,) = [joint for joint in RRBOT.joints if joint.name == RRBOT.joint_names[0]]
    (info,) = buffer.frames([f"r1/{moving.child}"])
    assert (info.parent, info.kind, info.newest) == (f"r1/{moving.parent}", "joint", SECOND)
    assert info.rate_hz == pytest.approx(50.0)
    assert buffer.frame_table().robots["r1"].rate_hz == pytest.approx(50.0)
    assert buffer.frames(["r1/nowhere"]) == ()
    assert "r2" not in buffer.frame_table().robots


@pytest.mark.parametrize("at", [None, SECOND, SECOND // 2])
def test_covariances_are_no_poses(at, recwarn):
    """A variance of zero is usual: odometry on a floor. Warnings would be printed by any program."""
    buffer = TransformBuffer(10.0, ManualClock())
    for second in (0, 1):
        base = Transform("odom", "base", [2.0 * second, 0, 0], [0, 0, 0, 1], second * SECOND)
        buffer.insert(base.with_covariance(np.diag([0.01, 0.01, 0, 0, 0, 0.01])))
    poses = buffer.snapshot(at)
    expected = 2.0 if at is None else 2.0 * at / SECOND
    assert poses.poses_in("odom")[poses.tree.row("base")].tolist() == [expected, 0, 0, 0, 0, 0, 1]
    assert [str(warning.message) for warning in recwarn] == []


def test_frame_added_later_appears_in_the_next_snapshot():
    buffer = filled()
    assert "camera" not in buffer.frame_table().names
    buffer.insert_static(Transform("r1/base", "camera", [1, 0, 0], [0, 0, 0, 1]))
    table = buffer.frame_table()
    assert table.kinds[table.row("camera")] == "static"
    assert buffer.frame_table() is table


def test_tracks_of_a_robot_are_its_joints_and_the_edges_above_its_root():
    buffer = filled()
    buffer.insert(Transform("r1/odom", "r1/world", [1, 0, 0], [0, 0, 0, 1], stamp=0))
    buffer.insert(Transform("map", "r1/odom", [1, 0, 0], [0, 0, 0, 1], stamp=0))
    buffer.insert(Transform("r1/lower", "r1/marker", [1, 0, 0], [0, 0, 0, 1], stamp=0))
    table = buffer.frame_table()
    joints, *above = table.tracks_of["r1"]
    assert joints is table.robots["r1"]
    assert [track.name for track in above] == ["r1/odom -> r1/world", "map -> r1/odom"]
    assert {track.name for track in table.moving} == {
        *("r1", "r1/odom -> r1/world", "map -> r1/odom", "r1/lower -> r1/marker")
    }


def test_tracks_of_a_robot_without_a_model_are_those_of_its_frames_and_above():
    buffer = TransformBuffer(10.0, ManualClock())
    buffer.insert_static(Transform("hall", "cam/room", [0, 0, 0], [0, 0, 0, 1]))
    for child in ("cam/cup", "cam/box"):
        buffer.insert(Transform("cam/room", child, [1, 0, 0], [0, 0, 0, 1], stamp=0))
    buffer.insert(Transform("site", "hall", [1, 0, 0], [0, 0, 0, 1], stamp=0))
    (names,) = [[track.name for track in tracks] for tracks in buffer.frame_table().tracks_of.values()]
    assert names == ["site -> hall", "cam/room -> cam/cup", "cam/room -> cam/box"]


def test_span_reaches_from_the_oldest_sample_to_the_newest():
    assert filled(seconds=2.0).span() == TimeSpan(0, 2 * SECOND)
    assert TransformBuffer().span() is None


def test_robot_silent_for_long_does_not_extend_the_span():
    buffer = filled(history_s=10.0)
    buffer.insert(Transform("map", "odom", [0, 0, 0], [0, 0, 0, 1], stamp=100 * SECOND))
    assert buffer.span() == TimeSpan(90 * SECOND, 100 * SECOND)


def shifted(x: float, stamp: int) -> Transform:
    return Transform("odom", "base", (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp=stamp)


def test_poses_after_the_newest_sample_are_known_only_for_the_hold_time():
    buffer = TransformBuffer()
    buffer.insert(shifted(1.0, SECOND))
    buffer.insert(shifted(2.0, 2 * SECOND))
    row = buffer.frame_table().row("base")
    held = buffer.snapshot(2 * SECOND + 100, hold_s=1e-6)
    assert held.known[row]
    assert held.poses[row, 0] == 2.0
    beyond = buffer.snapshot(2 * SECOND + 100)
    assert not beyond.known[row]
    assert beyond.reasons[row] == "100 ns after the newest sample of 'odom -> base' (no writer)"


def test_snapshot_equals_lookups_exactly_at_samples_and_to_rounding_between():
    buffer = filled()
    edges = [("map", "r1/world"), ("map", "cart")]
    turned = [1.0, 2.0, 0.0, 0.0, 0.0, np.sin(0.5), np.cos(0.5)]
    buffer.insert_many(edges, 0, [STILL, STILL])
    buffer.insert_many(edges, SECOND, [turned, AHEAD])
    for at in (0, SECOND // 3, SECOND // 2, SECOND):
        snapshot = buffer.snapshot(at)
        assert snapshot.known.all()
        for row, parent in enumerate(snapshot.tree.parents.tolist()):
            if parent >= 0:
                names = snapshot.tree.names[parent], snapshot.tree.names[row]
                expected = buffer.lookup(*names, at).matrix
                found = Transform.from_pose7("p", "c", snapshot.poses[row]).matrix
                np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-14)


def test_snapshot_of_selected_robots_has_their_frames_and_those_above():
    buffer = filled()
    buffer.add_robot(RRBOT, "r2")
    buffer.insert_static(Transform("map", f"r1/{RRBOT.root}", [0, 0, 0], [0, 0, 0, 1]))
    table = buffer.frame_table(["r1"])
    assert set(table.names) == {"map", *(f"r1/{link}" for link in RRBOT.links)}
    assert list(table.robots) == ["r1"]
    assert buffer.snapshot(robots=["r1"]).tree is table


def test_frame_tables_of_several_selections_stay_the_same_objects():
    buffer = filled()
    buffer.add_robot(RRBOT, "r2")
    selections = ((), ("r1",), ("r2",), ("r1", "r2"))
    tables = [buffer.frame_table(robots) for robots in selections]
    assert [buffer.frame_table(robots) for robots in selections] == tables  # compared by identity


class OvertakenBuffer(TransformBuffer):
    """A buffer in which ``overtake`` is called once, just after samples were read."""

    overtake: Callable[[], object] | None = None

    def _read_views(self, tracks):
        views = super()._read_views(tracks)
        overtake, self.overtake = self.overtake, None
        if overtake is not None:
            overtake()
        return views


def test_first_velocities_of_a_robot_do_not_disturb_a_snapshot_of_the_samples_before():
    buffer = OvertakenBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    for second in (0, 1):
        buffer.insert_joints(track, second * SECOND, [float(second), 0.0])
    before = buffer.snapshot(SECOND // 2)
    buffer.overtake = lambda: buffer.insert_joints(track, 2 * SECOND, [2.0, 0.0], [0.0, 0.0])
    assert buffer.snapshot(SECOND // 2).poses.tolist() == before.poses.tolist()


def tree_of(*parents: int) -> FrameTable:
    names = tuple(f"f{row}" for row in range(len(parents)))
    kinds = tuple("root" if parent < 0 else "pose" for parent in parents)
    return FrameTable(names, np.array(parents, dtype=np.intp), kinds, (None,) * len(parents))


def poses_of(tree: FrameTable, poses: object, *unknown: int) -> FramePoses:
    known = np.ones(len(tree.names), dtype=np.bool_)
    known[list(unknown)] = False
    return FramePoses(5, tree, np.array(poses, dtype=np.float64), known)


def test_frame_pose_builds_on_the_pose_of_its_parent():
    moment = poses_of(tree_of(-1, 0, 1), [STILL, AHEAD_AND_LEFT, AHEAD])
    # One ahead and turned left; the next is one ahead of that, so one to the left.
    assert moment.poses_in("f0")[2] == pytest.approx((1.0, 1.0, 0.0, 0.0, 0.0, QUARTER, QUARTER))
    assert moment.poses_in("f0")[0] == pytest.approx(STILL)


def test_poses_in_returns_poses_relative_to_the_selected_frame():
    moment = poses_of(tree_of(-1, 0, 1), [STILL, AHEAD_AND_LEFT, AHEAD])
    assert moment.poses_in("f2")[2] == pytest.approx(STILL)
    assert moment.poses_in("f2")[1, :3] == pytest.approx((-1.0, 0.0, 0.0))
    assert moment.poses_in("f2")[0, :3] == pytest.approx((-1.0, 1.0, 0.0))


def test_frames_of_another_tree_have_no_pose():
    placed = poses_of(tree_of(-1, 0, -1, 2), [STILL, AHEAD, STILL, AHEAD]).poses_in("f1")
    assert np.isnan(placed[2:]).all()
    assert not np.isnan(placed[:2]).any()


def test_unknown_edge_pose_separates_only_its_subtree():
    moment = poses_of(tree_of(-1, 0, 1, 0), [STILL, STILL, AHEAD, AHEAD], 1)
    assert np.isnan(moment.poses_in("f0")[[1, 2]]).all()
    assert moment.poses_in("f0")[3, :3] == pytest.approx((1.0, 0.0, 0.0))
    assert moment.poses_in("f1")[2, :3] == pytest.approx((1.0, 0.0, 0.0))


def test_unknown_frame_raises_with_near_misses():
    with pytest.raises(UnknownFrame) as caught:
        poses_of(tree_of(-1, 0), [STILL, AHEAD]).poses_in("f01")
    assert "f1" in caught.value.near_misses


@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_poses_of_any_tree_equal_the_product_of_its_edges(seed: int, size: int):
    rng = np.random.default_rng(seed)
    parents = [int(rng.integers(-1, row)) for row in range(size)]
    numbers = rng.normal(size=(size, 7))
    numbers[:, 3:] /= np.linalg.norm(numbers[:, 3:], axis=1)[:, None]
    numbers[[row for row, parent in enumerate(parents) if parent < 0]] = STILL
    moment = poses_of(tree_of(*parents), numbers)
    fixed = int(rng.integers(size))
    matrices: list[np.ndarray] = []
    for row, parent in enumerate(parents):
        own = Transform.from_pose7("a", "b", numbers[row]).matrix
        matrices.append(own if parent < 0 else matrices[parent] @ own)
    roots = moment.tree.roots
    for row, placed in enumerate(moment.poses_in(f"f{fixed}")):
        if roots[row] != roots[fixed]:
            assert np.isnan(placed).all()
        else:
            expected = np.linalg.inv(matrices[fixed]) @ matrices[row]
            np.testing.assert_allclose(Transform.from_pose7("a", "b", placed).matrix, expected, atol=1e-9)
