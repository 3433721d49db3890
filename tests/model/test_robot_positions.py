"""Positions by the names of joints, and what is no posture of the robot."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.model_samples import every_joint

from zstate.errors import InvalidInput
from zstate.model.load import load_model
from zstate.model.robot import near_joint

JOINTS = ("pan", "lift", "elbow", "wrist_1_joint", "wrist_2_joint", "finger_left", "finger_right")


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("lift_joint", "lift"),
        ("joint_lift", "lift"),
        ("shoulder_lift", "lift"),
        ("Lift", "lift"),
        ("elbov", "elbow"),
        ("wrist_1", "wrist_1_joint"),
        ("joint", None),
        ("some_joint", None),
        ("finger", "finger_left"),
        ("knee", None),
        (5, None),
    ],
)
def test_the_most_similar_joint_is_found(name, meant: str | None) -> None:
    assert near_joint(name, JOINTS) == meant


def test_an_unknown_joint_is_reported_with_the_most_similar_missing_one() -> None:
    model = load_model("rrbot")
    first, second = model.joint_names
    with pytest.raises(InvalidInput) as caught:
        model.positions({f"{first}_joint": 0.0, second: 0.0})
    assert f"unknown joint '{first}_joint'; did you mean {first!r}?; missing: {first!r}" in str(caught.value)


@pytest.mark.parametrize("length", [0.0, 1e-200, 0.9989, 1.0011, 2.0])
def test_a_floating_joint_without_a_unit_quaternion_is_refused_by_every_method(length: float) -> None:
    model = every_joint().model
    name = next(joint.name for joint in model.driven_joints if joint.type == "floating")
    values = dict.fromkeys(model.joint_names, 0.0)
    values |= {joint.name: [0.0] * 3 for joint in model.driven_joints if joint.type == "planar"}
    values[name] = [0.0] * 6 + [1.0]
    positions = model.positions(values)
    values[name] = [0.0] * 6 + [length]
    with pytest.raises(InvalidInput, match=f"'{name}' of .* quaternion of length {length:g}"):
        model.positions(values)
    positions[model.columns[name] + 6] = length
    with pytest.raises(InvalidInput, match="quaternion"):
        model.check_positions(positions)


def test_a_quaternion_within_a_thousandth_of_unit_length_is_unchanged() -> None:
    model = every_joint().model
    positions = np.array(model.neutral)
    column = next(model.columns[joint.name] for joint in model.driven_joints if joint.type == "floating")
    positions[column + 6] = 1.0009
    assert model.check_positions(positions).tolist() == positions.tolist()
