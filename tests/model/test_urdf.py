"""parse_urdf: what is refused, with which words and in which line; what is doubted; what is fine."""

import math

import pytest
from helpers.urdf_text import ARM, errors, joint, refusal, robot, tip, warnings

from zstate.model.urdf import parse_urdf


def test_a_valid_robot_is_read_in_the_order_of_its_document():
    model = parse_urdf(robot(ARM), "arm.urdf")
    assert (model.name, model.root) == ("arm", "base")
    assert model.links == ("base", "upper", "lower")
    assert model.joint_names == ("shoulder", "elbow")
    assert [joint.line for joint in model.joints] == [5, 7]
    shoulder, elbow = (joint.limits for joint in model.joints)
    assert (shoulder.lower, shoulder.upper, shoulder.velocity, shoulder.effort) == (-1, 2, 3, 4)
    assert (elbow.lower, elbow.upper, elbow.velocity, elbow.effort) == (
        -math.inf,
        math.inf,
        math.inf,
        math.inf,
    )
    assert [joint.axis for joint in model.joints] == [(0, 0, 1), (1, 0, 0)]
    assert model.findings == ()


@pytest.mark.parametrize(
    ("body", "line", "words"),
    [
        ("", 1, "has no <link>"),
        (ARM + '<link name="base"/>', 8, "a second link 'base'; the first is in line 2"),
        (
            ARM + '<link name="tip"/>' + joint(name="elbow"),
            8,
            "a second joint 'elbow'; the first is in line 7",
        ),
        (ARM + '<link name=""/>', 8, "<link> has a name that is empty"),
        (ARM + "<link/>", 8, '<link> has no name="..."'),
        (ARM + '<link name="/tip"/>' + joint(child="/tip"), 8, "begins with a slash; write 'tip'"),
        (ARM + '<link name="${p}tip"/>' + joint(child="${p}tip"), 8, "is a xacro expression"),
        (ARM + '<joint name="j" type="fixed"><child link="base"/></joint>', 8, "has no <parent"),
        (ARM + '<joint name="j" type="fixed"><parent link="base"/></joint>', 8, "has no <child"),
        (
            ARM + '<joint name="j" type="fixed"><parent>base</parent><child link="lower"/></joint>',
            8,
            "names no link",
        ),
        (
            ARM + '<link name="tip"/>' + joint(parent="lover"),
            8,
            "'lover' is not a link; did you mean 'lower'?",
        ),
        (
            ARM + '<link name="tip"/>' + joint(child="tipp"),
            8,
            "child 'tipp' is not a link; did you mean 'tip'?",
        ),
        (
            ARM + joint(parent="base", child="lower"),
            8,
            "link 'lower' has two parents: 'upper' (line 7) and 'base' (line 8)",
        ),
        (
            ARM + joint(parent="upper", child="lower"),
            8,
            "'elbow' (line 7) and 'more' (line 8) join the same links 'upper' and 'lower'",
        ),
        (
            ARM + joint(parent="lower", child="upper"),
            8,
            "the links 'upper' -> 'lower' -> 'upper' form a cycle",
        ),
        (ARM + joint(parent="lower", child="base"), 8, "'base' -> 'upper' -> 'lower' -> 'base' form a cycle"),
        (
            ARM
            + '<link name="x"/><link name="y"/>\n'
            + joint("j", "fixed", "x", "y")
            + joint("k", "fixed", "y", "x"),
            10,
            "the links 'x' -> 'y' -> 'x' form a cycle, closed by joint 'k'",
        ),
        (ARM + '<link name="tip"/>', 8, "two links have no parent: 'base' (line 2) and 'tip' (line 8)"),
        (ARM + '<link name="x"/><link name="y"/>', 8, "3 links have no parent"),
        (ARM + joint(parent="lower", child="lower"), 8, "joins link 'lower' to itself"),
        (tip("revolute"), 8, "is revolute and has no <limit"),
        (tip("prismatic"), 8, "is prismatic and has no <limit"),
        (tip("revolute", '<limit lower="1" upper="-1"/>'), 8, "limits reversed: lower 1, upper -1"),
        (tip("revolute", '<limit lower="1"/>'), 8, "limits reversed: lower 1, upper 0"),
        (tip("Revolute"), 8, "unknown type 'Revolute'; did you mean 'revolute'?"),
        (tip("ball"), 8, "unknown type 'ball'; one of fixed, revolute"),
        (ARM + '<link name="tip"/>' + joint().replace('type="fixed"', ""), 8, "has no type; one of fixed"),
        (tip("continuous", '<axis xyz="0 0 0"/>'), 8, "axis '0 0 0', which has no direction"),
        (tip("continuous", '<axis rpy="0 0 1"/>'), 8, "its <axis> has no xyz"),
        (tip("planar", '<axis xyz="1 0 0"/>'), 8, "turn its origin instead"),
        (tip("planar", '<axis xyz="0 0 -1"/>'), 8, "turn its origin instead"),
        (tip("fixed", "<origin/><origin/>"), 8, "more than one <origin>"),
        (tip("fixed", '<origin quat_xyzw="0 0 0 1"/>'), 8, "quat_xyzw is not read; write rpy"),
        (tip("continuous", '<mimic multiplier="2"/>'), 8, "<mimic> names no joint"),
        (
            tip("continuous", '<mimic joint="elbo"/>'),
            8,
            "mimics 'elbo', which does not exist; did you mean 'elbow'?",
        ),
        (tip("continuous", '<mimic joint="more"/>'), 8, "joint 'more' mimics itself"),
        (tip("planar", '<mimic joint="elbow"/>'), 8, "is planar and cannot mimic"),
        (tip("floating", '<mimic joint="elbow"/>'), 8, "is floating and cannot mimic"),
        (ARM + '<robot name="b"/>', 8, "a second <robot>; the first begins in line 1"),
        (ARM + '<group><link name="b"/></group>', 8, "<link> is inside <group> (line 8)"),
        ('<link name="a">\n<link name="b"/></link>', 3, "<link> is inside <link> (line 2)"),
    ],
)
def test_a_fault_is_refused_with_its_line(body: str, line: int, words: str):
    found = errors(robot(body))
    assert any(at == line and words in message for at, message in found), found
    assert "\n" not in "".join(message for _, message in found)


@pytest.mark.parametrize(
    ("master", "words"),
    [("fixed", "which is fixed"), ("floating", "which is floating"), ("planar", "which is planar")],
)
def test_a_mimic_follows_a_joint_of_one_number(master: str, words: str):
    body = (
        tip(master) + '<link name="end"/>\n' + joint("f", "continuous", "tip", "end", '<mimic joint="more"/>')
    )
    assert [(line, words in message) for line, message in errors(robot(body))] == [(11, True)]


def test_mimics_in_a_cycle_are_named_and_a_chain_is_fine():
    ring = [
        joint(f"j{i}", "continuous", "base", f"l{i}", f'<mimic joint="j{(i + 1) % 3}"/>') for i in range(3)
    ]
    links = "".join(f'<link name="l{i}"/>' for i in range(3))
    found = errors(robot(ARM + links + "".join(ring)))
    assert [message for _, message in found] == [
        "the mimics 'j0' -> 'j1' -> 'j2' -> 'j0' form a cycle, so no joint leads"
    ]
    ring[2] = joint("j2", "continuous", "base", "l2", '<mimic joint="elbow" multiplier="-2" offset=".5"/>')
    model = parse_urdf(robot(ARM + links + "".join(ring)), "arm.urdf")
    leader = model.mimic_of(model.joints[2])
    assert (leader.joint, leader.multiplier, leader.offset) == ("elbow", -2.0, 0.5)


def test_all_findings_are_reported_in_the_order_of_lines():
    body = (
        ARM
        + joint("a", "Fixed", "base", "tip")
        + '<link name="tip"><inertial><mass value="-1"/></inertial></link>\n'
    )
    body += (
        joint("b", "continuous", "tip", "end", '<axis xyz="0 0 0"/>') + '<link name="end"/><link name="end"/>'
    )
    error = refusal(robot(body))
    assert [(f.line, f.severity) for f in error.findings] == [
        (8, "error"),
        (9, "warning"),
        (10, "error"),
        (11, "error"),
    ]
    assert str(error).startswith(
        "arm.urdf cannot be used (3 findings)\n  line 8  joint 'a' has the unknown type"
    )


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (
            ARM.replace('"base"/>', '"base"><inertial><mass value="-1"/></inertial></link>', 1),
            "negative mass -1 kg",
        ),
        (
            ARM.replace('"base"/>', '"base"><inertial><mass value="1,5"/></inertial></link>', 1),
            "decimal comma",
        ),
        (tip("continuous", '<limit lower="0" upper="1"/>'), "lower and upper limits are not used"),
        (tip("continuous", '<axis xyz="0 3 4"/>'), "of length 5; it is made a unit vector"),
        (tip("fixed", '<mimic joint="elbow"/>'), "is fixed, so its <mimic> is not used"),
        (ARM + '<extra><link name="b"/></extra>', "<link> is inside <extra>"),
    ],
)
def test_usable_faults_are_warnings(body: str, words: str):
    found = warnings(robot(body))
    assert len(found) == 1
    assert words in found[0][1]


def test_an_axis_is_made_a_unit_vector():
    model = parse_urdf(robot(tip("continuous", '<axis xyz="0 3 4"/>')), "arm.urdf")
    assert model.joints[-1].axis == (0.0, 0.6, 0.8)


@pytest.mark.parametrize(
    "text",
    [
        robot(ARM.replace("elbow", "lower")),  # a joint named like a link
        robot(ARM.replace("base", "universe")),
        robot(tip("revolute", '<limit lower="0" upper="0"/>')),
        robot(tip("revolute", "<limit/>")),
        robot(tip("fixed", '<axis xyz="0 0 0"/>')),
        robot(tip("planar")),
        robot(tip("planar", '<axis xyz="0 0 1"/>')),
        robot(tip("floating")),
        robot(tip("fixed", '<parent_extra/><x:y xmlns:x="urn:x"/><undeclared:z/>')),
        robot(ARM + '<gazebo><joint type="x" name="elbow"/><link name="base"/></gazebo>'),
        robot(ARM + '<transmission><joint name="elbow"/></transmission>'),
        robot(ARM + '<ros2_control><joint name="elbow" type="x"/></ros2_control>'),
        robot(ARM).replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'),
        "\ufeff" + robot(ARM),
        '\n  <?xml version="1.0"?>' + robot(ARM),
        "<!DOCTYPE robot>" + robot(ARM),
        robot(ARM) + "\n<!-- the end -->\n",
    ],
)
def test_common_forms_of_existing_files_give_no_warning(text: str):
    assert warnings(text) == []


def test_joint_outside_of_the_robot_element_is_ignored():
    model = parse_urdf(robot(ARM + '<gazebo><joint type="revolute" name="g"/></gazebo>'), "arm.urdf")
    assert model.joint_names == ("shoulder", "elbow")


@pytest.mark.parametrize("name", ["", ' name=""', ' name=" "'])
def test_a_robot_without_a_name_is_refused(name: str):
    assert errors(f"<robot{name}>{ARM}</robot>")[0][1].startswith("<robot> has ")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<sdf version="1.6"><model name="m"/></sdf>', "the document is <sdf>, not <robot>: an SDF file"),
        ("<!DOCTYPE html><html></html>", "a web page"),
        ("<Robot/>", "the document is <Robot>, not <robot>"),
    ],
)
def test_another_format_is_named(text: str, words: str):
    ((_, message),) = errors(text)
    assert words in message


@pytest.mark.parametrize(
    "text",
    [
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">\n<xacro:include filename="a"/></robot>',
        '<robot name="r" xmlns:x="http://wiki.ros.org/xacro">\n<x:macro name="a"/><link name="b"/></robot>',
        '<robot name="r">\n<xacro:property name="a" value="b"/><link name="${a}"/></robot>',
    ],
)
def test_xacro_is_called_xacro(text: str):
    ((line, message),) = errors(text)
    assert line == 2
    assert "this is a xacro file" in message


def test_rpy_turns_about_fixed_axes_x_first():
    # Quarter turns: x first takes z to -y, then z takes -y to x; so the frame's z axis ends along x.
    quarter = math.pi / 2
    model = parse_urdf(robot(tip("fixed", f'<origin xyz="1 2 3" rpy="{quarter} 0 {quarter}"/>')), "arm.urdf")
    x, y, z, qx, qy, qz, qw = model.joints[-1].origin
    assert (x, y, z) == (1, 2, 3)
    z_axis = (2 * (qx * qz + qy * qw), 2 * (qy * qz - qx * qw), 1 - 2 * (qx * qx + qy * qy))
    assert z_axis == pytest.approx((1.0, 0.0, 0.0), abs=1e-15)
