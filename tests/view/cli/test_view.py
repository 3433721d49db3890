"""zstate view, as it is typed."""

from __future__ import annotations

import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runner import (
    RRBOT,
    failure,
    found_pose,
    interrupted,
    missing_library,
    published_robot,
    run_until,
    started,
)

from zstate import StatePublisher, Transform, TransformListener, TransformPublisher, connect, load_model
from zstate.web_access import listen


def address(line: str) -> str:
    found = re.fullmatch(r"the view is at (http://\S+)", line)
    assert found, line
    return found[1]


@pytest.mark.processes
def test_view_prints_the_address_to_open(spawn):
    child = started(spawn, "view", "--port", "0")
    url = address(child.line())
    assert url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(url) as answer:
        assert b"<html" in answer.read()
    interrupted(child)
    assert child.stderr == ""


def test_without_a_port_it_takes_the_first_free_one_and_a_taken_one_is_an_error():
    from zstate.view.server import PORT

    with listen("127.0.0.1", None, PORT) as first:
        port = first.getsockname()[1]
        assert f"port {port} is taken at '127.0.0.1'" in failure("view", "--port", str(port))
        ended, _ = run_until(lambda: True, "view")
    found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/?", address(ended.stdout.splitlines()[0]))
    assert found
    assert int(found[1]) != port


def test_view_beyond_loopback_has_a_token_in_its_address_and_a_warning():
    ended, _ = run_until(lambda: True, "view", "--host", "0.0.0.0", "--port", "0", after="unencrypted")
    assert re.search(r":\d+/\?token=[\w-]{20,}$", address(ended.stdout.splitlines()[0]))


def test_robot_moved_by_sliders_is_published():
    with connect() as session, TransformListener(session) as listener:
        _, pose = run_until(
            lambda: found_pose(listener, "base", "tool"), "view", RRBOT, "--sliders", "--port", "0"
        )
    assert (pose.target, pose.kind) == ("base", "exact")


def test_sliders_do_not_move_a_robot_with_another_writer_and_name_it():
    with published_robot():
        ended, _ = run_until(lambda: True, "view", "rrbot", "--sliders", "--port", "0")
    assert "'rrbot' is not moved: " in ended.stderr
    assert "joint_states of 'rrbot'" in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--snapshot", "picture.jpg"], 2, "'picture.jpg' does not end with .png"),
        (["a.mcap", "b.mcap"], 2, "a recording must be the only argument; got a.mcap, b.mcap"),
        (["a.mcap", "--sliders"], 2, "--sliders and --placer are for live robots"),
        (["nowhere.mcap"], 1, "nowhere.mcap"),
        (["--rate", "0"], 2, "a rate is above 0"),
        (["--host", "nowhere.invalid"], 1, "cannot listen at 'nowhere.invalid'"),
        (["rrbott", "--sliders"], 1, "did you mean 'rrbot'"),
        (["--port", "99999"], 2, "99999"),
        (["--camera", "1,2"], 2, "'1,2' is not three numbers with commas between"),
        (["--camera", "1,2,nan"], 2, "'1,2,nan' is not three numbers"),
        (["--camera", "-1,2,3:-1,2,3"], 2, "a camera at -1,2,3 cannot look at the same point"),
    ],
)
def test_wrong_arguments_are_reported_on_one_line(arguments: list[str], code: int, text: str):
    assert text in failure("view", *arguments, code=code)


def test_missing_viser_error_names_the_package_to_install():
    with missing_library("viser"):
        assert "pip install 'zstate[view]'" in failure("view")


@pytest.mark.processes
@pytest.mark.browser
def test_a_snapshot_is_a_picture_of_the_robot(tmp_path: Path):
    image = pytest.importorskip("PIL.Image")
    picture = tmp_path / "rrbot.png"
    with published_robot():
        command = [sys.executable, "-m", "zstate", "view", "rrbot", "--snapshot", str(picture)]
        command += ["--size", "320", "240"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=100.0, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == f"wrote {picture}: rrbot, 320 x 240 pixels\n"
    pixels = np.asarray(image.open(picture))
    assert pixels.shape == (240, 320, 3)
    middle = pixels[80:160, 120:200]
    assert (middle.min(axis=2) < 200).mean() > 0.02


@pytest.mark.processes
@pytest.mark.browser
def test_snapshot_of_a_robot_without_a_model_shows_its_frames(tmp_path: Path):
    picture = tmp_path / "cam.png"
    cup = Transform("room", "cup", (0.3, 0.2, 0.4), (0.0, 0.0, 0.0, 1.0))
    with connect() as session, TransformPublisher(session, "cam", "tracker") as tracker:
        tracker.publish([cup])
        command = [sys.executable, "-m", "zstate", "view", "cam", "--snapshot", str(picture)]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=100.0, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == f"wrote {picture}: cam, 1280 x 800 pixels\n"


MINE = """<robot name="mine"><link name="base"><visual><geometry>
<mesh filename="package://mine/meshes/base.stl"/></geometry></visual></link></robot>"""


@pytest.mark.processes
@pytest.mark.browser
def test_snapshot_names_visible_robots_hidden_robots_and_missing_meshes(tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    urdf = tmp_path / "mine" / "urdf" / "mine.urdf"
    mesh = tmp_path / "mine" / "meshes" / "base.stl"
    for file in (urdf, mesh):
        file.parent.mkdir(parents=True)
    urdf.write_text(MINE)
    trimesh.creation.box().export(mesh)
    picture = tmp_path / "picture.png"

    def snapshot(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "zstate", "view", *arguments, "--snapshot", str(picture)]
        command += ["--size", "320", "240"]
        ended = subprocess.run(
            command, capture_output=True, text=True, timeout=100.0, check=False, cwd=urdf.parents[1]
        )
        assert ended.returncode == 0, ended.stderr
        return ended

    with connect() as session, StatePublisher(session, load_model(urdf)) as mine, published_robot():
        mine.publish([])
        both = snapshot()
        assert both.stdout == f"wrote {picture}: mine, rrbot, 320 x 240 pixels\n"
        assert "the frames are in 2 trees (mine/base; rrbot/world)" in both.stderr
        assert "1 mesh file cannot be drawn: package://mine/meshes/base.stl" in both.stderr
        assert "ROS_PACKAGE_PATH" in both.stderr
        one = snapshot("--fixed-frame", "mine/base", "--camera", "0,0,9:0,0,10")
        assert one.stdout == f"wrote {picture}: no robot, 320 x 240 pixels\n"
        assert "'rrbot' is not in the picture: it is outside the camera's view" in one.stderr
        # The file is named by a relative path, and its package is found around it.
        own = snapshot("urdf/mine.urdf")
        assert own.stdout == f"wrote {picture}: mine, 320 x 240 pixels\n"
        assert own.stderr == ""


@pytest.mark.usefixtures("impatient")
def test_snapshot_of_an_absent_robot_names_the_received_ones(tmp_path: Path):
    text = failure("view", "absent", "--snapshot", str(tmp_path / "x.png"))
    assert "waited 0.5 s for 'absent'; robots that were received: none" in text
