"""Numbers in a URDF: plain decimals are read, what only some readers take is refused."""

import pytest
from helpers.urdf_text import errors, robot, tip

from zstate.model.urdf import parse_urdf


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        ('<origin xyz="0 0 nan"/>', "origin xyz: 'nan' is not a finite number"),
        ('<origin rpy="0 0 -inf"/>', "origin rpy: '-inf' is not a finite number"),
        ('<origin xyz="0 0 Infinity"/>', "origin xyz: 'Infinity' is not a finite number"),
        ('<origin xyz="0 0"/>', "origin xyz: '0 0' has 2 of 3 numbers"),
        ('<origin xyz="0,0,0"/>', "separate them by blanks, not commas"),
        ('<origin xyz="0 0 1,5"/>', "'1,5' has a decimal comma; write '1.5'"),
        ('<origin xyz="0 0 1_000"/>', "'1_000' is a number to Python only; write 1000.0"),
        ('<origin xyz="0 0 \u0663"/>', "'\u0663' is a number to Python only; write 3.0"),
        ('<origin xyz="0 0 x"/>', "'x' is not a number"),
        ('<origin xyz="0 0 ${a + b}"/>', "'0 0 ${a + b}' is a xacro expression, not a number"),
        ('<limit velocity="$(arg v)"/>', "'$(arg v)' is a xacro expression, not a number"),
        ('<origin xyz="0 0 1e999"/>', "'1e999' is too large"),
        ('<axis xyz="nan 0 1"/>', "axis xyz: 'nan' is not a finite number"),
        ('<limit velocity="fast"/>', "limit velocity: 'fast' is not a number"),
        ('<limit effort=""/>', "limit effort: an empty text is not a number"),
        ('<mimic joint="elbow" multiplier="1 2"/>', "mimic multiplier: '1 2' is not a number"),
        ('<mimic joint="elbow" offset="inf"/>', "mimic offset: 'inf' is not a finite number"),
    ],
)
def test_numbers_that_only_some_parsers_accept_are_refused(inner: str, words: str):
    found = errors(robot(tip("continuous", inner)))
    assert len(found) == 1
    assert found[0][0] == 8
    assert found[0][1].startswith("joint 'more': ")
    assert words in found[0][1]


@pytest.mark.parametrize("number", ["1", "+1", "1.", ".5", "-0.25e-3", "1E+2"])
def test_plain_decimals_are_read(number: str):
    model = parse_urdf(robot(tip("fixed", f'<origin xyz="\t{number}\n 0  0 "/>')), "arm.urdf")
    assert model.joints[-1].origin[0] == float(number)
