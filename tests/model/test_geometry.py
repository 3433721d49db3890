"""shapes_of: what links look like, read as rviz and urdfdom read it."""

import math

import pytest

from zstate import load_model
from zstate.model.catalog import catalog
from zstate.model.geometry import Box, Cylinder, MeshFile, Shape, Sphere, read_shapes
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf


def robot(link: str, top: str = "") -> RobotModel:
    """One link in line 2, and other elements of the robot."""
    return parse_urdf(f'<robot name="thing">\n<link name="base">{link}</link>\n{top}</robot>', "thing.urdf")


def visual(geometry: str = '<sphere radius="1"/>', more: str = "", tag: str = "visual") -> str:
    return f"<{tag}><geometry>{geometry}</geometry>{more}</{tag}>"


def only(model: RobotModel) -> Shape:
    (shape,) = read_shapes(model)[0]
    return shape


def complaints(model: RobotModel) -> list[tuple[int | None, str]]:
    return [(finding.line, finding.message) for finding in read_shapes(model)[1]]


@pytest.mark.parametrize(
    ("text", "geometry"),
    [
        ('<box size="1 2 3"/>', Box((1.0, 2.0, 3.0))),
        ('<cylinder radius="0.5" length="2"/>', Cylinder(0.5, 2.0)),
        ('<sphere radius=".25"/>', Sphere(0.25)),
        ('<mesh filename="package://a/b.stl"/>', MeshFile("package://a/b.stl")),
        ('<mesh filename="b.dae" scale="1 -1 0.001"/>', MeshFile("b.dae", (1.0, -1.0, 0.001))),
    ],
)
def test_each_geometry_is_read(text: str, geometry: object):
    assert only(robot(visual(text))).geometry == geometry


def test_a_shape_without_origin_is_at_the_links_frame():
    assert only(robot(visual())).origin == (0, 0, 0, 0, 0, 0, 1)
    moved = only(robot(visual(more=f'<origin xyz="1 2 3" rpy="0 0 {math.pi}"/>')))
    assert moved.origin == pytest.approx((1, 2, 3, 0, 0, 1, 0))


def test_a_link_may_have_several_shapes_of_both_roles():
    model = robot(visual() + visual(tag="collision") + visual())
    assert [(shape.link, shape.role) for shape in read_shapes(model)[0]] == [
        ("base", "visual"),
        ("base", "collision"),
        ("base", "visual"),
    ]


def test_a_colour_inside_the_link_is_read():
    inside = '<material name=""><color rgba="0.1 0.2 0.3 0.4"/></material>'
    assert only(robot(visual(more=inside))).color == (0.1, 0.2, 0.3, 0.4)


def test_named_material_refers_to_the_definition_in_the_robot():
    top = '<material name="red"><color rgba="1 0 0 1"/></material>'
    assert only(robot(visual(more='<material name="red"/>'), top)).color == (1, 0, 0, 1)


def test_a_material_defined_in_one_link_may_be_named_by_an_earlier_one():
    there = '<link name="tip">' + visual(more='<material name="red"><color rgba="1 0 0 1"/></material>')
    joint = '<joint name="j" type="fixed"><parent link="base"/><child link="tip"/></joint>'
    model = robot(visual(more='<material name="red"/>'), f"{there}</link>{joint}")
    assert [shape.color for shape in read_shapes(model)[0]] == [(1, 0, 0, 1)] * 2


def test_material_of_the_robot_precedes_that_of_the_link_as_in_rviz():
    top = '<material name="red"><color rgba="1 0 0 1"/></material>'
    inside = '<material name="red"><color rgba="0.9 0 0 1"/></material>'
    assert only(robot(visual(more=inside), top)).color == (1, 0, 0, 1)


def test_a_material_has_a_texture_and_a_colour():
    inside = '<material name="wood"><texture filename="package://a/wood.png"/></material>'
    shape = only(robot(visual(more=inside)))
    assert (shape.color, shape.texture) == (None, "package://a/wood.png")


def test_colours_outside_the_range_are_clamped():
    inside = '<material name=""><color rgba="2 -1 0 1"/></material>'
    assert only(robot(visual(more=inside))).color == (1, 0, 0, 1)


def test_a_faulty_shape_is_a_finding_and_the_others_are_drawn():
    model = robot(visual('<box size="1 2"/>') + visual())
    assert [shape.geometry for shape in read_shapes(model)[0]] == [Sphere(1.0)]
    assert complaints(model) == [
        (2, "link 'base': a <visual> is not drawn: box size: '1 2' has 2 of 3 numbers"),
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "it has no <geometry> with something inside"),
        ('<capsule radius="1" length="1"/>', "<capsule> is none of box, cylinder, sphere, mesh"),
        ('<sphere radius="-1"/>', "its <sphere> has the negative length -1 m"),
        ('<cylinder radius="1"/>', "cylinder length: an empty text is not a number"),
        ("<mesh/>", "its <mesh> names no file"),
        ('<mesh filename="a.stl" scale="0,001 1 1"/>', "mesh scale: '0,001' has a decimal comma"),
    ],
)
def test_the_fault_of_a_shape_is_named(text: str, words: str):
    model = robot(visual(text))
    assert read_shapes(model)[0] == ()
    ((line, message),) = complaints(model)
    assert line == 2
    assert words in message


def test_an_undefined_material_is_a_finding_with_a_near_miss():
    top = '<material name="Grey"><color rgba="0.5 0.5 0.5 1"/></material>'
    model = robot(visual(more='<material name="grey"/>'), top)
    assert only(model).color is None
    assert complaints(model) == [
        (2, "link 'base': the material 'grey' is defined nowhere; did you mean 'Grey'?")
    ]


def test_an_unreadable_colour_is_one_finding():
    model = robot(visual(more='<material name="red"><color rgba="1 0 0"/></material>'))
    assert only(model).color is None
    assert complaints(model) == [(2, "material 'red': rgba: '1 0 0' has 3 of 4 numbers")]


@pytest.mark.robots
def test_every_robot_of_the_catalog_with_geometry_has_shapes_of_its_own_links():
    for name in ("panda", "talos", "anymal_c", "pr2", "ur5"):
        model = load_model(next(entry.path for entry in catalog() if entry.name == name))
        shapes = read_shapes(model)[0]
        assert {shape.link for shape in shapes} <= set(model.links)
        assert {shape.role for shape in shapes} == {"visual", "collision"}
