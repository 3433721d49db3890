"""MeshEdges: the outlines of meshes and their sharp edges on the near side."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.processes import until

from zstate.model.geometry import Box, Cylinder, Sphere, read_shapes
from zstate.model.urdf import parse_urdf
from zstate.view.mesh_edges import RobotEdges, mesh_edges
from zstate.view.mesh_geometry import primitive
from zstate.view.scene.robot_meshes import RobotKind


def edges_of(shape: Box | Cylinder | Sphere):
    mesh = primitive(shape, False)
    return mesh_edges(mesh.points.astype(np.float64), mesh.triangles)


def as_set(lines: np.ndarray) -> set[frozenset[tuple[float, ...]]]:
    return {frozenset(tuple(point) for point in line) for line in lines.round(6).tolist()}


def test_box_has_the_nine_edges_that_are_seen_from_a_corner():
    lines = edges_of(Box((2.0, 2.0, 2.0))).seen_from((5.0, 5.0, 5.0))
    corners = [(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
    # All edges but those of the corner behind: neighbours differ in one coordinate.
    expected = {
        frozenset((one, other))
        for one in corners
        for other in corners
        if sum(a != b for a, b in zip(one, other, strict=True)) == 1
        and (-1.0, -1.0, -1.0) not in (one, other)
    }
    assert len(expected) == 9
    assert as_set(lines) == expected


def test_box_from_the_front_has_the_four_edges_of_a_side():
    lines = edges_of(Box((2.0, 2.0, 2.0))).seen_from((5.0, 0.0, 0.0))
    assert len(lines) == 4
    assert (lines[..., 0] == 1.0).all()


def test_sphere_has_only_its_outline():
    lines = edges_of(Sphere(1.0)).seen_from((10.0, 0.0, 0.0))
    # The tangents touch where x is 1 / 10; the mesh has steps of 11 degrees.
    assert np.abs(lines[..., 0]).max() < 0.1 + np.radians(11.25)
    # It is closed: each point belongs to two lines.
    _, counts = np.unique(lines.reshape(-1, 3).round(6), axis=0, return_counts=True)
    assert (counts == 2).all()


def test_cylinder_has_its_rims_and_two_sides():
    lines = edges_of(Cylinder(0.5, 2.0)).seen_from((10.0, 0.0, 0.0))
    is_side = lines[:, 0, 2] != lines[:, 1, 2]
    assert len(lines[is_side]) == 2
    assert np.abs(lines[is_side][..., 1]).min() > 0.4
    assert np.abs(lines[~is_side][..., 2]) == pytest.approx(1.0)


def test_border_of_an_open_mesh_is_an_edge_from_its_front():
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], float)
    triangle = mesh_edges(points, np.array([[0, 1, 2]]))
    assert len(triangle.seen_from((0.2, 0.2, 1.0))) == 3
    assert len(triangle.seen_from((0.2, 0.2, -1.0))) == 0


def test_edges_of_a_robot_are_in_the_frames_of_its_links_and_of_visuals_only():
    urdf = """<robot name="r"><link name="a">
        <visual><origin xyz="1 0 0"/><geometry><box size="2 2 2"/></geometry></visual>
        <visual><origin xyz="9 0 0"/><geometry><box size="2 2 2"/></geometry></visual>
        <visual><geometry><mesh filename="package://nowhere/part.stl"/></geometry></visual>
        <collision><geometry><sphere radius="5"/></geometry></collision>
        </link></robot>"""
    edges = RobotEdges(RobotKind(read_shapes(parse_urdf(urdf, "r.urdf"))[0], None))
    until(lambda: edges.is_loaded)
    assert set(edges.links) == {"a"}
    lines = edges.links["a"].seen_from((5.0, 0.0, 0.0))
    # The sides that face the point between the boxes.
    assert sorted({float(x) for x in lines[..., 0].round(6).ravel()}) == [2.0, 8.0]
    assert len(lines) == 8
