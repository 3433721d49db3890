from __future__ import annotations

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import (
    Spawn,
    failure,
    interrupted,
    missing_library,
    published_robot,
    run_cli,
    started,
)
from helpers.pictures import jpeg, video_file
from helpers.processes import DEADLINE_S, repeated, until

from zstate import StaticPublisher, Transform, TransformListener, connect
from zstate.cameras import Camera, CameraListener, CameraPublisher
from zstate.cameras.cli.mesh_files import MeshFiles
from zstate.model.geometry import MeshFile
from zstate.net.presence import announce, local_writer
from zstate.wire.keys import WRITER_TOKEN

CALIBRATION = """\
image_width: {width}
image_height: 48
camera_matrix: {{rows: 3, cols: 3, data: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
"""

LENS = Camera(64, 48, (60.0, 60.0, 31.5, 23.5), frame="lens")
SECOND = 1_000_000_000


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


def test_no_source_and_two_of_them_are_wrong_usage(tmp_path: Path):
    video = video_file(tmp_path / "walk.avi", count=1)
    for arguments in ((), (video, "--device", "/dev/video0"), (video, "--simulate")):
        text = failure("camera", "r1", *arguments, code=2)
        assert "give --device /dev/videoN, a video FILE or --simulate, one of them" in text
    for option, sources in (
        (("--rate", "5"), "--simulate or --device"),
        (("--world-frame", "map"), "--simulate"),
        (("--size", "64", "48"), "--device"),
    ):
        assert f"{option[0]} is for {sources}" in failure("camera", "r1", video, *option, code=2)
    assert "--loop is for FILE" in failure("camera", "r1", "--simulate", "--loop", code=2)


@pytest.mark.processes
def test_a_simulated_camera_sees_the_robot_at_its_instants(spawn: Spawn):
    """The lens is in the tool, which looks along the arm; pictures have stamps of its joints."""
    with published_robot("rrbot"):
        child = started(spawn, "camera", "rrbot", "--simulate", "--frame", "tool", "--rate", "20")
        line = "rrbot: 640 x 480, simulated, in tool, 20 Hz, on zstate/rrbot/image/camera"
        assert child.line() == line
        assert "simulating a camera in tool; the floor stands in rrbot/world" in child.stderr
        with (
            connect() as session,
            TransformListener(session, "rrbot") as listener,
            CameraListener(session, "rrbot") as pictures,
        ):
            picture = next(one for one in pictures if one.camera is not None)
            listener.buffer.wait("rrbot/world", "rrbot/tool", picture.stamp, timeout_s=DEADLINE_S)
            assert picture.frame == "rrbot/tool"
            assert picture.size == (640, 480)
            assert picture.camera.k.tolist() == [500.0, 500.0, 319.5, 239.5]
            assert picture.decode().std() > 0.0
        interrupted(child)


@pytest.mark.processes
def test_a_simulated_camera_has_the_calibration_of_a_file_and_waits_for_its_frame(tmp_path: Path):
    options = ("--simulate", "--name", "wrist", "--info", calibration(tmp_path))
    with published_robot("rrbot"):
        shown = run_cli("camera", "rrbot", *options, "--frame", "tool", "--seconds", "0.5").stdout
        assert "rrbot: 64 x 48, simulated, in tool, 10 Hz, on zstate/rrbot/image/wrist" in shown
        text = failure("camera", "rrbot", *options, "--seconds", "0.5")
        assert "no picture in 0.5 s" in text
        assert "'rrbot/wrist'" in text


def test_a_simulated_camera_waits_for_the_model_of_a_robot_that_describes_itself():
    """Without it, the link from which another program's static edge hangs would be taken for the root."""
    token = WRITER_TOKEN.key("rrbot", "robot_description", local_writer(1, "driver").identity)
    lens = Transform.from_pose7("camera_link", "lens", [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    with connect() as session, StaticPublisher(session, "rrbot") as edges, announce(session, token):
        edges.set(lens)
        text = failure("camera", "rrbot", "--simulate", "--frame", "lens", "--seconds", "2")
    assert "'rrbot' is announced with robot_description, but no sample arrives" in text


@pytest.mark.parametrize("is_own", [False, True])
def test_doctor_names_a_camera_whose_pictures_are_stamped_by_a_clock_of_its_own(is_own: bool):
    """A driver that is not synchronised stamps by the time since the camera was switched on."""
    switched_on = time.time_ns() - 1000 * SECOND if is_own else 0
    picture = jpeg()
    with (
        connect() as session,
        CameraPublisher(session, "r1", "wrist", LENS) as publisher,
        repeated(lambda: publisher.publish(picture, time.time_ns() - switched_on), every_s=0.05),
    ):
        ended = run_cli("doctor", "r1", "--json")
    (found,) = [one for one in json.loads(ended.stdout)["checks"] if one["name"] == "stamps"]
    if is_own:
        assert found["state"] == "broken"
        assert re.search(r"image 'wrist' of .* stamps samples .* before the time here", found["text"])
        assert "the time since it was switched on" in found["text"]
    else:
        assert found["state"] == "ok", found


def test_meshes_that_are_not_found_are_named_once(capsys: pytest.CaptureFixture[str]):
    files = MeshFiles()
    for _ in range(2):
        assert files.read(MeshFile("package://nowhere/part.stl")) == ()
    assert capsys.readouterr().err.count("not drawn: package://nowhere/part.stl: ") == 1
    with missing_library("zstate.view.meshes"):
        assert MeshFiles().read(MeshFile("package://nowhere/part.stl")) == ()
    assert "pip install 'zstate[view]'" in capsys.readouterr().err


def test_a_mirrored_mesh_keeps_its_faces_outwards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "part"
    package.mkdir()
    (package / "package.xml").write_text("<package><name>part</name></package>")
    (package / "box.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    for scale in ((1.0, 1.0, 1.0), (2.0, -1.0, 1.0)):
        (part,) = MeshFiles().read(MeshFile("package://part/box.obj", scale))
        a, b, c = np.moveaxis(np.asarray(part.points)[np.asarray(part.triangles)], 1, 0)
        volume = (np.cross(b, c) * a).sum() / 6.0
        assert volume == pytest.approx(abs(np.prod(scale)) / 6.0)


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
