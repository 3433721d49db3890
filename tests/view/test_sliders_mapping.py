"""Dials: what stands for a joint on the page."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.model.load import load_model
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.se3 import quaternion_from_rpy
from zstate.view.sliders import SliderMapping, SliderSpec

ROBOT = """<robot name="cart">
  <link name="world"/><link name="body"/><link name="deck"/><link name="arm"/><link name="lift"/>
  <link name="wheel"/><link name="claw"/>
  <joint name="float" type="floating"><parent link="world"/><child link="body"/></joint>
  <joint name="drive" type="planar"><parent link="body"/><child link="deck"/><axis xyz="0 0 1"/></joint>
  <joint name="swing" type="revolute"><parent link="deck"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-0.5" upper="1.5" velocity="1" effort="1"/></joint>
  <joint name="rise" type="prismatic"><parent link="arm"/><child link="lift"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.25" velocity="1" effort="1"/></joint>
  <joint name="roll" type="continuous"><parent link="lift"/><child link="wheel"/><axis xyz="1 0 0"/></joint>
  <joint name="grip" type="prismatic"><parent link="lift"/><child link="claw"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.25" velocity="1" effort="1"/><mimic joint="rise" multiplier="2"/></joint>
</robot>"""


@pytest.fixture
def cart() -> RobotModel:
    return parse_urdf(ROBOT, "cart.urdf")


def test_every_driven_joint_has_its_dials_within_its_limits(cart):
    names = [dial.name for dial in SliderMapping(cart).specs]
    floating = [f"float.{part}" for part in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert names == [*floating, "drive.x", "drive.y", "drive.yaw", "swing", "rise", "roll"]
    by_name = {dial.name: dial for dial in SliderMapping(cart).specs}
    assert by_name["swing"] == SliderSpec("swing", "rad", -0.5, 1.5)
    assert by_name["rise"] == SliderSpec("rise", "m", 0.0, 0.25)


def test_what_has_no_limits_moves_a_turn_or_two_metres(cart):
    by_name = {dial.name: dial for dial in SliderMapping(cart).specs}
    assert by_name["roll"] == SliderSpec("roll", "rad", -math.pi, math.pi)
    assert by_name["drive.yaw"] == SliderSpec("drive.yaw", "rad", -math.pi, math.pi)
    assert by_name["drive.x"] == SliderSpec("drive.x", "m", -2.0, 2.0)


def test_positions_are_those_of_the_dials_in_the_order_of_the_model(cart):
    values = np.array([1.0, 2.0, 0.5, 0.1, -0.2, 0.3, -1.0, 0.25, 0.75, 1.25, 0.125, -3.0])
    x, y, z, w = quaternion_from_rpy(0.1, -0.2, 0.3)
    expected = [1.0, 2.0, 0.5, x, y, z, w, -1.0, 0.25, 0.75, 1.25, 0.125, -3.0]
    np.testing.assert_allclose(SliderMapping(cart).positions(values), expected, atol=1e-15)


def test_values_are_the_way_back(cart):
    mapping, generator = SliderMapping(cart), np.random.default_rng(3)
    for _ in range(20):
        values = generator.uniform(mapping.lower, mapping.upper)
        np.testing.assert_allclose(mapping.values(mapping.positions(values)), values, atol=1e-9)


def test_a_robot_that_cannot_move_has_no_dials():
    fixed = parse_urdf('<robot name="rock"><link name="rock"/></robot>', "rock.urdf")
    mapping = SliderMapping(fixed)
    assert mapping.specs == ()
    assert mapping.positions(np.empty(0)).shape == (0,)


@pytest.mark.robots
def test_pandas_dials_are_its_joints():
    panda = load_model("panda")
    assert tuple(dial.name for dial in SliderMapping(panda).specs) == panda.joint_names
