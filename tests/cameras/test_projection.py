"""Points in the pictures of a moving camera, against a search in every row."""

from __future__ import annotations

import numpy as np
import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.cameras import Camera
from zstate.errors import InvalidInput, UnknownFrame
from zstate.transform import Transform

MS = 1_000_000
STAMP = 1_700_000_000_000_000_000
WIDTH, HEIGHT, K = 640, 480, (500.0, 510.0, 320.0, 240.0)
D = (-0.2, 0.05, 1e-3, -5e-4, 0.0)
LINE_NS = 35_000  # 16.8 ms for a picture
CLOSE_PX = 1e-3


def camera(line_time_ns: int = 0) -> Camera:
    return Camera(WIDTH, HEIGHT, K, D, frame="lens", line_time_ns=line_time_ns)


def turned(angle: float, axis: int) -> np.ndarray:
    quaternion = np.zeros(4)
    quaternion[axis], quaternion[3] = np.sin(angle / 2), np.cos(angle / 2)
    return quaternion


@pytest.fixture(scope="module")
def buffer() -> TransformBuffer:
    """A lens that sways with 1 m/s and 1 rad/s, and a hand that moves as well, sampled at 200 Hz."""
    buffer = TransformBuffer(history_s=60.0)
    for number in range(-8, 33):
        t, stamp = 0.005 * number, STAMP + number * 5 * MS
        place = (0.2 * np.sin(5 * t), 0.1 * np.cos(7 * t), 0.5 * t)
        buffer.insert(Transform("world", "lens", place, turned(0.2 * np.sin(5 * t), 0), stamp=stamp))
        hand = (0.3 * np.sin(4 * t), 0.3 * np.cos(3 * t), 3.0)
        buffer.insert(Transform("world", "hand", hand, turned(2 * t, 1), stamp=stamp))
    return buffer


def points() -> np.ndarray:
    random = np.random.default_rng(7)
    return random.uniform((-1.2, -1.0, 2.0), (1.2, 1.0, 5.0), (60, 3))


def row_by_search(buffer: TransformBuffer, one: Camera, point: np.ndarray, frame: str) -> np.ndarray:
    """The pixel of ``point`` in the row where it appears: bisection of the instant, one lookup at a time."""

    def pixel_at(row: float) -> np.ndarray:
        stamp = STAMP + round(row * one.line_time_ns)
        return one.project(buffer.lookup("lens", frame, stamp).apply(point[np.newaxis]))[0][0]

    low, high = 0.0, HEIGHT - 1.0
    for _ in range(60):
        row = (low + high) / 2
        low, high = (row, high) if pixel_at(row)[1] > row else (low, row)
    return pixel_at((low + high) / 2)


@pytest.mark.parametrize("frame", ["world", "hand"])
def test_each_point_appears_in_the_row_of_its_own_instant(buffer: TransformBuffer, frame: str):
    one = camera(LINE_NS)
    placed = points() if frame == "world" else points() - (0.0, 0.0, 3.0)
    pixels, valid = buffer.project(placed, frame, one, STAMP)
    is_shown = valid & one.contains(pixels)
    assert is_shown.sum() > 10
    expected = np.array([row_by_search(buffer, one, point, frame) for point in placed[is_shown]])
    assert np.abs(pixels[is_shown] - expected).max() < CLOSE_PX
    rigid, _ = buffer.project(placed, frame, camera(), STAMP)
    assert np.abs(pixels - rigid)[is_shown].max() > 2.0  # what a global shutter would be wrong by


def test_all_points_of_a_global_shutter_have_one_instant(buffer: TransformBuffer):
    pixels, valid = buffer.project(points(), "world", camera(), STAMP)
    at_once = buffer.lookup("lens", "world", STAMP).apply(points())
    expected, is_seen = camera().project(at_once)
    assert valid.tolist() == is_seen.tolist()
    assert np.allclose(pixels[valid], expected[valid], atol=1e-9)


def test_points_beside_the_picture_have_the_instant_of_the_nearest_row(buffer: TransformBuffer):
    one = camera(LINE_NS)
    for v, row in ((-300.0, 0), (900.0, HEIGHT - 1)):
        stamp = STAMP + row * LINE_NS
        in_lens = 2.0 * one.ray((K[2], v))
        point = buffer.lookup("world", "lens", stamp).apply(in_lens[np.newaxis])
        pixels, valid = buffer.project(point, "world", one, STAMP)
        assert valid.all()
        assert np.allclose(pixels, [[K[2], v]], atol=CLOSE_PX)


def test_points_behind_the_camera_and_instants_without_a_transform_are_not_valid(buffer: TransformBuffer):
    behind = points() * (1, 1, -1)
    for which, stamp in ((behind, STAMP), (points(), STAMP + 10**12), (points() * np.nan, STAMP)):
        pixels, valid = buffer.project(which, "world", camera(LINE_NS), stamp)
        assert not valid.any()
        assert np.isnan(pixels).all()


@pytest.mark.parametrize("rows_in_one", [-2.0, -0.5, 0.5, 2.0])
def test_a_point_is_found_also_if_it_moves_faster_than_the_rows_are_read(rows_in_one: float):
    buffer = TransformBuffer(history_s=60.0)
    for number in range(-20, 40):
        turn = rows_in_one * number * MS / LINE_NS / K[1]
        buffer.insert(Transform("world", "lens", (0, 0, 0), turned(turn, 0), stamp=STAMP + number * MS))
    in_lens = 2.0 * camera().ray((300.0, 200.0))
    point = buffer.lookup("world", "lens", STAMP + 200 * LINE_NS).apply(in_lens[np.newaxis])
    pixels, valid = buffer.project(point, "world", camera(LINE_NS), STAMP)
    assert valid.all()
    assert np.allclose(pixels, [[300.0, 200.0]], atol=CLOSE_PX)


class Torn:
    """A camera in whose first rows a point is in the last one, and vice versa."""

    frame, height, line_time_ns = "lens", HEIGHT, LINE_NS

    def project(self, placed: np.ndarray, /) -> tuple[np.ndarray, np.ndarray]:
        is_early = placed[:, 2] < 2.0 + HEIGHT / 2 * LINE_NS * 1e-9
        v = np.where(is_early, HEIGHT - 1.0, 0.0)
        return np.stack((v, v), axis=1), np.ones(len(placed), np.bool_)


def test_a_point_without_a_row_of_its_own_is_not_valid():
    buffer = TransformBuffer(history_s=60.0)
    for seconds in (0, 1):
        moved = Transform("lens", "world", (0, 0, seconds), (0, 0, 0, 1), stamp=STAMP + seconds * 1000 * MS)
        buffer.insert(moved)
    pixels, valid = buffer.project([[0.0, 0.0, 2.0]], "world", Torn(), STAMP)
    assert valid.tolist() == [False]
    assert np.isnan(pixels).all()


def test_float32_points_are_as_exact_as_float64(buffer: TransformBuffer):
    short = points().astype(np.float32)
    pixels = buffer.project(short, "world", camera(LINE_NS), STAMP)[0]
    again = buffer.project(short.astype(float), "world", camera(LINE_NS), STAMP)[0]
    assert np.array_equal(pixels, again, equal_nan=True)


def test_no_points_have_no_pixels(buffer: TransformBuffer):
    pixels, valid = buffer.project(np.empty((0, 3)), "world", camera(LINE_NS), STAMP)
    assert (pixels.shape, valid.shape) == ((0, 2), (0,))


def test_unknown_frames_and_wrong_stamps_raise_as_those_of_place(buffer: TransformBuffer):
    with pytest.raises(UnknownFrame):
        buffer.project(points(), "nowhere", camera(), STAMP)
    with pytest.raises(InvalidInput):
        buffer.project(points(), "world", camera(), 1.5)
