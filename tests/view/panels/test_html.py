"""HTML of the panels: text is escaped, and poses are formatted."""

from __future__ import annotations

import math

from zstate.se3 import quaternion_from_rpy
from zstate.view.panels import html
from zstate.view.panels.html import format_number, format_row, pose_rows

SCRIPT = "<img src=x onerror=alert(1)>\"'&"


def test_names_from_the_network_are_escaped():
    for made in (
        html.paragraph(SCRIPT),
        html.heading(SCRIPT),
        html.pairs([(SCRIPT, SCRIPT)]),
        html.table((SCRIPT,), [(SCRIPT,)]),
    ):
        assert "<img" not in made
        assert "&lt;img" in made


def test_pose_rows_contain_position_distance_and_rotations():
    pose = (0.3, -0.4, 1.2, *quaternion_from_rpy(0.0, 0.0, math.pi / 2))
    rows = {name: value.split() for name, value in pose_rows(pose)}
    assert rows["xyz [m]"] == ["0.3000", "-0.4000", "1.2000"]
    assert rows["distance [m]"] == ["1.3000"]  # 0.3, 0.4 and 1.2 are the sides of a box with diagonal 1.3
    assert rows["rpy [deg]"] == ["0.00", "0.00", "90.00"]
    assert rows["rpy [rad]"] == ["0.0000", "0.0000", "1.5708"]
    assert rows["quat xyzw"] == ["0.000", "0.000", "0.707", "0.707"]


def test_numbers_keep_their_width_when_their_signs_change():
    assert len(format_row((0.1, 0.2, 0.3), 4)) == len(format_row((-0.1, 0.2, -0.3), 4))
    assert len(format_row((1.0, 2.0, 3.0), 2, width=7)) == len(format_row((-179.99, 2.0, 3.0), 2, width=7))


def test_negative_zero_is_formatted_as_zero():
    assert format_number(-0.00001, 3) == "0.000"
