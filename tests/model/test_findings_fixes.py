"""The fix of each finding is right: with it, the finding is gone."""

from __future__ import annotations

import re

import pytest

from zstate import load_model
from zstate.errors import ModelError
from zstate.model.findings import Finding

SOUND = """<robot name="arm">
<link name="base"/><link name="hand"><inertial><mass value="2"/></inertial></link>
<joint name="wrist" type="revolute"><parent link="base"/><child link="hand"/>
<origin xyz="1 2 3"/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>
</robot>"""


def findings(text: str) -> list[Finding]:
    try:
        return list(load_model(text).findings)
    except ModelError as error:
        return [Finding(one.line, one.message, "error", one.fix) for one in error.findings]


def test_the_base_of_the_faulty_models_is_valid():
    assert findings(SOUND) == []


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ('type="revolute"', 'type="revolut"'),
        ('<child link="hand"/>', '<child link="hnd"/>'),
        ('xyz="1 2 3"', 'xyz="1,0 2 3"'),
        ('xyz="1 2 3"', 'xyz="1, 2, 3"'),
        ('xyz="1 2 3"', 'xyz="here"'),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 3"/>'),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'),
        ('<axis xyz="0 0 1"/>', "<axis/>"),
        ('<limit lower="-1" upper="1"/>', ""),
        ('<limit lower="-1" upper="1"/>', '<limit lower="1" upper="-1"/>'),
        ('<mass value="2"/>', '<mass value="-2"/>'),
        ('<mass value="2"/>', '<mass value="heavy"/>'),
    ],
)
def test_the_fix_in_place_of_the_fault_makes_the_model_valid(right: str, wrong: str):
    (finding,) = findings(SOUND.replace(right, wrong))
    fix = re.match(r'<[^<>]*/>|\w+="[^"]*"', finding.fix)
    assert fix
    assert findings(SOUND.replace(right, fix[0])) == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<robot",
        "<sdf/>",
        "<robot name='a'/>",
        "<robot><link name='a'/></robot>",
        "<robot name='a'><link name='a'/><link name='a'/></robot>",
        "<robot name='a'><link name='a'/><link name='b'/></robot>",
        "<robot name='a'><link name='a'><link name='b'/></link></robot>",
        "<robot name='a'><link name='a'></robot>",
        "<robot name='a'><link name='a'/><joint name='j'/></robot>",
        "<robot name='a'><link name='a'/></robot><robot/>",
        "<robot name='a'><link name='${p}a'/></robot>",
        "<robot name='a' xmlns:xacro='http://ros.org/wiki/xacro'><link name='a' x='a & b'/></robot>",
        SOUND.replace('type="revolute"', 'type="planar"').replace("0 0 1", "1 0 0"),
        SOUND.replace("<limit", "<mimic joint='wrist'/><limit"),
        SOUND.replace("<limit", "<mimic/><limit"),
        SOUND.replace(
            "</robot>",
            '<joint name="j" type="fixed"><parent link="hand"/><child link="base"/></joint></robot>',
        ),
        SOUND.replace(
            "</robot>",
            '<joint name="j" type="fixed"><parent link="base"/><child link="hand"/></joint></robot>',
        ),
        SOUND.replace('type="revolute"', 'type="continuous"'),
    ],
)
def test_every_finding_has_a_fix(text: str):
    found = findings(text)
    assert found
    assert [one.message for one in found if not one.fix] == []
