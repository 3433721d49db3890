"""Calibrations in YAML, as camera_calibration writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from zstate.cameras import load_camera
from zstate.errors import InvalidInput

TEXT = """\
image_width: 640
image_height: 480
camera_name: wrist
camera_matrix:
  rows: 3
  cols: 3
  data: [612.5, 0., 321.5, 0., 598.25, 238.75, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.25, 0.1, 0.001, -0.002, 0.]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [600., 0., 320., 0., 0., 600., 240., 0., 0., 0., 1., 0.]
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "wrist.yaml"
    path.write_text(text)
    return path


def test_a_file_of_camera_calibration_is_read(tmp_path: Path):
    camera = load_camera(written(tmp_path, TEXT), "lens", line_time_ns=30_000)
    assert (camera.width, camera.height, camera.model, camera.frame) == (640, 480, "plumb_bob", "lens")
    assert camera.k.tolist() == [612.5, 598.25, 321.5, 238.75]
    assert camera.d.tolist() == [-0.25, 0.1, 0.001, -0.002, 0.0]
    assert camera.line_time_ns == 30_000
    assert np.array_equal(camera.r, np.eye(3))
    assert camera.p.shape == (3, 4)


def test_numbers_that_only_a_stereo_camera_has_may_be_missing(tmp_path: Path):
    camera = load_camera(written(tmp_path, TEXT.partition("rectification_matrix")[0]))
    assert camera.r is camera.p is None


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("image_width: 640\n", "", "image_width missing"),
        ("distortion_model: plumb_bob", "distortion_model: fisheye62", "not 'fisheye62'"),
        ("image_height: 480", "image_height: tall", "height of a camera is an integer"),
        ("data: [612.5, 0., ", "data: [612.5, ", "camera_matrix has 9 numbers, not 8"),
        ("data: [612.5, 0., ", "data: [612.5, 1., ", "fx 0 cx"),
        ("data: [612.5, 0., ", "data: [wide, 0., ", "k must be"),
        ("  data: [-0.25, 0.1, 0.001, -0.002, 0.]\n", "", "distortion_coefficients has a list 'data'"),
        ("image_width: 640", "image_width: [640", "is no YAML"),
        (TEXT, "- 1\n", "has no entries"),
        (TEXT, "[" * 9000, "more than 8192 bytes"),
        (TEXT, "\x00", "is no YAML"),
    ],
)
def test_what_is_no_calibration_is_refused_with_its_file(tmp_path: Path, old: str, new: str, text: str):
    path = written(tmp_path, TEXT.replace(old, new))
    with pytest.raises(InvalidInput, match=text) as caught:
        load_camera(path)
    assert str(caught.value).startswith(str(path))


def test_a_file_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(InvalidInput, match=r"none\.yaml cannot be read"):
        load_camera(tmp_path / "none.yaml")
