from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, failure, interrupted, missing_library, run_cli, started
from helpers.pictures import video_file
from helpers.processes import until

from zstate import connect
from zstate.cameras import CameraListener

CALIBRATION = """\
image_width: {width}
image_height: 48
camera_matrix: {{rows: 3, cols: 3, data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
"""


def calibration(folder: Path, width: int = 64) -> str:
    path = folder / "wrist.yaml"
    path.write_text(CALIBRATION.format(width=width))
    return str(path)


@pytest.mark.processes
def test_a_video_is_published_with_its_calibration_and_echo_shows_it(spawn: Spawn, tmp_path: Path):
    video = video_file(tmp_path / "walk.avi", count=20)
    options = ("--info", calibration(tmp_path), "--name", "wrist", "--frame", "lens", "--loop")
    child = started(spawn, "camera", "r1", video, *options)
    assert child.line() == f"r1: 64 x 48 of {video}, JPEG as it comes, in lens, on zstate/r1/image/wrist"
    with connect() as session, CameraListener(session, "r1") as listener:
        until(lambda: listener.latest and listener.latest.camera)
        assert listener.latest.frame == listener.latest.camera.frame == "r1/lens"
    shown = json.loads(run_cli("echo", "r1", "--stream", "image", "--once", "--json").stdout)
    assert (shown["format"], shown["width"], shown["height"], shown["frame"]) == ("jpeg", 64, 48, "r1/lens")
    assert "data" not in shown
    shown = json.loads(run_cli("echo", "r1", "--stream", "camera_info", "--once", "--json").stdout)
    assert (shown["width"], shown["fx"], shown["model"]) == (64, 60.0, "plumb_bob")
    assert "image/wrist" in run_cli("ls").stdout
    interrupted(child)


def test_a_video_ends_with_its_file_and_its_pictures_are_counted(tmp_path: Path):
    ended = run_cli("camera", "r1", video_file(tmp_path / "walk.mp4", count=3, codec="libx264"))
    assert ended.code == 0
    assert "h264, encoded as JPEG, in camera, on zstate/r1/image/camera" in ended.stdout.replace("\n", " ")
    assert "3 pictures published" in ended.stderr


def test_seconds_end_a_loop(tmp_path: Path):
    ended = run_cli("camera", "r1", video_file(tmp_path / "walk.avi", count=1), "--loop", "--seconds", "0.3")
    assert ended.code == 0
    assert re.search(r"\d pictures published", ended.stderr)


def test_a_file_and_a_device_or_neither_are_wrong_usage(tmp_path: Path):
    video = video_file(tmp_path / "walk.avi", count=1)
    for arguments in ((), (video, "--device", "/dev/video0")):
        assert "--device /dev/videoN or a video FILE" in failure("camera", "r1", *arguments, code=2)


def test_a_wrong_device_and_a_wrong_file_are_named(tmp_path: Path):
    assert "there is no /dev/video99" in failure("camera", "r1", "--device", "/dev/video99")
    path = calibration(tmp_path)
    assert "cannot be opened as a video" in failure("camera", "r1", path)


def test_a_calibration_of_another_size_is_refused_at_the_start(tmp_path: Path):
    video = video_file(tmp_path / "walk.avi", count=1)
    text = failure("camera", "r1", video, "--info", calibration(tmp_path, width=640))
    assert "64 x 48" in text
    assert "640 x 48" in text


def test_without_pyav_the_command_names_the_extra(tmp_path: Path):
    video = video_file(tmp_path / "walk.avi", count=1)
    with missing_library("av"):
        assert "pip install 'zstate[cameras]'" in failure("camera", "r1", video)
