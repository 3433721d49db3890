"""Camera poses that show all robots, and the visibility of robots."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.view.camera import FIELD_OF_VIEW, CameraPose, fit_camera, robot_visibility


def snapshot_of(*frames: tuple[str, tuple[float, float, float]]) -> FramePoses:
    """Frames that are all children of the first."""
    names = tuple(name for name, _ in frames)
    poses = np.array([[*place, 0.0, 0.0, 0.0, 1.0] for _, place in frames])
    parents = np.array([-1] + [0] * (len(frames) - 1), dtype=np.intp)
    tree = FrameTable(names, parents, ("root",) + ("static",) * (len(frames) - 1), (None,) * len(frames))
    return FramePoses(None, tree, poses, np.ones(len(frames), dtype=np.bool_))


coordinates = st.floats(-20.0, 20.0)
places = st.tuples(coordinates, coordinates, coordinates)


def in_picture(
    framing: CameraPose, points: Sequence[tuple[float, float, float]], aspect: float
) -> list[bool]:
    """Whether a camera with z up sees each point."""
    ahead = np.subtract(framing.look_at, framing.position)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    seen: list[bool] = []
    for point in points:
        ray = np.subtract(point, framing.position)
        up = math.atan2(ray @ np.cross(right, ahead), ray @ ahead)
        aside = math.atan2(ray @ right, ray @ ahead)
        widest = math.atan(aspect * math.tan(0.5 * FIELD_OF_VIEW))
        seen.append(abs(up) < 0.5 * FIELD_OF_VIEW and abs(aside) < widest)
    return seen


@given(st.lists(places, min_size=1, max_size=12), st.lists(places, max_size=8), st.floats(0.25, 4.0))
def test_fitted_camera_sees_every_robot_frame_and_mesh_corner(points, corners, aspect: float):
    origin = ("a/root", (0.0, 0.0, 0.0))
    snapshot = snapshot_of(origin, *((f"a/l{n}", point) for n, point in enumerate(points)))
    framing = fit_camera(snapshot, snapshot.poses_in("a/root"), aspect, np.reshape(corners, (-1, 3)))
    assert framing is not None
    assert all(in_picture(framing, [(0.0, 0.0, 0.0), *points, *corners], aspect))


@given(st.lists(places, min_size=1, max_size=12), places, places, st.floats(0.25, 4.0))
def test_robot_is_visible_if_one_of_its_frames_is(points, position, look_at, aspect: float):
    ahead = np.subtract(look_at, position)
    assume(np.linalg.norm(np.cross(ahead, (0.0, 0.0, 1.0))) > 1e-3)
    framing = CameraPose(position, look_at, 0.0, 3)
    assume(all(np.linalg.norm(np.subtract(point, position)) > 1e-3 for point in points))
    robots = [f"r{n}" for n in range(len(points))]
    bases = ((f"{robot}/base", point) for robot, point in zip(robots, points, strict=True))
    snapshot = snapshot_of(("map", (0.0, 0.0, 0.0)), *bases)
    found = robot_visibility(snapshot, snapshot.poses_in("map"), framing, aspect, robots)
    assert [one.is_visible for one in found] == in_picture(framing, points, aspect)


def test_invisible_robot_has_a_reason():
    names = ("map", "a/base", "a/tip", "b/base", "c/base")
    tree = FrameTable(names, np.array([-1, 0, 1, 0, 0]), ("root",) + ("static",) * 4, (None,) * 5)
    known = np.array([True, True, False, False, True])
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (5, 1))
    poses[4, :3] = (-50.0, 0.0, 0.0)
    snapshot = FramePoses(None, tree, poses, known, {2: "no joint sample of 'a'", 3: "no sample of 'b'"})
    camera = CameraPose((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 3)
    found = list(robot_visibility(snapshot, snapshot.poses_in("map"), camera, 1.0, ["a", "b", "c", "d"]))
    assert [(one.robot, one.is_visible, one.root) for one in found] == [
        ("a", True, "map"),
        ("b", False, "map"),
        ("c", False, "map"),
        ("d", False, ""),
    ]
    assert [one.reason for one in found] == [
        "no joint sample of 'a'",
        "no sample of 'b'",
        "it is outside the camera's view",
        "its description has not been received",
    ]


def test_fitted_camera_is_in_front_and_above():
    snapshot = snapshot_of(("a/root", (0.0, 0.0, 0.0)), ("a/tip", (0.0, 0.0, 1.0)))
    framing = fit_camera(snapshot, snapshot.poses_in("a/root"))
    assert framing is not None
    assert framing.look_at == (0.0, 0.0, 0.5)
    assert framing.position[0] > 0.0
    assert framing.position[2] > 0.5


def test_floor_is_at_the_feet_of_a_robot_whose_root_is_its_hip():
    walker = snapshot_of(("a/hip", (0.0, 0.0, 0.0)), ("a/foot", (0.0, 0.0, -1.0)))
    arm = snapshot_of(("a/base", (0.0, 0.0, 0.0)), ("a/tip", (0.0, 0.0, 1.0)))
    framings = [fit_camera(walker, walker.poses_in("a/hip")), fit_camera(arm, arm.poses_in("a/base"))]
    assert [framing.floor for framing in framings if framing] == [-1.0, 0.0]


def test_floor_extends_beyond_every_robot():
    snapshot = snapshot_of(("a/root", (0.0, 0.0, 0.0)), ("b/root", (0.0, -7.5, 0.0)))
    framing = fit_camera(snapshot, snapshot.poses_in("a/root"))
    assert framing is not None
    assert framing.reach > 8


def test_far_map_origin_does_not_make_the_robot_small():
    frames = (("a/root", (100.0, 0.0, 0.0)), ("a/tip", (100.0, 0.0, 1.0)))
    far = snapshot_of(("map", (0.0, 0.0, 0.0)), *frames)
    framing = fit_camera(far, far.poses_in("map"))
    assert framing is not None
    assert np.linalg.norm(np.subtract(framing.position, framing.look_at)) < 5.0


def test_no_camera_if_no_robot_has_a_pose():
    snapshot = snapshot_of(("map", (0.0, 0.0, 0.0)))
    assert fit_camera(snapshot, np.full((1, 7), np.nan)) is None
