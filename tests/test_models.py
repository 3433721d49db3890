"""The robots in models/ agree with their closed forms.

Every arm here moves in a plane, so its poses follow from sines and cosines alone. ``python -m
tests.test_models`` writes the golden files from these closed forms; zstate's kinematics has no part in it.
"""

import json
from collections.abc import Callable
from math import cos, pi, sin, sqrt
from pathlib import Path

import numpy as np
import pytest

from zstate.model.kinematics import Kinematics
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf

MODELS = Path(__file__).parent.parent / "models"
Poses = dict[str, list[float]]
TOLERANCE = 1e-12


def pitched(x: float, y: float, z: float, angle: float) -> list[float]:
    """A pose turned about y, which takes z towards x."""
    return [x, y, z, 0.0, sin(angle / 2), 0.0, cos(angle / 2)]


def rrbot(shoulder: float, elbow: float) -> Poses:
    total = shoulder + elbow
    elbow_x, elbow_z = 0.7 * sin(shoulder), 1.05 + 0.7 * cos(shoulder)

    def on_lower(along: float, across: float) -> tuple[float, float]:
        x = elbow_x + along * sin(total) + across * cos(total)
        return x, elbow_z + along * cos(total) - across * sin(total)

    tool_x, tool_z = on_lower(0.6, 0.0)
    camera_x, camera_z = on_lower(0.5, 0.05)
    laser_x, laser_z = on_lower(0.4, -0.05)
    return {
        "world": pitched(0, 0, 0, 0),
        "base": pitched(0, 0, 0, 0),
        "upper": pitched(0, 0.1, 1.05, shoulder),
        "lower": pitched(elbow_x, 0.17, elbow_z, total),
        "tool": pitched(tool_x, 0.17, tool_z, total),
        "camera_link": pitched(camera_x, 0.17, camera_z, total - pi / 2),
        # A half turn about z after a turn about y: (0 s 0 c)(0 0 1 0) = (s 0 c 0).
        "laser_link": [laser_x, 0.19, laser_z, sin(total / 2), 0.0, cos(total / 2), 0.0],
    }


def diffbot(left: float, right: float) -> Poses:
    def wheel(y: float, angle: float) -> list[float]:
        # The axle is turned by -90 degrees about x: (-h 0 0 h)(0 0 s c) = h (-c s s c), h = sqrt(1/2).
        s, c = sin(angle / 2) / sqrt(2), cos(angle / 2) / sqrt(2)
        return [0.0, y, 0.08, -c, s, s, c]

    return {
        "base_footprint": pitched(0, 0, 0, 0),
        "base_link": pitched(0, 0, 0.08, 0),
        "left_wheel": wheel(0.16, left),
        "right_wheel": wheel(-0.16, right),
        "caster": pitched(-0.18, 0, 0.03, 0),
        "imu_link": pitched(-0.02, 0.03, 0.175, 0),
        "lidar_link": [0.1, 0.0, 0.195, 0.0, 0.0, 1.0, 0.0],
    }


def gripper(finger: float, thumb: float) -> Poses:
    middle = 0.8 * thumb + 0.2
    tip = 0.5 * middle + 0.05
    base_x, base_z = -0.035, 0.06
    middle_x, middle_z = base_x + 0.04 * sin(thumb), base_z + 0.04 * cos(thumb)
    tip_x, tip_z = middle_x + 0.03 * sin(thumb + middle), middle_z + 0.03 * cos(thumb + middle)
    return {
        "mount": pitched(0, 0, 0, 0),
        "palm": pitched(0, 0, 0.01, 0),
        "left_finger": pitched(0, 0.002 + finger, 0.07, 0),
        "right_finger": pitched(0, -0.002 - finger, 0.07, 0),
        "thumb_base": pitched(base_x, 0, base_z, thumb),
        "thumb_middle": pitched(middle_x, 0, middle_z, thumb + middle),
        "thumb_tip": pitched(tip_x, 0, tip_z, thumb + middle + tip),
        "grasp_point": pitched(0, 0, 0.12, 0),
    }


CLOSED_FORMS: dict[str, tuple[Callable[..., Poses], list[dict[str, float]]]] = {
    "rrbot": (
        rrbot,
        [
            {"shoulder": 0.0, "elbow": 0.0},
            {"shoulder": 0.7, "elbow": -1.9},
            {"shoulder": -2.6, "elbow": 3.0},
            {"shoulder": 40.0, "elbow": -25.0},
        ],
    ),
    "diffbot": (
        diffbot,
        [
            {"left_wheel_joint": 0.0, "right_wheel_joint": 0.0},
            {"left_wheel_joint": 1.2, "right_wheel_joint": -0.4},
            {"left_wheel_joint": 1234.5, "right_wheel_joint": 1200.25},
        ],
    ),
    "gripper": (
        gripper,
        [
            {"finger_joint": 0.0, "thumb_joint": 0.0},
            {"finger_joint": 0.045, "thumb_joint": 1.2},
            {"finger_joint": 0.0125, "thumb_joint": 0.55},
        ],
    ),
}


def golden_of(name: str) -> list[dict[str, dict[str, float] | Poses]]:
    closed_form, cases = CLOSED_FORMS[name]
    return [{"positions": case, "root_from_link": closed_form(*case.values())} for case in cases]


def own_model(name: str) -> RobotModel:
    return parse_urdf((MODELS / f"{name}.urdf").read_text(), f"{name}.urdf")


def same_pose(pose: np.ndarray, expected: np.ndarray) -> bool:
    sign = np.sign(pose[3:] @ expected[3:])
    return np.allclose(pose, np.r_[expected[:3], sign * expected[3:]], rtol=0.0, atol=TOLERANCE)


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_the_golden_file_holds_the_closed_form(name: str) -> None:
    stored = json.loads((MODELS / f"{name}.golden.json").read_text())
    for case, expected in zip(stored["cases"], golden_of(name), strict=True):
        assert case["positions"] == expected["positions"]
        assert case["root_from_link"].keys() == expected["root_from_link"].keys()
        for link, pose in expected["root_from_link"].items():
            assert np.allclose(case["root_from_link"][link], pose, rtol=0.0, atol=TOLERANCE), link


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_our_kinematics_gives_the_golden_poses(name: str) -> None:
    model = own_model(name)
    kinematics = Kinematics(model)
    for case in json.loads((MODELS / f"{name}.golden.json").read_text())["cases"]:
        poses = kinematics.link_poses(model.positions(case["positions"]))
        assert set(model.links) == case["root_from_link"].keys()
        for link, pose in zip(model.links, poses, strict=True):
            assert same_pose(pose, np.array(case["root_from_link"][link])), link


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_our_models_are_valid_without_a_warning_and_driven_as_the_golden_file_says(name: str) -> None:
    model = own_model(name)
    assert model.findings == ()
    assert model.name == name
    assert list(model.joint_names) == list(CLOSED_FORMS[name][1][0])
    assert all(np.isfinite(joint.limits.velocity) for joint in model.driven_joints)


def test_the_wheels_of_the_base_touch_the_floor() -> None:
    poses = diffbot(0.3, 0.4)
    wheel_radius, caster_radius = 0.08, 0.03
    assert poses["left_wheel"][2] == poses["right_wheel"][2] == wheel_radius
    assert poses["caster"][2] == caster_radius


def _golden_text(name: str) -> str:
    """One link per line, so that a changed pose is one changed line."""
    cases = [
        f'{{"positions": {json.dumps(case["positions"])}, "root_from_link": {{\n'
        + ",\n".join(f'  "{link}": {json.dumps(pose)}' for link, pose in case["root_from_link"].items())
        + "\n}}"
        for case in golden_of(name)
    ]
    head = {
        "model": f"{name}.urdf",
        "derived_by": "the closed form in tests/test_models.py: python -m tests.test_models",
        "pose": "x y z [m], qx qy qz qw; the sign of a quaternion is arbitrary",
    }
    return json.dumps(head)[:-1] + ',\n"cases": [\n' + ",\n".join(cases) + "\n]}\n"


if __name__ == "__main__":
    for model_name in CLOSED_FORMS:
        (MODELS / f"{model_name}.golden.json").write_text(_golden_text(model_name))
