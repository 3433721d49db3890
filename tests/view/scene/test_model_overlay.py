"""ModelOverlay: the lines of a robot over a picture, where it was at the stamp of the picture."""

from __future__ import annotations

import io

import numpy as np
import pytest

pytest.importorskip("viser")

from helpers.pictures import jpeg
from helpers.processes import until
from PIL import Image

from zstate.buffer.buffer import TransformBuffer
from zstate.cameras import Camera
from zstate.model.geometry import read_shapes
from zstate.model.urdf import parse_urdf
from zstate.transform import Transform
from zstate.view.pictures import Packet, StillPicture
from zstate.view.scene.model_overlay import ModelOverlay, seen_rows, split
from zstate.view.scene.robot_meshes import RobotKind

S = 1_000_000_000
BOX = """<robot name="box"><link name="base"><visual>
    <geometry><box size="0.4 0.4 0.4"/></geometry></visual></link></robot>"""
KIND = RobotKind(read_shapes(parse_urdf(BOX, "box.urdf"))[0], None)
UNTURNED = (0.0, 0.0, 0.0, 1.0)
CAMERA = Camera(320, 240, (200.0, 200.0, 159.5, 119.5), frame="lens")
DATA = jpeg(320, 240)


def picture_at(stamp: int, frame: str = "lens", data: bytes = DATA) -> StillPicture:
    return StillPicture(Packet(stamp, frame, "jpeg", data, (1, 0)), "jpeg", data, (320, 240))


@pytest.fixture
def overlay() -> ModelOverlay:
    overlay = ModelOverlay()
    overlay.load({"box": KIND})
    until(lambda: all(edges.is_loaded for edges in overlay._edges.values()))
    return overlay


@pytest.fixture
def buffer() -> TransformBuffer:
    """A box 2 m in front of the lens, which moves to the right by 0.1 m a second for 3 s."""
    buffer = TransformBuffer(60.0)
    for second in range(4):
        pose = (0.1 * second, 0.0, 2.0)
        buffer.insert(Transform("lens", "box/base", pose, UNTURNED, stamp=second * S))
    return buffer


def green(picture: StillPicture) -> np.ndarray:
    """Where the picture has lines: u v (N, 2)."""
    pixels = np.asarray(Image.open(io.BytesIO(picture.data))).astype(int)
    rows, columns = np.nonzero((pixels[..., 1] > 180) & (pixels[..., 0] < 130))
    return np.stack([columns, rows], axis=1)


@pytest.mark.parametrize("second", [0, 1.5, 3])
def test_lines_are_where_the_robot_was_at_the_stamp_of_the_picture(overlay, buffer, second):
    picture, problem = overlay.drawn_over(picture_at(round(second * S)), CAMERA, buffer)
    assert problem is None
    drawn = green(picture)
    # Corners at x +- 0.2 m, y +- 0.2 m and z = 1.8 m; on the left maybe those at z = 2.2 m.
    left, right = 0.1 * second - 0.2, 0.1 * second + 0.2
    lowest = [159.5 + 200 * min(left / 1.8, left / 2.2), 119.5 - 200 * 0.2 / 1.8]
    highest = [159.5 + 200 * right / 1.8, 119.5 + 200 * 0.2 / 1.8]
    assert drawn.min(axis=0) == pytest.approx(lowest, abs=2.5)
    assert drawn.max(axis=0) == pytest.approx(highest, abs=2.5)


def test_near_side_has_lines_around_it_and_none_within(overlay, buffer):
    picture, _ = overlay.drawn_over(picture_at(0), CAMERA, buffer)
    distances = np.abs(green(picture) - (159.5, 119.5)).max(axis=1)
    assert distances.min() > 200 * 0.2 / 1.8 - 3


@pytest.mark.parametrize(("depth", "is_hidden"), [(3.0, True), (1.5, False)])
def test_lines_of_a_link_are_hidden_by_a_link_in_front_of_it(depth: float, is_hidden: bool):
    """A small box on the axis of the lens, 1 m behind a large one, or in front of it."""
    model = BOX.replace(
        "</robot>",
        """<link name="small"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
        <joint name="j" type="floating"><parent link="base"/><child link="small"/></joint></robot>""",
    )
    overlay = ModelOverlay()
    overlay.load({"box": RobotKind(read_shapes(parse_urdf(model, "boxes.urdf"))[0], None)})
    until(lambda: all(edges.is_loaded for edges in overlay._edges.values()))
    buffer = TransformBuffer(60.0)
    buffer.insert_static(Transform("lens", "box/base", (0.0, 0.0, 2.0), UNTURNED))
    buffer.insert_static(Transform("lens", "box/small", (0.0, 0.0, depth), UNTURNED))
    picture, problem = overlay.drawn_over(picture_at(0), CAMERA, buffer)
    assert problem is None
    distances = np.abs(green(picture) - (159.5, 119.5)).max(axis=1)
    # The edges of the near face of the large box are 200 * 0.2 / 1.8 = 22 px from the middle.
    assert (distances.min() > 200 * 0.2 / 1.8 - 3) == is_hidden


def test_picture_without_poses_at_its_stamp_is_left_as_it_is_with_the_reason(overlay, buffer):
    picture = picture_at(5 * S)
    same, problem = overlay.drawn_over(picture, CAMERA, buffer)
    assert same is picture
    assert problem is not None
    assert "box/base" in problem


def test_robot_that_is_not_connected_to_the_camera_is_left_out(overlay, buffer):
    buffer.insert_static(Transform("hall", "other", (0.0, 0.0, 0.0), UNTURNED))
    camera = Camera(320, 240, CAMERA.k, frame="other")
    picture = picture_at(S, frame="other")
    assert overlay.drawn_over(picture, camera, buffer) == (picture, "no robot is in it")
    assert overlay.newest(camera, buffer, S) == S


def test_broken_picture_is_left_as_it_is_with_the_reason(overlay, buffer):
    picture = picture_at(S, data=b"\xff\xd8\xff broken")
    same, problem = overlay.drawn_over(picture, CAMERA, buffer)
    assert same is picture
    assert problem is not None
    assert problem.startswith("it cannot be decoded")


def test_robot_behind_the_camera_is_not_drawn(overlay):
    buffer = TransformBuffer()
    buffer.insert_static(Transform("lens", "box/base", (0.0, 0.0, -2.0), UNTURNED))
    picture = picture_at(S)
    assert overlay.drawn_over(picture, CAMERA, buffer) == (picture, "no robot is in it")


def test_picture_waits_for_the_poses_of_its_rows_but_not_for_a_silent_robot(overlay, buffer):
    rolling = Camera(320, 240, CAMERA.k, frame="lens", line_time_ns=1_000_000)
    assert overlay.newest(CAMERA, buffer, 2 * S) == 2 * S
    assert overlay.newest(CAMERA, buffer, 3 * S + 5) == 3 * S
    assert overlay.newest(rolling, buffer, 3 * S) == 3 * S - 240_000_000
    assert overlay.newest(CAMERA, buffer, 5 * S) == 5 * S


def test_rows_of_a_rolling_shutter_have_instants_of_their_own(overlay, buffer):
    # 4 ms a row: the bottom is taken 22 / 120 s later than the middle, and is further to the right.
    rolling = Camera(320, 240, CAMERA.k, frame="lens", line_time_ns=4_000_000)
    drawn = green(overlay.drawn_over(picture_at(0), rolling, buffer)[0])
    top, bottom = (drawn[np.abs(drawn[:, 1] - row) < 3, 0].mean() for row in (119.5 - 22.2, 119.5 + 22.2))
    assert bottom - top == pytest.approx(44.4 * 0.004 * 0.1 * 200 / 1.8, abs=1.0)


def segments_seen(camera: Camera, *ends: tuple[float, float, float]) -> np.ndarray:
    lines = split(np.array([ends]))
    pixels, valid = camera.project(lines.reshape(-1, 3))
    return pixels.reshape(-1, 2, 2)[seen_rows(pixels, valid, camera)]


def test_long_line_is_bent_as_the_lens_bends_it():
    camera = Camera(320, 240, (200.0, 200.0, 159.5, 119.5), (-0.3, 0.05, 0.0, 0.0))
    segments = segments_seen(camera, (-0.5, 0.5, 1.0), (0.5, 0.5, 1.0))
    middle, ends = camera.project([[0.0, 0.5, 1.0], [-0.5, 0.5, 1.0]])[0][:, 1]
    assert middle - ends > 5.0  # pixels
    rows = segments[..., 1]
    assert rows.max() == pytest.approx(middle)
    assert rows.min() == pytest.approx(ends)


def test_line_from_behind_the_camera_is_drawn_as_far_as_it_is_seen():
    segments = segments_seen(CAMERA, (0.1, 0.0, -1.0), (0.1, 0.0, 3.0))
    assert len(segments) > 0
    assert np.isfinite(segments).all()
