"""Camera: OpenCV is the judge of pixels, and the camera's own pixels are that of its rays."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.cameras import Camera
from zstate.cameras.camera import camera_from_message, camera_to_message
from zstate.errors import InvalidInput

K = (612.5, 598.25, 321.5, 238.75)
WIDTH, HEIGHT = 640, 480
PLUMB_BOB = (-0.28, 0.09, 1.2e-3, -7e-4, -0.013)
RATIONAL = (0.6, -0.9, 3e-4, -2e-4, 0.35, 0.95, -0.6, 0.12)
EQUIDISTANT = (-0.021, 0.007, -0.005, 0.001)
CLOSE_PX = 1e-6


def camera(model: str = "plumb_bob", d: Any = (), **changed: Any) -> Camera:
    return Camera(**{"width": WIDTH, "height": HEIGHT, "k": K, "d": d, "model": model, **changed})


CAMERAS = [
    camera(),
    camera(d=PLUMB_BOB[:4]),
    camera(d=PLUMB_BOB),
    camera("rational_polynomial", RATIONAL),
    camera("equidistant"),
    camera("equidistant", EQUIDISTANT),
]
MODELS = [f"{one.model} {len(one.d)}" for one in CAMERAS]
each_model = pytest.mark.parametrize("one", CAMERAS, ids=MODELS)


def points_seen(count: int = 500) -> np.ndarray:
    """Points before the camera, up to 40 degrees from its axis, 0.1 to 20 m away."""
    random = np.random.default_rng(3)
    angles, turns = np.radians(random.uniform(0, 40, count)), random.uniform(0, 2 * np.pi, count)
    across = np.sin(angles)
    unit = np.stack((across * np.cos(turns), across * np.sin(turns), np.cos(angles)), axis=1)
    return unit * random.uniform(0.1, 20, (count, 1))


def pixels_of_opencv(one: Camera, points: np.ndarray) -> np.ndarray:
    nothing = np.zeros(3)
    if one.model == "equidistant":
        d = one.d if len(one.d) else np.zeros(4)
        pixels, _ = cv2.fisheye.projectPoints(points[:, np.newaxis], nothing, nothing, one.matrix, d)
    else:
        d = one.d if len(one.d) else np.zeros(5)
        pixels, _ = cv2.projectPoints(points, nothing, nothing, one.matrix, d)
    return pixels.reshape(-1, 2)


@each_model
def test_the_pixels_are_those_of_opencv(one: Camera):
    points = points_seen()
    pixels, valid = one.project(points)
    assert valid.all()
    assert np.abs(pixels - pixels_of_opencv(one, points)).max() < CLOSE_PX


@each_model
def test_the_ray_of_each_pixel_leads_back_to_it_and_to_the_point(one: Camera):
    points = points_seen()
    rays = one.ray(one.project(points)[0])
    assert np.abs(rays - points / np.linalg.norm(points, axis=1, keepdims=True)).max() < 1e-9
    columns, rows = np.meshgrid(np.arange(0, WIDTH, 20.0), np.arange(0, HEIGHT, 20.0))
    grid = np.stack((columns.ravel(), rows.ravel()), axis=1)
    again, valid = one.project(one.ray(grid))
    assert valid.all()
    assert np.abs(again - grid).max() < CLOSE_PX


@each_model
def test_rays_are_those_of_opencv(one: Camera):
    pixels = one.project(points_seen())[0]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    if one.model == "equidistant":
        d = one.d if len(one.d) else np.zeros(4)
        flat = cv2.fisheye.undistortPoints(pixels[:, np.newaxis], one.matrix, d, criteria=criteria)
    else:
        d = one.d if len(one.d) else np.zeros(5)
        flat = cv2.undistortPoints(pixels, one.matrix, d, criteria=criteria)
    rays = one.ray(pixels)
    assert np.abs(rays[:, :2] / rays[:, 2:] - flat.reshape(-1, 2)).max() < CLOSE_PX / K[0]


def test_one_pixel_has_one_ray():
    assert np.allclose(camera().ray((K[2], K[3])), (0, 0, 1))
    assert camera().ray((0.0, 0.0)).shape == (3,)


@pytest.mark.parametrize("one", CAMERAS[:4], ids=MODELS[:4])
def test_points_behind_a_pinhole_have_no_pixel(one: Camera):
    points = points_seen(20) * [1, 1, -1]
    pixels, valid = one.project([*points, [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert not valid.any()
    assert np.isnan(pixels).all()


def test_a_fisheye_sees_points_beside_and_behind_itself_but_not_right_behind():
    one = camera("equidistant")
    pixels, valid = one.project([[1.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    assert valid.tolist() == [True, True, False, False]
    right_angle = np.pi / 2
    assert np.allclose(pixels[0], (K[2] + K[0] * right_angle, K[3]))
    assert np.allclose(pixels[1], (K[2], K[3] + K[1] * 1.5 * right_angle))
    assert np.allclose(one.ray(pixels[:2]), [[1, 0, 0], [0, 0.5**0.5, -(0.5**0.5)]])


def test_points_that_are_not_finite_have_no_pixel():
    for one in CAMERAS:
        _, valid = one.project([[np.nan, 0, 1], [0, np.inf, 1], [0, 0, np.inf], [0, 0, 1]])
        assert valid.tolist() == [False, False, False, True]


@pytest.mark.parametrize(
    ("one", "fold"),
    [
        # d/dr (r + k1 r^3) = 1 + 3 k1 r^2 is zero at r^2 = -1 / (3 k1)
        (camera(d=(-0.3, 0, 0, 0)), np.arctan((1 / 0.9) ** 0.5)),
        (camera("rational_polynomial", (-0.3, 0, 0, 0, 0, 0, 0, 0)), np.arctan((1 / 0.9) ** 0.5)),
        (camera("equidistant", (-0.3, 0, 0, 0)), (1 / 0.9) ** 0.5),
        # a pole of q at r^2 = 2
        (camera("rational_polynomial", (0, 0, 0, 0, 0, -0.5, 0, 0)), np.arctan(2**0.5)),
    ],
)
def test_points_beyond_the_fold_of_the_model_have_no_pixel(one: Camera, fold: float):
    for angle, is_seen in ((fold - 1e-4, True), (fold + 1e-4, False), (min(fold + 0.3, 1.5), False)):
        pixels, valid = one.project([[np.sin(angle), 0.0, np.cos(angle)]])
        assert valid.tolist() == [is_seen], angle
        assert np.isnan(pixels).any() == (not is_seen)


def test_pixels_that_no_direction_has_have_no_ray():
    one = camera(d=(-0.3, 0, 0, 0))  # r + k1 r^3 is at most 0.703 (at the fold)
    rays = one.ray([[K[2] + 0.70 * K[0], K[3]], [K[2] + 0.71 * K[0], K[3]], [np.nan, 0.0]])
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False, False]


def test_the_picture_contains_pixels_up_to_half_a_pixel_from_their_centers():
    pixels = [[-0.5, -0.5], [639.4, 479.4], [-0.6, 0.0], [0.0, 479.5], [np.nan, 0.0]]
    assert camera().contains(pixels).tolist() == [True, True, False, False, False]


@given(st.lists(st.floats(-0.4, 0.4), min_size=5, max_size=5), st.floats(-0.7, 0.7), st.floats(-0.7, 0.7))
def test_whatever_the_lens_a_ray_leads_back_to_its_pixel_or_is_none(d: list[float], a: float, b: float):
    one = camera(d=[d[0], d[1], d[2] / 50, d[3] / 50, d[4]])
    pixel = np.array([K[0] * a + K[2], K[1] * b + K[3]])
    ray = one.ray(pixel)
    if np.isfinite(ray).all():
        again, valid = one.project([ray])
        assert valid.all()
        assert np.abs(again - pixel).max() < CLOSE_PX


def test_the_matrix_of_opencv_is_taken_as_well():
    assert camera(k=camera().matrix).k.tolist() == list(K)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"k": (0, 0, 0, 0)}, "calibrate"),
        ({"k": (-1.0, 1.0, 0, 0)}, "focal lengths above 0"),
        ({"k": (np.nan, 1.0, 0, 0)}, "finite"),
        ({"k": (1.0, 2.0, 3.0)}, r"shape \(4,\)"),
        ({"k": [[600, 1, 320], [0, 600, 240], [0, 0, 1]]}, "fx 0 cx"),
        ({"d": (1.0, 2.0)}, "d has 0 or 4 or 5 float64, not 2"),
        ({"d": PLUMB_BOB, "model": "equidistant"}, "d has 0 or 4 float64"),
        ({"d": (1e300, 0, 0, 0)}, "d has numbers up to 1e"),
        ({"model": "fisheye62"}, "plumb_bob, rational_polynomial, equidistant, not 'fisheye62'"),
        ({"width": 0}, "pictures"),
        ({"width": 1.5}, "width of a camera is an integer"),
        ({"width": 70_000}, "65535"),
        ({"line_time_ns": -1}, "line_time_ns=-1"),
        ({"line_time_ns": 10_000_000}, "within a second"),
        ({"r": np.eye(4)}, r"r of a camera has the shape \(3, 3\)"),
    ],
)
def test_what_is_no_calibration_is_refused_with_its_numbers(wrong: dict[str, Any], text: str):
    with pytest.raises(InvalidInput, match=text):
        camera(**wrong)


@each_model
def test_a_camera_is_the_same_after_its_message_and_a_copy(one: Camera):
    sent = camera_from_message(camera_to_message(one, 5), "r1")
    assert sent.frame == "r1/camera"
    for other in (sent, copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
        assert (other.width, other.height, other.model) == (one.width, one.height, one.model)
        assert np.array_equal(other.project(points_seen())[0], one.project(points_seen())[0])


def test_points_and_pixels_of_other_shapes_are_refused():
    with pytest.raises(InvalidInput, match=r"\(N, 3\)"):
        camera().project([1.0, 2.0, 3.0])
    with pytest.raises(InvalidInput, match=r"\(N, 2\)"):
        camera().ray([[1.0, 2.0, 3.0]])
