"""parse_urdf: what is refused, with which words and in which line; what is doubted; what is fine."""

import math
import time

import pytest

from zstate.errors import ModelError
from zstate.model.urdf import MAX_LINKS, MAX_VELOCITIES, parse_urdf
from zstate.model.xml import MAX_BYTES, MAX_NESTING

# A table's bodies begin in line 2 of the document: line 1 is the <robot> tag.
ARM = """\
<link name="base"/>
<link name="upper"/>
<link name="lower"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="2" velocity="3" effort="4"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/></joint>
"""


def robot(body: str) -> str:
    return f'<robot name="arm">\n{body}</robot>'


def joint(
    name: str = "more", kind: str = "fixed", parent: str = "lower", child: str = "tip", inner: str = ""
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{inner}</joint>\n'


def tip(kind: str, inner: str = "") -> str:
    """The arm with one more link in line 9 and one more joint in line 8."""
    return ARM + joint(kind=kind, inner=inner) + '<link name="tip"/>\n'


def refusal(text: str | bytes) -> ModelError:
    with pytest.raises(ModelError) as caught:
        parse_urdf(text, "arm.urdf")
    return caught.value


def errors(text: str | bytes) -> list[tuple[int | None, str]]:
    return [(f.line, f.message) for f in refusal(text).findings if f.severity == "error"]


def warnings(text: str) -> list[tuple[int | None, str]]:
    return [(f.line, f.message) for f in parse_urdf(text, "arm.urdf").findings]


def test_a_sound_robot_is_read_in_the_order_of_its_document():
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
        (ARM + '<group><link name="b"/></group>', 8, "<link> stands inside <group> (line 8)"),
        ('<link name="a">\n<link name="b"/></link>', 3, "<link> stands inside <link> (line 2)"),
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


def test_a_mimic_chain_has_a_limit():
    links = "".join(f'<link name="l{i}"/>' for i in range(102))
    joints = [
        joint(
            f"j{i}", "continuous", "base", f"l{i}", f'<mimic joint="{"elbow" if i == 0 else f"j{i - 1}"}"/>'
        )
        for i in range(102)
    ]
    found = errors(robot(ARM + links + "".join(joints)))
    assert [message for _, message in found] == ["joint 'j100' ends a chain of 101 mimics; the limit is 100"]


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
        ('<origin xyz="0 0 1e999"/>', "'1e999' is too large"),
        ('<axis xyz="nan 0 1"/>', "axis xyz: 'nan' is not a finite number"),
        ('<limit velocity="fast"/>', "limit velocity: 'fast' is not a number"),
        ('<limit effort=""/>', "limit effort: an empty text is not a number"),
        ('<mimic joint="elbow" multiplier="1 2"/>', "mimic multiplier: '1 2' is not a number"),
        ('<mimic joint="elbow" offset="inf"/>', "mimic offset: 'inf' is not a finite number"),
    ],
)
def test_numbers_that_only_some_readers_take_are_refused(inner: str, words: str):
    found = errors(robot(tip("continuous", inner)))
    assert len(found) == 1
    assert found[0][0] == 8
    assert found[0][1].startswith("joint 'more': ")
    assert words in found[0][1]


@pytest.mark.parametrize("number", ["1", "+1", "1.", ".5", "-0.25e-3", "1E+2"])
def test_plain_decimals_are_read(number: str):
    model = parse_urdf(robot(tip("fixed", f'<origin xyz="\t{number}\n 0  0 "/>')), "arm.urdf")
    assert model.joints[-1].origin[0] == float(number)


def test_all_findings_come_at_once_in_the_order_of_lines():
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
        (ARM + '<extra><link name="b"/></extra>', "<link> stands inside <extra>"),
    ],
)
def test_what_is_doubtful_but_usable_is_a_warning(body: str, words: str):
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
def test_what_files_in_use_have_is_fine_without_a_warning(text: str):
    assert warnings(text) == []


def test_a_foreign_joint_is_not_the_robots():
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


def chain(count: int, kind: str = "fixed") -> str:
    links = "".join(f'<link name="l{i}"/>\n' for i in range(count))
    return robot(links + "".join(joint(f"j{i}", kind, f"l{i}", f"l{i + 1}") for i in range(count - 1)))


def test_ten_thousand_links_are_refused_quickly():
    text = chain(10_000)
    started = time.thread_time()
    found = errors(text)
    assert time.thread_time() - started < 2.0
    assert found == [(None, f"the robot has 10000 links; the limit is {MAX_LINKS}")]


def test_a_deep_chain_is_refused_and_the_deepest_allowed_is_not():
    assert len(parse_urdf(chain(501), "chain").joints) == 500
    assert errors(chain(502)) == [(None, "link 'l501' lies 501 joints below the root; the limit is 500")]


def test_velocities_have_a_limit_in_which_mimics_count():
    assert parse_urdf(chain(MAX_VELOCITIES + 1, "continuous"), "chain").velocity_count == MAX_VELOCITIES
    one_more = chain(MAX_VELOCITIES + 2, "continuous")
    for text in (one_more, one_more.replace('child link="l1"/>', 'child link="l1"/><mimic joint="j1"/>')):
        assert errors(text) == [(None, f"the robot has 201 velocities; the limit is {MAX_VELOCITIES}")]


def test_xml_nesting_and_size_have_limits():
    deep = robot(ARM + "<a>" * MAX_NESTING + "</a>" * MAX_NESTING)
    ((line, message),) = errors(deep)
    assert (line, message) == (8, "<a> is nested deeper than 100 levels")
    ((line, message),) = errors(" " * (MAX_BYTES + 1))
    assert (line, message) == (None, f"the text has {MAX_BYTES + 1} bytes; the limit is {MAX_BYTES}")
    assert "more than 200000 elements" in errors(robot("<a/>" * 200_000))[0][1]


def test_many_faults_do_not_make_it_slow():
    links = "".join(f'<link name="{"arm_segment" * 5}_{i}"/>' for i in range(MAX_LINKS))
    lost = "".join(
        joint(f"j{i}", "fixed", "arm_segmnt" * 5, f"{'arm_segmnt' * 5}{i}") for i in range(MAX_LINKS)
    )
    started = time.thread_time()
    assert len(errors(robot(links + lost))) == 2 * MAX_LINKS
    assert time.thread_time() - started < 5.0
