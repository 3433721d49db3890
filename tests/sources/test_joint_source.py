import numpy as np
import pytest
from helpers.model_samples import six_of

from zstate.errors import InvalidInput
from zstate.model.kinematics import Kinematics
from zstate.model.load import catalog, load_model
from zstate.model.robot import POSITION_COUNTS, VELOCITY_COUNTS, RobotModel
from zstate.sources import SineSource

NOW = 1_789_000_000_000_000_000
SECOND = 1_000_000_000
# One period, and a little more, so that every joint is seen at both ends of its way.
STAMPS = [NOW + round(part * 6.0 * SECOND) for part in np.linspace(0.0, 1.1, 89)]

EVERY_TYPE = """
    <robot name="every"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
      <joint name="plane" type="planar"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
      <joint name="free" type="floating"><parent link="b"/><child link="c"/></joint>
      <joint name="lift" type="prismatic"><parent link="c"/><child link="d"/>
        <limit lower="2" upper="2.5" velocity="0.1" effort="1"/></joint>
    </robot>
"""
OURS = ("rrbot", "diffbot", "gripper")
# The hands mimic joints that do not exist: load_model refuses them.
EXAMPLES = [entry.name for entry in catalog() if entry.name not in (*OURS, "alex_psyonic_hands")]


def assert_moves_within_limits(model: RobotModel) -> None:
    readings = [SineSource(model).read(stamp) for stamp in STAMPS]
    positions = np.array([reading.positions for reading in readings])
    velocities = np.array([reading.velocities for reading in readings])
    for joint in model.driven_joints:
        if joint.type == "floating":
            continue
        column, rate_column = model.columns[joint.name], model.velocity_columns[joint.name]
        way = positions[:, column : column + POSITION_COUNTS[joint.type]]
        rates = velocities[:, rate_column : rate_column + VELOCITY_COUNTS[joint.type]]
        assert np.all(np.abs(rates) <= joint.limits.velocity * (1 + 1e-12)), joint
        if joint.type in ("revolute", "prismatic"):
            assert np.all((joint.limits.lower <= way) & (way <= joint.limits.upper)), joint
        if joint.limits.upper > joint.limits.lower and joint.limits.velocity > 0.0:
            assert np.ptp(way) > 0.0, joint


@pytest.mark.parametrize("name", OURS)
def test_every_joint_of_our_robots_moves_inside_its_limits(name: str):
    assert_moves_within_limits(load_model(name))


def test_every_type_of_joint_moves_inside_its_limits():
    assert_moves_within_limits(load_model(EVERY_TYPE))


@pytest.mark.robots
@pytest.mark.parametrize("name", six_of(EXAMPLES))
def test_every_joint_of_the_example_robots_moves_inside_its_limits(name: str):
    assert_moves_within_limits(load_model(name))


@pytest.mark.parametrize("source", [*OURS, EVERY_TYPE], ids=[*OURS, "every type"])
def test_velocities_are_the_derivative_of_positions(source: str):
    model = load_model(source)
    sine, step = SineSource(model), 1_000_000
    for stamp in STAMPS[:40]:
        before, after = (sine.read(stamp + way * step).positions for way in (-1, 1))
        slope = (after - before) / (2e-9 * step)
        velocities = sine.read(stamp).velocities
        for joint in model.driven_joints:
            column, rate_column = model.columns[joint.name], model.velocity_columns[joint.name]
            expected = velocities[rate_column : rate_column + VELOCITY_COUNTS[joint.type]]
            found = slope[column : column + POSITION_COUNTS[joint.type]]
            # A floating joint rests: six zeros there, seven here. Others: the third derivative is below 4.
            assert np.allclose(found if len(found) < 7 else found[:6], expected, rtol=0, atol=1e-6), joint


def test_a_floating_joint_rests_at_its_origin_with_a_unit_quaternion():
    model = load_model(EVERY_TYPE)
    column = model.columns["free"]
    for stamp in STAMPS:
        pose = SineSource(model).read(stamp).positions[column : column + 7]
        assert pose.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    Kinematics(model).edge_poses(SineSource(model).read(NOW).positions)


def test_two_sources_agree_at_every_instant_and_after_each_period():
    model = load_model("gripper")
    one, other = SineSource(model, period_s=2.0), SineSource(model, period_s=2.0)
    for stamp in STAMPS:
        assert one.read(stamp).positions.tolist() == other.read(stamp).positions.tolist()
        assert one.read(stamp).positions.tolist() == one.read(stamp + 2 * SECOND).positions.tolist()


def test_neighbouring_nanoseconds_of_today_are_distinguished():
    sine = SineSource(load_model("rrbot"), period_s=0.001)
    assert sine.read(NOW).positions.tolist() != sine.read(NOW + 1).positions.tolist()


@pytest.mark.parametrize("period_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_period_is_a_positive_number(period_s: float):
    with pytest.raises(InvalidInput, match="period_s is a positive number"):
        SineSource(load_model("rrbot"), period_s=period_s)
