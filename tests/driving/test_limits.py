"""Limits: what the URDF states, what a user may add or lower, and what is refused with joint and value."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from zstate.driving.limits import Limits, unused_ranges
from zstate.errors import InvalidInput
from zstate.model.load import load_model
from zstate.model.robot import RobotModel

JOINTS = {
    "shoulder": ("revolute", '<limit lower="-1" upper="2" velocity="3" effort="4"/>'),
    "wheel": ("continuous", ""),
    "lift": ("prismatic", '<limit lower="0" upper="0.5" velocity="0.2" effort="4"/>'),
    "slow": ("revolute", '<limit lower="-1" upper="1" velocity="0" effort="4"/>'),
    "base": ("floating", ""),
    "thumb": ("revolute", '<limit lower="-1" upper="2" velocity="3" effort="4"/><mimic joint="shoulder"/>'),
}


def robot(*names: str):
    """A chain of these joints."""
    links = "".join(f'<link name="l{number}"/>' for number in range(len(names) + 1))
    chain = "".join(
        f'<joint name="{name}" type="{JOINTS[name][0]}"><parent link="l{number}"/>'
        f'<child link="l{number + 1}"/><axis xyz="0 0 1"/>{JOINTS[name][1]}</joint>'
        for number, name in enumerate(names)
    )
    return load_model(f'<robot name="arm">{links}{chain}</robot>')


ARM = robot("shoulder", "wheel", "lift", "base", "thumb")


def one(lower: float = -1.0, upper: float = 2.0, velocity: float = 1.0, acceleration: float = 4.0) -> Limits:
    return Limits(
        ("elbow",), np.array([lower]), np.array([upper]), np.array([velocity]), np.array([acceleration])
    )


def test_limits_are_those_of_the_urdf_for_all_joints_with_one_position():
    limits = Limits.of(ARM, acceleration=8.0)
    assert limits.joint_names == ("shoulder", "wheel", "lift")
    assert limits.lower.tolist() == [-1.0, -math.inf, 0.0]
    assert limits.upper.tolist() == [2.0, math.inf, 0.5]
    assert limits.velocity.tolist() == [3.0, math.inf, 0.2]
    assert limits.acceleration.tolist() == [8.0, 8.0, 8.0]
    assert limits.units == ("rad", "rad", "m")


def test_limits_of_some_joints_have_their_order():
    limits = Limits.of(ARM, ["lift", "shoulder"])
    assert limits.joint_names == ("lift", "shoulder")
    assert limits.upper.tolist() == [0.5, 2.0]


def test_a_part_of_limits_has_the_order_of_its_joints():
    whole = Limits(("a", "b", "c"), [1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12], ("m", "rad", "rad"))
    part = whole.part(["c", "a"])
    assert (part.joint_names, part.units) == (("c", "a"), ("rad", "m"))
    bounds = np.array([part.lower, part.upper, part.velocity, part.acceleration])
    assert bounds.tolist() == [[3, 1], [6, 4], [9, 7], [12, 10]]
    with pytest.raises(InvalidInput, match="no limits of 'd', 'e', 'f' and 2 more"):
        whole.part(["d", "e", "f", "g", "h"])
    with pytest.raises(InvalidInput, match="no limits of 'd'"):
        whole.part(["a", "d"])


def test_velocities_are_lowered_and_accelerations_given_by_joint():
    limits = Limits.of(ARM, velocity={"shoulder": 1.0, "wheel": 20.0}, acceleration={"lift": 0.5})
    assert limits.velocity.tolist() == [1.0, 20.0, 0.2]
    assert limits.acceleration.tolist() == [5.0, 100.0, 0.5]


def test_a_joint_without_a_limit_of_its_acceleration_brakes_from_its_velocity_limit_in_a_fifth_of_a_second():
    assert Limits.of(ARM).acceleration.tolist() == pytest.approx([3.0 / 0.2, math.inf, 0.2 / 0.2])
    assert Limits.of(ARM, velocity={"wheel": 4.0}).acceleration[1] == pytest.approx(20.0)
    assert Limits.of(ARM, acceleration=math.inf).acceleration.tolist() == [math.inf] * 3


def driven(limit: str, follower: str = "", *, inside: str = "", after: str = "") -> RobotModel:
    """A robot whose joint "a" has ``limit``; "b" follows it, if there is a ``follower``."""
    links = '<link name="l0"/><link name="l1"/><link name="l2"/>'
    joint = (
        '<joint name="{}" type="revolute"><parent link="l0"/><child link="l{}"/><axis xyz="0 0 1"/>{}</joint>'
    )
    kind = follower or '<limit lower="0" upper="0" velocity="1" effort="1"/>'
    chain = joint.format("a", 1, f"<limit {limit}/>{inside}") + joint.format("b", 2, kind)
    return load_model(f'<robot name="arm">{links}{chain}{after}</robot>')


@pytest.mark.parametrize(
    ("mimic", "lower", "upper", "velocity", "effort"),
    [
        ('multiplier="3"', -1 / 3, 0.5 / 3, 4 / 3, 6.0),
        ('multiplier="-3"', -0.5 / 3, 1 / 3, 4 / 3, 6.0),
        ('multiplier="2" offset="0.4"', -0.7, 0.05, 2.0, 4.0),
        ('multiplier="0.1"', -2.0, 2.0, 5.0, 0.2),
        ('multiplier="0" offset="9"', -2.0, 2.0, 5.0, 7.0),
    ],
)
def test_a_leading_joint_keeps_the_limits_of_its_followers(
    mimic: str, lower: float, upper: float, velocity: float, effort: float
):
    limit = '<limit lower="-1" upper="0.5" velocity="4" effort="2"/>'
    model = driven('lower="-2" upper="2" velocity="5" effort="7"', f'{limit}<mimic joint="a" {mimic}/>')
    limits = Limits.of(model)
    found = [limits.lower[0], limits.upper[0], limits.velocity[0], limits.effort[0]]
    assert found == pytest.approx([lower, upper, velocity, effort])
    if velocity < 5.0:
        with pytest.raises(InvalidInput, match="velocity 5 of 'a' is above"):
            Limits.of(model, velocity=5.0)


def test_a_range_of_a_follower_that_leaves_no_position_is_not_used_and_said_so():
    # As in the URDF of the PR2: the follower has the range of its leader, and turns the other way.
    limit = 'lower="0" upper="0.5" velocity="5" effort="7"'
    model = driven(limit, f'<limit {limit}/><mimic joint="a" multiplier="-1"/>')
    assert (Limits.of(model).lower[0], Limits.of(model).upper[0]) == (0.0, 0.5)
    assert unused_ranges(model, ["a"]) == (
        "'a' is limited to 0 to 0.5, and not by 'b', which follows it: that would be -0.5 to -0",
    )
    assert not unused_ranges(driven(limit), ["a"])


@pytest.mark.parametrize(("lower", "upper", "is_said"), [(0.0, 0.5, False), (-1.0, 0.0, True)])
def test_a_joint_of_one_position_keeps_it_whatever_range_its_follower_has(
    lower: float, upper: float, is_said: bool
):
    follower = f'<limit lower="{lower}" upper="{upper}" velocity="5" effort="7"/><mimic joint="a"/>'
    model = driven('lower="0.25" upper="0.25" velocity="5" effort="7"', follower)
    assert (Limits.of(model).lower[0], Limits.of(model).upper[0]) == (0.25, 0.25)
    text = "'a' is limited to 0.25 to 0.25, and not by 'b', which follows it: that would be -1 to 0"
    assert unused_ranges(model, ["a"]) == (text,) * is_said


def interface(kind: str, **parameters: object) -> str:
    numbers = "".join(f'<param name="{name}"> {value} </param>' for name, value in parameters.items())
    return f'<command_interface name="{kind}">{numbers}</command_interface>'


def test_soft_limits_and_those_of_ros2_control_are_kept():
    limit = 'lower="-2" upper="2" velocity="5" effort="7"'
    soft = '<safety_controller soft_lower_limit="-1.5" soft_upper_limit="3" k_velocity="10"/>'
    model = driven(limit, inside=soft)
    assert (Limits.of(model).lower[0], Limits.of(model).upper[0]) == (-1.5, 2.0)
    interfaces = (
        interface("position", min=-3, max=1.25)
        + interface("velocity", min=-1.5, max=1.5)
        + interface("effort", max=4)
        + interface("acceleration", min=-2.5, max=2)
    )
    system = '<ros2_control name="s" type="system"><joint name="a">{}{}</joint></ros2_control>'
    limits = Limits.of(driven(limit, inside=soft, after=system.format(interfaces, "")), ["a"])
    assert (limits.lower[0], limits.upper[0]) == (-1.5, 1.25)
    assert (limits.velocity[0], limits.effort[0], limits.acceleration[0]) == (1.5, 4.0, 2.0)
    disabled = Limits.of(driven(limit, after=system.format(interfaces, '<limits enable="false"/>')), ["a"])
    assert (disabled.upper[0], disabled.velocity[0]) == (2.0, 5.0)


@pytest.mark.parametrize(
    ("element", "text"),
    [
        (interface("position", min="${low}"), "min: '${low}' is a xacro expression, not a number"),
        (interface("position", min=1, max=-1), "positions from 1 to -1"),
        (interface("velocity", min=0, max=1), "a velocity from 0 to 1"),
        (interface("velocity", min=0.5, max=1), "a velocity from 0.5 to 1"),
    ],
)
def test_a_limit_of_commands_that_cannot_be_read_is_a_finding(element: str, text: str):
    limit = 'lower="-2" upper="2" velocity="5" effort="7"'
    after = f'<ros2_control name="s" type="system"><joint name="a">{element}</joint></ros2_control>'
    model = driven(limit, after=after)
    assert (Limits.of(model).lower[0], Limits.of(model).velocity[0]) == (-2.0, 5.0)
    (finding,) = model.findings
    assert finding.message == (
        f"joint 'a': its <command_interface> has {text}, which does not limit its commands"
    )


def test_efforts_are_those_of_the_urdf_or_lower_by_joint():
    limits = Limits.of(ARM, effort={"shoulder": 1.5, "wheel": 3.0})
    assert limits.effort.tolist() == [1.5, 3.0, 4.0]
    assert limits.part(["lift", "shoulder"]).effort.tolist() == [4.0, 1.5]
    assert one().effort.tolist() == [math.inf]
    with pytest.raises(InvalidInput, match="effort 5 of 'lift' is above 4, the limit in the URDF"):
        Limits.of(ARM, effort=5.0)


def test_a_velocity_of_zero_in_the_urdf_can_be_replaced_and_is_refused_otherwise():
    assert Limits.of(robot("slow"), velocity=0.7).velocity.tolist() == [0.7]
    with pytest.raises(InvalidInput, match="the URDF limits the velocity of 'slow' to 0"):
        Limits.of(robot("slow"))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            {"velocity": 3.5},
            "velocity 3.5 of 'shoulder' is above 3, the limit in the URDF; velocity 3.5 of 'l",
        ),
        ({"velocity": {"lift": 0.3}}, "velocity 0.3 of 'lift' is above 0.2, the limit in the URDF"),
        ({"velocity": {"lift": 0.0}}, "the velocity limit of 'lift' is 0.0; it must be a number above zero"),
        ({"velocity": math.nan}, "the velocity limit is nan; it must be a number above zero"),
        ({"acceleration": -8.0}, "the acceleration limit is -8.0; it must be a number above zero"),
        ({"acceleration": {"lift": [1.0, 2.0]}}, r"the acceleration limit of 'lift' is \[1.0, 2.0\]"),
        (
            {"acceleration": {"lft": 8.0}},
            "acceleration limits of unknown joints: 'lft'; did you mean 'lift'?",
        ),
        ({"joints": ["sholder"]}, "unknown joint 'sholder'; did you mean 'shoulder'?"),
        ({"joints": ["base"]}, "'base' is floating; only joints with one position have limits"),
        ({"joints": ["thumb"]}, "'thumb' follows 'shoulder' and is not driven itself"),
        ({"joints": ["lift", "lift"]}, "joints given twice: 'lift'"),
        ({"joints": []}, r"joint names are a sequence of names, at least one; got \[\]"),
        ({"joints": "lift"}, "joint names are a sequence of names, at least one; got 'lift'"),
    ],
)
def test_unusable_limits_are_refused_with_joint_and_value(arguments, text):
    with pytest.raises(InvalidInput, match=text):
        Limits.of(ARM, **arguments)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"lower": 3.0}, "positions of 'elbow' reach from 3 to 2"),
        ({"upper": math.nan}, "positions of 'elbow' reach from -1 to nan"),
        ({"velocity": 0.0}, "the velocity limit of 'elbow' is 0; it must be above zero"),
        ({"acceleration": math.nan}, "the acceleration limit of 'elbow' is nan; it must be above zero"),
    ],
)
def test_the_constructor_refuses_nan_zero_and_reversed_limits(values, text):
    with pytest.raises(InvalidInput, match=text):
        one(**values)


@pytest.mark.parametrize("effort", [-5.0, math.nan])
def test_the_constructor_refuses_efforts_that_are_negative_or_nan(effort: float):
    one_joint = np.ones(1)
    with pytest.raises(
        InvalidInput, match=f"effort limit of 'elbow' is {effort:g}; it must not be below zero"
    ):
        Limits(("elbow",), -one_joint, one_joint, one_joint, one_joint, effort=np.array([effort]))


def test_the_constructor_refuses_other_counts_and_units():
    two = np.ones(2)
    with pytest.raises(InvalidInput, match=r"lower limits of 1 joints have shape \(1,\); got \(2,\)"):
        Limits(("elbow",), two, two, two, two)
    with pytest.raises(
        InvalidInput, match=r"units are 'rad' or 'm' for each of \('a', 'b'\); got \('deg',\)"
    ):
        Limits(("a", "b"), two, two, two, two, ("deg",))


def test_limits_are_read_only_copies():
    upper = np.array([2.0])
    limits = Limits(("elbow",), np.array([-1.0]), upper, np.ones(1), np.ones(1))
    upper[0] = 5.0
    assert limits.upper.tolist() == [2.0]
    with pytest.raises(ValueError, match="read-only"):
        limits.upper[0] = 5.0


def test_positions_within_the_limits_are_accepted_as_a_vector():
    assert Limits.of(ARM).check_positions([2.0, -1e6, 0]).tolist() == [2.0, -1e6, 0.0]


@pytest.mark.parametrize("position", [1.1e9, -1e307, 9e307, 1.7e308])
def test_a_position_beyond_1e9_is_refused_also_for_a_joint_without_limits(position: float):
    text = re.escape(f"'wheel' at {position:.9g} rad is outside -1e+09 to 1e+09")
    with pytest.raises(InvalidInput, match=text):
        Limits.of(ARM).check_positions([0.0, position, 0.0])


@pytest.mark.parametrize(
    ("positions", "text"),
    [
        ([2.001, 0.0, 0.0], "'shoulder' at 2.001 rad is outside -1 to 2$"),
        ([-1.5, 0.0, 0.7], "'shoulder' at -1.5 rad is outside -1 to 2; 'lift' at 0.7 m is outside 0 to 0.5"),
        ([90.0, 0.0, 0.0], "'shoulder' at 90 rad .* this looks like degrees: convert with math.radians"),
        ([math.nan, 0.0, math.inf], r"positions must be finite; not so: 'shoulder' \(nan\), 'lift' \(inf\)"),
        ([0.0], r"positions of 3 joints have shape \(3,\), in the order shoulder, wheel, lift; got \(1,\)"),
    ],
)
def test_positions_outside_the_limits_are_refused_with_values_and_limits(positions, text):
    with pytest.raises(InvalidInput, match=text):
        Limits.of(ARM).check_positions(positions)


def test_limits_containing_positions_extend_to_those_outside_only():
    limits = Limits.of(ARM).containing([2.1, 7.0, -0.1])
    assert limits.upper.tolist() == [2.1, math.inf, 0.5]
    assert limits.lower.tolist() == [-1.0, -math.inf, -0.1]
    assert limits.units == ("rad", "rad", "m")
