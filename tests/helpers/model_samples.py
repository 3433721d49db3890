"""Robots for kinematics: one with every type of joint, and the models of this repository."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zstate.model.kinematics import Kinematics
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf

EVERY_JOINT = """<robot name="every joint">
  <link name="universe"/> <link name="root_joint"/> <link name="a &lt;b&gt; &quot;c&quot;"/>
  <link name="sole"/> <link name="knee"/> <link name="shin"/> <link name="heel"/> <link name="toe"/>
  <link name="nail"/>
  <joint name="zz body" type="floating"><parent link="universe"/><child link="root_joint"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/></joint>
  <joint name="toe" type="revolute"><parent link="knee"/><child link="toe"/>
    <origin xyz="0.2 0 -0.1" rpy="1 0.2 0"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/>
    <mimic joint="nail" multiplier="0.5" offset="0.1"/></joint>
  <joint name="nail" type="continuous"><parent link="toe"/><child link="nail"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 0 1"/><mimic joint="shin" multiplier="-1.5" offset="0.2"/></joint>
  <joint name="universe" type="revolute"><parent link="root_joint"/><child link="a &lt;b&gt; &quot;c&quot;"/>
    <origin xyz="0 0.3 0" rpy="0 0 1.2"/><axis xyz="0.6 0 -0.8"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
  <joint name="sole" type="planar"><parent link="root_joint"/><child link="sole"/>
    <origin xyz="0 0 -1" rpy="0.3 0.2 0.1"/><axis xyz="0 0 1"/></joint>
  <joint name="knee" type="continuous"><parent link="sole"/><child link="knee"/>
    <origin xyz="0 0.1 0" rpy="0 1 0"/><axis xyz="0 1 0"/></joint>
  <joint name="shin" type="prismatic"><parent link="knee"/><child link="shin"/>
    <origin xyz="0.5 0 0" rpy="0 0 0.7"/><axis xyz="0 0.8 0.6"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
  <joint name="heel" type="fixed"><parent link="shin"/><child link="heel"/>
    <origin xyz="0 0 0.25" rpy="0.1 0.2 0.3"/></joint>
</robot>"""


def every_joint() -> Kinematics:
    return Kinematics(parse_urdf(EVERY_JOINT, "every_joint.urdf"))


def local_model(name: str) -> Kinematics:
    path = Path(__file__).parents[2] / "models" / f"{name}.urdf"
    return Kinematics(parse_urdf(path.read_text(), path.name))


def random_positions(model: RobotModel, seed: int, spread: float = 20.0) -> np.ndarray:
    """Random positions over several turns, with unit quaternions for floating joints."""
    positions = np.random.default_rng(seed).uniform(-spread, spread, model.position_count)
    for start in floating_columns(model):
        positions[start + 3 : start + 7] /= np.linalg.norm(positions[start + 3 : start + 7])
    return positions


def floating_columns(model: RobotModel) -> Iterator[int]:
    return (model.columns[joint.name] for joint in model.driven_joints if joint.type == "floating")


SIX_ROBOTS = {
    "double_pendulum_continuous",  # continuous joints only
    "iris_simple",  # fixed joints only
    "panda",  # revolute and prismatic joints, a mimic
    "pr2",  # continuous joints, a prismatic one, ten mimics
    "talos_full_v2",  # a humanoid with grippers of mimics
    "tiago_dual",  # 129 joints
}
"""Robots of example-robot-data with each type of joint that it has; all others are in the soak."""


def six_of(robots: Iterable[Any], name_of: Callable[[Any], str] = str) -> list[Any]:
    """``robots`` as parameters of a test, all but SIX_ROBOTS marked as soak."""
    return [
        pytest.param(one, id=name_of(one), marks=() if name_of(one) in SIX_ROBOTS else pytest.mark.soak)
        for one in robots
    ]
