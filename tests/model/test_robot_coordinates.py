"""Coordinates: which number of a robot is called what."""

import pytest
from helpers.model_samples import every_joint

from zstate.model.load import load_model
from zstate.model.robot import VELOCITY_COUNTS, coordinate_names, velocity_columns_by_position

EVERY = every_joint().model


def test_a_coordinate_has_the_joints_name_or_its_name_and_part():
    # mimic joints (toe, nail) and fixed ones have no numbers of their own
    assert coordinate_names(EVERY) == (
        *(f"zz body.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")),
        "universe",
        "sole.x",
        "sole.y",
        "sole.yaw",
        "knee",
        "shin",
    )


def test_each_velocity_has_a_coordinate_and_the_last_of_a_quaternion_has_none():
    names = coordinate_names(EVERY)
    assert [names[slot] for slot in velocity_columns_by_position(EVERY)] == [
        *(f"zz body.{part}" for part in ("x", "y", "z", "qx", "qy", "qz")),
        *names[7:],
    ]


@pytest.mark.parametrize("model", [EVERY, *map(load_model, ("rrbot", "gripper"))])
def test_there_is_one_unique_name_for_each_number(model):
    names, slots = coordinate_names(model), velocity_columns_by_position(model)
    assert len(names) == len(set(names)) == model.position_count
    assert len(slots) == len(set(slots)) == sum(VELOCITY_COUNTS[j.type] for j in model.driven_joints)
    assert set(slots) <= set(range(len(names)))
    for joint in model.driven_joints:
        has_parts = VELOCITY_COUNTS[joint.type] > 1
        assert names[model.columns[joint.name]] == (f"{joint.name}.x" if has_parts else joint.name)


def test_a_robot_without_joints_has_no_coordinates():
    stone = load_model('<robot name="stone"><link name="only"/></robot>')
    assert (coordinate_names(stone), velocity_columns_by_position(stone)) == ((), ())
