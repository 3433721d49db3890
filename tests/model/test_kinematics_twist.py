"""Twists against slopes, closed forms and plain sense."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np
import pytest
from helpers.matrix_kinematics import matrices
from helpers.model_samples import every_joint, local_model, random_positions

from zstate.model.kinematics import Kinematics
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf


def after(model: RobotModel, positions: np.ndarray, velocities: np.ndarray, seconds: float) -> np.ndarray:
    """Positions a moment later: numbers move by their rates, quaternions turn in the zero frame."""
    moved = positions.copy()
    for joint in model.driven_joints:
        start, rate = model.columns[joint.name], model.velocity_columns[joint.name]
        if joint.type != "floating":
            count = 3 if joint.type == "planar" else 1
            moved[start : start + count] += seconds * velocities[rate : rate + count]
            continue
        moved[start : start + 3] += seconds * velocities[rate : rate + 3]
        turned = seconds * velocities[rate + 3 : rate + 6]
        half = np.linalg.norm(turned) / 2
        dx, dy, dz, dw = *(turned / 2 * np.sinc(half / pi)), cos(half)
        x, y, z, w = positions[start + 3 : start + 7]
        moved[start + 3 : start + 7] = (
            dw * x + dx * w + dy * z - dz * y,
            dw * y + dy * w + dz * x - dx * z,
            dw * z + dz * w + dx * y - dy * x,
            dw * w - dx * x - dy * y - dz * z,
        )
    return moved


def slope(kinematics: Kinematics, link: str, reference: str, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The twist by central difference of ``reference_from_link``."""
    model, step_s = kinematics.model, 1e-6

    def reference_from_link(seconds: float) -> np.ndarray:
        poses = matrices(kinematics.link_poses(after(model, q, v, seconds)))
        return np.linalg.inv(poses[model.links.index(reference)]) @ poses[model.links.index(link)]

    rate = (reference_from_link(step_s) - reference_from_link(-step_s)) / (2 * step_s)
    spin = rate[:3, :3] @ reference_from_link(0.0)[:3, :3].T
    return np.array([*rate[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]])


@pytest.mark.parametrize("reference", ["universe", "sole", "nail"])
def test_a_twist_is_the_slope_of_the_pose(reference: str) -> None:
    kinematics = every_joint()
    model = kinematics.model
    positions = random_positions(model, 2, spread=2.0)
    velocities = np.random.default_rng(3).uniform(-1.0, 1.0, model.velocity_count)
    for link in model.links:
        twist = kinematics.twist(link, positions, velocities, reference)
        expected = slope(kinematics, link, reference, positions, velocities)
        # The difference of two poses a microsecond apart is good for eight digits.
        assert np.allclose(twist, expected, rtol=1e-7, atol=1e-7), link


def test_the_default_reference_of_a_twist_is_the_root() -> None:
    kinematics = every_joint()
    positions = random_positions(kinematics.model, 4)
    velocities = np.arange(1.0, kinematics.model.velocity_count + 1)
    seen = kinematics.twist("nail", positions, velocities)
    assert np.array_equal(seen, kinematics.twist("nail", positions, velocities, "universe"))


def test_the_twist_of_a_swinging_arm_agrees_with_the_textbook() -> None:
    kinematics = local_model("rrbot")
    shoulder, elbow, shoulder_rate, elbow_rate = 0.4, -1.1, 0.7, 0.2
    twist = kinematics.twist("tool", [shoulder, elbow], [shoulder_rate, elbow_rate])
    total, total_rate = shoulder + elbow, shoulder_rate + elbow_rate
    # x = 0.7 sin a + 0.6 sin(a + b), z = 1.05 + 0.7 cos a + 0.6 cos(a + b)
    x_rate = 0.7 * cos(shoulder) * shoulder_rate + 0.6 * cos(total) * total_rate
    z_rate = -0.7 * sin(shoulder) * shoulder_rate - 0.6 * sin(total) * total_rate
    assert np.allclose(twist, [x_rate, 0.0, z_rate, 0.0, total_rate, 0.0], atol=1e-14)


def test_velocities_of_a_floating_joint_are_in_the_axes_of_its_zero_frame() -> None:
    urdf = """<robot name="drone"><link name="map"/><link name="drone"/>
      <joint name="air" type="floating"><parent link="map"/><child link="drone"/></joint></robot>"""
    kinematics = Kinematics(parse_urdf(urdf, "drone"))
    half_turn_about_z = [5.0, 6.0, 7.0, 0.0, 0.0, 1.0, 0.0]
    velocities = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    assert np.allclose(kinematics.twist("drone", half_turn_about_z, velocities), velocities, atol=1e-15)


@pytest.mark.parametrize("link", ["root_joint", "nail"])
def test_twist_of_a_link_in_itself_is_zero(link: str) -> None:
    kinematics = every_joint()
    velocities = np.ones(kinematics.model.velocity_count)
    twist = kinematics.twist(link, random_positions(kinematics.model, 5), velocities, link)
    assert np.allclose(twist, np.zeros(6), atol=1e-14)
