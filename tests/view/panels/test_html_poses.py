"""Poses in numbers that a person reads."""

from __future__ import annotations

import math

from zstate.se3 import quaternion_from_rpy
from zstate.view.panels.html import format_number, format_row, pose_rows


def test_a_pose_is_told_in_every_way_that_people_ask_for():
    pose = (0.3, -0.4, 1.2, *quaternion_from_rpy(0.0, 0.0, math.pi / 2))
    rows = {name: value.split() for name, value in pose_rows(pose)}
    assert rows["xyz [m]"] == ["0.3000", "-0.4000", "1.2000"]
    assert rows["distance [m]"] == ["1.3000"]  # 0.3, 0.4 and 1.2 are the sides of a box with diagonal 1.3
    assert rows["rpy [deg]"] == ["0.00", "0.00", "90.00"]
    assert rows["rpy [rad]"] == ["0.0000", "0.0000", "1.5708"]
    assert rows["quat xyzw"] == ["0.000", "0.000", "0.707", "0.707"]


def test_numbers_stand_still_when_their_signs_change():
    assert len(format_row((0.1, 0.2, 0.3), 4)) == len(format_row((-0.1, 0.2, -0.3), 4))
    assert len(format_row((1.0, 2.0, 3.0), 2, width=7)) == len(format_row((-179.99, 2.0, 3.0), 2, width=7))


def test_there_is_no_negative_zero():
    assert format_number(-0.00001, 3) == "0.000"
