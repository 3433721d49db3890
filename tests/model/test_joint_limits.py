"""Joint limits: which positions are outside, and when degrees are suspected."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.model.joint_limits import JointLimits
from zstate.model.load import load_model


def limits_of(*joints: str) -> JointLimits:
    """Of a chain of joints, each as ``type lower upper``."""
    links = [f'<link name="l{number}"/>' for number in range(len(joints) + 1)]
    edges: list[str] = []
    for number, joint in enumerate(joints):
        kind, lower, upper = joint.split()
        limit = f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>' * (kind != "continuous")
        edges.append(
            f'<joint name="j{number}" type="{kind}"><parent link="l{number}"/><child link="l{number + 1}"/>'
            f'<axis xyz="0 0 1"/>{limit}</joint>'
        )
    return JointLimits(load_model(f'<robot name="r">{"".join((*links, *edges))}</robot>'))


ARM = ("revolute -2 2", "revolute -3 1", "prismatic 0 0.5")


@pytest.mark.parametrize(
    ("positions", "explanation"),
    [
        ((0.0, 0.0, 0.0), ""),
        ((2.0, -3.0, 0.5), ""),
        ((2.0009, -3.0009, 0.5009), ""),  # by less than a thousandth: an encoder at its stop
        ((2.0011, 0.0, 0.0), "'j0' at 2.0011 rad is outside -2 to 2"),
        ((0.0, 1.5, 0.0), "'j1' at 1.5 rad is outside -3 to 1"),
        ((0.0, 0.0, -0.25), "'j2' at -0.25 m is outside 0 to 0.5"),
        ((3.5, 0.0, 0.7), "'j0' at 3.5 rad is outside -2 to 2, 'j2' at 0.7 m is outside 0 to 0.5"),
    ],
)
def test_a_joint_beyond_its_limits_is_named_with_its_value_and_unit(
    positions: tuple[float, ...], explanation: str
):
    rows = np.array([positions])
    limits = limits_of(*ARM)
    assert limits.explanation(rows) == explanation
    assert limits.are_exceeded(rows).tolist() == [bool(explanation)]


def test_each_joint_is_named_once_with_its_worst_value_of_all_samples():
    rows = np.array([[2.5, 0.0, 0.0], [0.0, 1.2, 0.0], [-4.0, 0.0, 0.1]])
    limits = limits_of(*ARM)
    assert limits.are_exceeded(rows).tolist() == [True, True, True]
    assert limits.explanation(rows) == (
        "'j0' at -4.0 rad is outside -2 to 2, 'j1' at 1.2 rad is outside -3 to 1"
    )


def test_an_angle_that_fits_once_converted_looks_like_degrees():
    assert limits_of(*ARM).explanation(np.array([[45.0, -90.0, 0.0]])) == (
        "'j0' at 45.0 rad is outside -2 to 2, 'j1' at -90.0 rad is outside -3 to 1; "
        "this looks like degrees: convert with math.radians"
    )


@pytest.mark.parametrize("angle", [3.5, math.tau, math.degrees(2.1)])
def test_an_angle_within_a_turn_or_too_large_even_in_degrees_is_only_outside(angle: float):
    text = limits_of(*ARM).explanation(np.array([[angle, 0.0, 0.0]]))
    assert text.startswith("'j0' at ")
    assert "degrees" not in text


def test_millimetres_of_a_prismatic_joint_are_not_reported_as_degrees():
    assert limits_of(*ARM).explanation(np.array([[0.0, 0.0, 20.0]])) == "'j2' at 20.0 m is outside 0 to 0.5"


def test_many_joints_are_counted_rather_than_listed():
    text = limits_of(*["revolute -1 1"] * 6).explanation(np.full((1, 6), 1.5))
    assert text.startswith("'j0' at 1.5 rad is outside -1 to 1, 'j1' at")
    assert text.endswith("'j2' at 1.5 rad is outside -1 to 1, 3 more joints are outside theirs")


def test_continuous_joints_have_no_limits():
    limits = limits_of("continuous 0 0", "continuous 0 0", "revolute -1 1")
    rows = np.array([[4000.0, -4000.0, 0.5]])
    assert limits.explanation(rows) == ""
    assert not limits.are_exceeded(rows).any()


def test_equal_limits_count_as_none():
    assert not limits_of("continuous 0 0", "revolute 0 0")
    assert limits_of("revolute 0 0", "prismatic 0 1")


def test_nan_is_not_outside_the_limits():
    rows = np.array([[math.nan, 0.0, 0.0], [math.nan, 1.5, 0.0]])
    assert limits_of(*ARM).explanation(rows) == "'j1' at 1.5 rad is outside -3 to 1"
