"""Joints of a robot by its name: interpolated at an instant or many, and the samples kept."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.robots import RRBOT, SECOND

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.errors import InvalidInput, NoData
from zstate.model.load import load_model

MS = SECOND // 1000
DRONE = """\
<robot name="drone"><link name="world"/><link name="body"/>
<joint name="fly" type="floating"><parent link="world"/><child link="body"/></joint></robot>
"""


def swinging(prefix: str = "r1", velocities: bool = False) -> TransformBuffer:
    """The shoulder turns by 1 rad/s for 2 s, sampled every 100 ms; the elbow rests."""
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT, prefix)
    for tick in range(21):
        rates = [1.0, 0.0] if velocities and tick >= 10 else None
        buffer.insert_joints(track, tick * 100 * MS, [0.1 * tick, 0.0], rates)
    return buffer


def test_robot_with_a_prefix_is_named_by_it_and_one_without_by_its_model():
    buffer = swinging("r1")
    buffer.insert_joints(buffer.add_robot(RRBOT), 7, [0.5, -0.5])
    gripper = load_model("gripper")
    buffer.add_robot(gripper)
    assert buffer.joint_positions("r1")[1] == 2 * SECOND
    assert buffer.joint_positions("rrbot")[0].tolist() == [0.5, -0.5]
    with pytest.raises(NoData):
        buffer.joint_positions("gripper")


def test_unknown_robot_is_refused_with_the_names_of_similar_ones():
    buffer = swinging("left_arm")
    for call in (buffer.joint_positions, buffer.link_poses, buffer.joint_states):
        with pytest.raises(InvalidInput, match=r"no robot 'left_am'.*did you mean 'left_arm'"):
            call("left_am")
    with pytest.raises(InvalidInput, match="it has no robot"):
        TransformBuffer().joint_positions("left_arm")


def test_removed_robot_is_unknown():
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    buffer.insert_joints(track, 0, [0.0, 0.0])
    buffer.remove_robot(track)
    with pytest.raises(InvalidInput, match="no robot 'r1'"):
        buffer.joint_positions("r1")


def test_positions_at_many_stamps_equal_those_at_each_stamp():
    buffer = swinging()
    stamps = np.array([150 * MS, -1, 0, 2 * SECOND, 2 * SECOND + 1, 333_333_333])
    positions, valid = buffer.joint_positions_many("r1", stamps)
    assert valid.tolist() == [True, False, True, True, False, True]
    assert np.isnan(positions[~valid]).all()
    for stamp, row in zip(stamps[valid].tolist(), positions[valid], strict=True):
        np.testing.assert_array_equal(row, buffer.joint_positions("r1", stamp)[0])


def test_positions_of_a_floating_joint_are_interpolated_as_a_pose():
    model = load_model(DRONE)
    buffer = TransformBuffer()
    track = buffer.add_robot(model, "drone")
    quarter = [0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)]
    buffer.insert_joints(track, 0, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    buffer.insert_joints(track, SECOND, [2.0, 0.0, 0.0, *quarter])
    ((half,), (valid,)) = buffer.joint_positions_many("drone", [SECOND // 2])
    assert valid
    expected = [1.0, 0.0, 0.0, 0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8)]
    np.testing.assert_allclose(half, expected, atol=1e-15)
    states = buffer.joint_states("drone")
    assert states.joint_names == ("fly",)
    assert states.coordinates == tuple(f"fly.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw"))
    assert len(states.velocity_coordinates) == 6


def test_buffer_without_a_sample_in_the_history_has_no_valid_position():
    buffer = TransformBuffer()
    buffer.add_robot(RRBOT, "r1")
    positions, valid = buffer.joint_positions_many("r1", [0, 1])
    assert np.isnan(positions).all()
    assert not valid.any()
    assert len(buffer.joint_states("r1")) == 0


def test_joint_states_are_copies_of_the_samples_from_start_up_to_before_end():
    buffer = swinging()
    states = buffer.joint_states("r1", 500 * MS, SECOND)
    assert states.joint_names == states.coordinates == RRBOT.joint_names
    assert states.stamps.tolist() == [500 * MS, 600 * MS, 700 * MS, 800 * MS, 900 * MS]
    np.testing.assert_allclose(states.positions[:, 0], states.stamps / SECOND)
    assert states.velocities is states.efforts is None
    states.positions[:] = 99.0
    assert buffer.joint_positions("r1", 500 * MS)[0].tolist() == [0.5, 0.0]
    assert len(buffer.joint_states("r1")) == 21


def test_velocities_that_were_not_published_are_nan():
    states = swinging(velocities=True).joint_states("r1")
    assert states.velocities is not None
    assert np.isnan(states.velocities[:10]).all()
    assert states.velocities[10:].tolist() == [[1.0, 0.0]] * 11


def test_joint_positions_follow_changes_of_drivers_and_of_columns():
    """What reads a robot's joints is kept between calls, for as long as it is right."""
    buffer = TransformBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    for tick in (0, 1):
        buffer.insert_joints(track, tick * SECOND, [float(tick), 0.0])
    assert buffer.joint_positions("r1", SECOND // 2)[0].tolist() == [0.5, 0.0]
    # The first velocities make the rows wider.
    buffer.insert_joints(track, 2 * SECOND, [4.0, 0.0], [2.0, 0.0])
    assert buffer.joint_positions("r1", SECOND * 3 // 2)[0].tolist() == [2.5, 0.0]
    elbow = RRBOT.joint_names[1]
    part = feed_of(buffer).add_part(track, [elbow])
    buffer.insert_joints(part, 0, [0.25])
    buffer.insert_joints(part, SECOND, [0.75])
    feed_of(buffer).assign_joints(track, {elbow: part})
    assert buffer.joint_positions("r1", SECOND // 2)[0].tolist() == [0.5, 0.5]
    feed_of(buffer).assign_joints(track, {})
    assert buffer.joint_positions("r1", SECOND // 2)[0].tolist() == [0.5, 0.0]
