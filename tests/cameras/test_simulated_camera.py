"""Simulated cameras: what is in the picture is where the calibration projects it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.cli_runner import missing_library
from helpers.robots import RRBOT

from zstate import InvalidInput, Transform, TransformBuffer
from zstate.cameras import Camera, SimulatedCamera, Surface, floor_surface, robot_surfaces
from zstate.cameras.simulated_camera import MountedCamera
from zstate.errors import LibraryMissing

PINHOLE = Camera(320, 240, (250.0, 250.0, 159.5, 119.5))
BARREL = Camera(320, 240, (250.0, 250.0, 150.0, 130.0), d=(-0.25, 0.06, 0.001, -0.002, 0.0))
FISHEYE = Camera(320, 240, (150.0, 150.0, 159.5, 119.5), d=(0.02, 0.0, 0.0, 0.0), model="equidistant")
EACH = pytest.mark.parametrize("camera", [PINHOLE, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
RED, GREEN = (250, 20, 20), (20, 250, 20)


def plate(half: float = 0.02, color: tuple[int, int, int] = RED) -> Surface:
    """A square that looks against the z axis, at a camera at its origin."""
    corners = [[(-half, -half, 0.0), (-half, half, 0.0), (half, half, 0.0), (half, -half, 0.0)]]
    return Surface(np.array(corners, np.float32), np.array([color], np.uint8))


def is_color(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Which pixels have the hue of ``color``, in any light: (H, W)."""
    strongest = np.argmax(color)
    others = np.delete(picture, strongest, axis=2).max(axis=2)
    return picture[..., strongest] > 3 * others.astype(int)


def placed(x: float, y: float, z: float) -> tuple[float, ...]:
    return (x, y, z, 0.0, 0.0, 0.0, 1.0)


@EACH
def test_a_small_body_appears_where_the_calibration_projects_it(camera: Camera):
    simulated = SimulatedCamera(camera, {"plate": plate()})
    for x, y in ((0.0, 0.0), (0.4, -0.3), (-0.45, 0.31), (0.2, 0.33)):
        picture = simulated.picture({"plate": placed(x, y, 1.0)})
        rows, columns = np.nonzero(is_color(picture, RED))
        expected, _ = camera.project([[x, y, 1.0]])
        assert [columns.mean(), rows.mean()] == pytest.approx(expected[0].tolist(), abs=0.5)


@EACH
def test_each_pixel_of_a_floor_has_the_tone_of_the_square_that_its_ray_meets(camera: Camera):
    height = 0.6
    world_from_camera = Transform.from_rpy("world", "camera", (0.1, 0.2, height), (-2.2, 0.0, -1.3))
    floor = floor_surface((-6.0, 6.0), (-6.0, 6.0))
    simulated = SimulatedCamera(camera, {"world": floor})
    picture = simulated.picture({"world": world_from_camera.inverse().pose7})
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = (
        camera.ray(np.stack((u.ravel(), v.ravel()), axis=1).astype(float))
        @ world_from_camera.matrix[:3, :3].T
    )
    with np.errstate(all="ignore"):
        ways = np.where(rays[:, 2] < 0.0, -height / rays[:, 2], np.nan)
    x, y = (world_from_camera.translation[:, None] + rays.T * ways)[:2]
    is_odd = (np.floor(x / 0.5) + np.floor(y / 0.5)) % 2 == 1
    steps = np.stack([x, y]) / 0.5
    is_inside = (np.abs(steps - np.rint(steps)) > 0.06).all(axis=0) & (np.hypot(x, y) < 3.0)
    dark = picture.reshape(-1, 3).max(axis=1) < picture[..., 0].max() * 0.85
    assert is_inside.sum() > 10_000
    assert (dark == is_odd)[is_inside].mean() > 0.995


def test_near_bodies_hide_far_ones_in_whatever_order_they_are():
    near, far = plate(0.1, RED), plate(0.4, GREEN)
    for bodies in ({"near": near, "far": far}, {"far": far, "near": near}):
        simulated = SimulatedCamera(PINHOLE, bodies)
        picture = simulated.picture({"near": placed(0.0, 0.0, 1.0), "far": placed(0.0, 0.0, 2.0)})
        assert is_color(picture, RED)[100:140, 140:180].all()
        assert is_color(picture, GREEN)[75:165, 115:120].all()


def test_what_is_behind_the_camera_or_turned_away_is_not_seen():
    simulated = SimulatedCamera(PINHOLE, {"plate": plate(0.1)})
    turned = (0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0)
    for pose in (placed(0.0, 0.0, -1.0), turned):
        assert not is_color(simulated.picture({"plate": pose}), RED).any()


def test_a_face_that_reaches_behind_the_camera_is_cut_off():
    """A floor of one face below a level camera ends at the horizon, the row cy."""
    size = 50.0
    corners = [[(-size, 0.4, -size), (-size, 0.4, size), (size, 0.4, size), (size, 0.4, -size)]]
    floor = Surface(np.array(corners, np.float32)[:, ::-1], np.array([RED], np.uint8))
    seen = is_color(SimulatedCamera(PINHOLE, {"floor": floor}).picture({"floor": IDENTITY}), RED)
    horizon = 119.5 + 250.0 * 0.4 / size
    assert seen[math.ceil(horizon) + 1 :].all()
    assert not seen[: math.floor(horizon)].any()


def test_equal_poses_give_equal_pictures():
    poses = {link: placed(0.0, 0.2, 1.0 + 0.1 * n) for n, link in enumerate(RRBOT.links)}
    one, other = (SimulatedCamera(BARREL, robot_surfaces(RRBOT)).picture(poses) for _ in range(2))
    assert (one == other).all()
    assert len(np.unique(one)) > 5


def test_a_rolling_shutter_and_a_missing_pose_are_refused():
    rolling = Camera(320, 240, (250.0, 250.0, 159.5, 119.5), line_time_ns=30_000)
    with pytest.raises(InvalidInput, match="global shutter"):
        SimulatedCamera(rolling, {})
    with pytest.raises(InvalidInput, match="missing are plate"):
        SimulatedCamera(PINHOLE, {"plate": plate()}).picture({})


def test_without_pillow_the_extra_is_named():
    with missing_library("PIL"), pytest.raises(LibraryMissing, match=r"zstate\[cameras\]"):
        SimulatedCamera(PINHOLE, {})


def mounted(buffer: TransformBuffer, frame: str = "rrbot/eye") -> MountedCamera:
    return MountedCamera(PINHOLE, buffer, "rrbot", (frame, "map"), robot_surfaces)


def test_a_mounted_camera_sees_the_robot_at_the_newest_instant_of_all_its_links():
    """The eye stands in the world and looks at the arm, which turns: its tool is where it was then."""
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT, prefix="rrbot/")
    buffer.insert_static(
        Transform.from_rpy("rrbot/world", "rrbot/eye", (1.1, -1.0, 1.5), (-math.pi / 2, 0.0, 0.0))
    )
    source = mounted(buffer)
    assert source.read(10**9) is None
    for n in range(3):
        buffer.insert_joints(track, n * 10**8, [0.5 * n, 0.3])
    taken = source.read(10**9)
    assert taken is not None
    assert taken.stamp == 2 * 10**8
    assert source.read(10**9) is None
    tip = buffer.lookup("rrbot/eye", "rrbot/tool", taken.stamp) @ [0.0, 0.0, 0.02]
    ((u, v),), _ = PINHOLE.project([tip])
    picture = np.asarray(taken.picture)
    red, green, blue = picture[round(v), round(u)].tolist()
    assert green > red
    assert blue > red  # teal


def test_without_a_model_a_mounted_camera_sees_the_floor():
    buffer = TransformBuffer()
    buffer.insert_static(Transform.from_rpy("map", "rrbot/eye", (0.0, 0.0, 1.0), (-2.2, 0.0, 0.0)))
    taken = mounted(buffer).read(7)
    assert taken is not None
    assert taken.stamp == 7
    assert len(np.unique(np.asarray(taken.picture)[..., 0])) == 3  # two tones and the sky
