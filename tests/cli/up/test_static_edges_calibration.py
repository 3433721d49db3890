from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.cli_runner import Spawn, failure, started

from zstate.cli.up.static_edges import read_calibration, with_frames
from zstate.errors import ConfigError

PARAMETERS = (
    "robot_base_frame: base\n  robot_effector_frame: tool0\n"
    "  tracking_base_frame: camera\n  tracking_marker_frame: marker\n"
)
TURN_ABOUT_Z = (0.0, 0.0, 0.6, 0.8)
HANDEYE = (
    f"parameters:\n  eye_on_hand: %s\n  {PARAMETERS}"
    "transformation:\n  qw: 0.8\n  qx: 0\n  qy: 0.0\n  qz: 0.6\n  x: 0.1\n  y: 0.2\n  z: -0.3\n"
)
HANDEYE_2 = (
    f"parameters:\n  name: cell\n  calibration_type: %s\n  {PARAMETERS}"
    "transform:\n  translation: {x: 0.1, y: 0.2, z: -0.3}\n  rotation: {x: 0, y: 0, z: 0.6, w: 0.8}\n"
)
ROS = (
    "transforms:\n- header:\n    stamp: {sec: 1, nanosec: 2}\n    frame_id: tool0\n  child_frame_id: camera\n"
    "  transform:\n    translation: {x: 0.1, y: 0.2, z: -0.3}\n    rotation: {x: 0, y: 0, z: 0.6, w: 0.8}\n"
    "---\n"
)
POSE = {"xyz": [0.1, 0.2, -0.3], "quat_xyzw": TURN_ABOUT_Z}
OURS = json.dumps({"target": "tool0", "source": "camera", **POSE})


def file_of(folder: Path, text: str, name: str = "eye.yaml") -> Path:
    file = folder / name
    file.write_text(text)
    return file


@pytest.mark.parametrize(
    ("text", "target"),
    [
        (HANDEYE % "true", "tool0"),
        (HANDEYE % "false", "base"),
        (HANDEYE_2 % "eye_in_hand", "tool0"),
        (HANDEYE_2 % "eye_on_base", "base"),
        (ROS, "tool0"),
        (OURS, "tool0"),
    ],
    ids=["in hand", "on base", "in hand 2", "on base 2", "ros", "ours"],
)
def test_calibration_has_the_pose_of_the_camera(tmp_path: Path, text: str, target: str):
    (edge,) = read_calibration(file_of(tmp_path, text))
    assert (edge.target, edge.source) == (target, "camera")
    assert edge.pose7 == pytest.approx((0.1, 0.2, -0.3, *TURN_ABOUT_Z))


def test_json_is_read_as_well_and_may_contain_several(tmp_path: Path):
    edges = read_calibration(file_of(tmp_path, f"[{OURS}, {OURS}]", "eyes.json"))
    assert len(edges) == 2


def test_frames_can_be_renamed(tmp_path: Path):
    (edge,) = read_calibration(file_of(tmp_path, OURS, "eye.json"))
    other = with_frames(edge, None, "eye")
    assert (other.target, other.source, other.pose7) == ("tool0", "eye", pytest.approx(edge.pose7))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no transform"),
        ("just words", "holds no transform"),
        ("a: [1\n", "is not YAML"),
        ("gain: 2\n", "'gain' is unknown; a calibration is what easy_handeye"),
        ((HANDEYE % "true").replace("qw", "w"), "has no 'qw'"),
        ((HANDEYE % "true").replace("0.8", "fast"), "could not convert"),
        ((HANDEYE % "true").replace("qw: 0.8", "qw: 0"), "quaternion"),
        ("transforms: []\n", "has no transform"),
        ("transform: 3\nparameters: 4\n", "cannot be read"),
        ("target: a\nsource: b\nxyz: [1, 2]\n", "takes a translation x y z"),
    ],
)
def test_a_file_without_one_is_refused_with_the_missing_key(tmp_path: Path, text: str, message: str):
    with pytest.raises(ConfigError, match=r"eye\.yaml") as refusal:
        read_calibration(file_of(tmp_path, text))
    assert message in str(refusal.value)


@pytest.mark.processes
def test_calibration_is_published_with_renamed_frames(spawn: Spawn, tmp_path: Path):
    file = file_of(tmp_path, HANDEYE % "true")
    child = started(spawn, "static", "flange", "eye", "--file", str(file), "--robot", "arm")
    assert child.line().startswith("pose of eye in flange: xyz [0.1, 0.2, -0.3] m")


def test_static_reports_an_invalid_file(tmp_path: Path):
    several = file_of(tmp_path, f"[{OURS}, {OURS}]", "eyes.json")
    assert "has 2 transforms" in failure("static", "a", "b", "--file", str(several), code=2)
    assert "--set needs a .toml file" in failure("static", "--file", str(several), "--set", "a=1", code=2)
