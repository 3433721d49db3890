"""Bounds of interpolated poses, against motions that keep the velocity limits of their joints."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.robots import SECOND, STAMP, UPRIGHT

from zstate import Transform, TransformBuffer, load_model
from zstate.buffer.interpolation_bound import InterpolationBound
from zstate.model.kinematics import Kinematics
from zstate.model.robot import RobotModel

PERIOD_NS = SECOND // 5


def random_motion(model: RobotModel, seed: int, ticks: int) -> np.ndarray:
    """Positions at each tenth of a period, as fast as the limits allow, forwards and backwards at random."""
    random = np.random.default_rng(seed)
    speeds = np.array([joint.limits.velocity for joint in model.driven_joints])
    steps = speeds * (PERIOD_NS / 10 * 1e-9) * random.choice((-1.0, 0.3, 1.0), (ticks, len(speeds)))
    return np.cumsum(steps, axis=0)


@pytest.mark.parametrize("name", ["gripper", pytest.param("panda", marks=pytest.mark.robots)])
@pytest.mark.parametrize("seed", range(5))
def test_no_motion_within_the_limits_is_farther_from_an_interpolated_pose(name: str, seed: int):
    model = load_model(name)
    motion, buffer = random_motion(model, seed, 51), TransformBuffer()
    track = buffer.add_robot(model)
    for tick in range(0, 51, 10):
        buffer.insert_joints(track, STAMP + tick * PERIOD_NS // 10, motion[tick])
    last = next(joint.child for joint in reversed(model.joints) if joint.type != "fixed")
    for tick in range(51):
        at = STAMP + tick * PERIOD_NS // 10
        found, bound = buffer.lookup(model.root, last, at), buffer.interpolation_bound(model.root, last, at)
        x, y, z, *rotation = Kinematics(model).link_poses(motion[tick])[model.links.index(last)]
        apart = 2.0 * math.acos(min(1.0, abs(float(np.dot(rotation, found.rotation)))))
        assert math.dist((x, y, z), found.translation) <= bound.translation + 1e-9
        assert apart <= bound.rotation + 1e-6
        assert bound.gap_s == (0.0 if tick % 10 == 0 else PERIOD_NS * 1e-9)
        assert (bound.translation == 0.0) == (tick % 10 == 0)


@pytest.mark.robots
def test_a_joint_at_rest_may_have_gone_half_the_interval_at_its_limit_and_back():
    model = load_model("panda")
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    for tick in (0, 1):
        buffer.insert_joints(track, STAMP + tick * PERIOD_NS, np.zeros(len(model.joint_names)))
    first = model.driven_joints[0]
    bound = buffer.interpolation_bound(first.parent, first.child, STAMP + PERIOD_NS // 2)
    turn = first.limits.velocity * PERIOD_NS * 1e-9 / 2
    length = math.hypot(*first.origin[:3])
    assert bound == pytest.approx(InterpolationBound(PERIOD_NS * 1e-9, length * turn, turn))


def test_of_an_edge_without_a_model_nothing_is_known_between_samples():
    buffer = TransformBuffer()
    for tick in (0, 1):
        buffer.insert(Transform("odom", "base", (0.1 * tick, 0.0, 0.0), UPRIGHT, STAMP + tick * PERIOD_NS))
    assert buffer.interpolation_bound("odom", "base", STAMP) == (0.0, 0.0, 0.0)
    between = buffer.interpolation_bound("odom", "base", STAMP + PERIOD_NS // 2)
    assert between == (PERIOD_NS * 1e-9, math.inf, math.pi)
