"""Surfaces of simulated cameras: they are where the shapes are, and face outwards."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.robots import RRBOT

from zstate import InvalidInput, load_model
from zstate.cameras import Surface, floor_surface, robot_surfaces, wall_surface
from zstate.cameras.surfaces import MeshPart
from zstate.model.geometry import MeshFile

BOX = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
BOX_TRIANGLES = [(0, 1, 3), (0, 3, 2), (6, 7, 5), (6, 5, 4), (4, 5, 1), (4, 1, 0)]
BOX_TRIANGLES += [(2, 3, 7), (2, 7, 6), (2, 6, 4), (2, 4, 0), (5, 7, 3), (5, 3, 1)]


def link(geometry: str, origin: str = "") -> str:
    visual = f"<visual>{origin}<geometry>{geometry}</geometry></visual>"
    return f'<robot name="r"><link name="l">{visual}</link></robot>'


def surface_of(geometry: str, origin: str = "") -> Surface:
    return robot_surfaces(load_model(link(geometry, origin)))["l"]


def area_normals(surface: Surface) -> np.ndarray:
    """The normal of each face, as long as its area."""
    a, b, c, d = np.moveaxis(surface.corners.astype(np.float64), 1, 0)
    return np.cross(c - a, d - b) / 2.0


def volume(surface: Surface) -> float:
    """By the divergence theorem; negative if the faces are inside out."""
    return float((area_normals(surface) * surface.corners.mean(axis=1)).sum() / 3.0)


def test_a_box_has_its_sides_and_faces_outwards():
    surface = surface_of('<box size="0.3 0.4 0.5"/>')
    assert np.abs(surface.corners).max(axis=(0, 1)) == pytest.approx([0.15, 0.2, 0.25])
    assert np.linalg.norm(area_normals(surface), axis=1).sum() == pytest.approx(2 * (0.12 + 0.15 + 0.2))
    assert volume(surface) == pytest.approx(0.06, rel=1e-5)


def test_round_shapes_are_inside_of_theirs_and_nearly_fill_them():
    """A regular polygon of n corners fills the part n / tau sin(tau / n) of its circle: 97.4 % for 16."""
    cylinder = surface_of('<cylinder radius="0.2" length="0.5"/>')
    filled = 16 / math.tau * math.sin(math.tau / 16)
    assert volume(cylinder) == pytest.approx(math.pi * 0.04 * 0.5 * filled, rel=1e-5)
    sphere = surface_of('<sphere radius="0.2"/>')
    assert np.linalg.norm(sphere.corners, axis=2).max() == pytest.approx(0.2)
    assert 0.93 < volume(sphere) / (4 / 3 * math.pi * 0.008) < 1.0


def test_a_shape_stands_at_its_origin():
    surface = surface_of('<box size="0.2 0.2 0.2"/>', '<origin xyz="1 2 3" rpy="0 0 0.7"/>')
    assert surface.corners.mean(axis=(0, 1)) == pytest.approx([1.0, 2.0, 3.0], abs=1e-6)
    assert surface.corners[..., 0].max() == pytest.approx(1.0 + 0.1 * (math.cos(0.7) + math.sin(0.7)))


def test_links_have_the_colours_of_the_model_and_links_without_shapes_nothing():
    surfaces = robot_surfaces(RRBOT)
    assert set(surfaces) == set(RRBOT.links)
    assert len(surfaces["world"]) == 0
    colors = {link: {tuple(color) for color in one.colors.tolist()} for link, one in surfaces.items()}
    assert len(colors["camera_link"]) == 1
    assert colors["camera_link"] != colors["laser_link"]


def test_mesh_files_are_what_the_reader_returns():
    model = load_model(link('<mesh filename="package://p/part.stl"/>'))
    assert len(robot_surfaces(model)["l"]) == 0
    asked: list[MeshFile] = []

    def read(geometry: MeshFile) -> list[MeshPart]:
        asked.append(geometry)
        return [MeshPart(BOX, BOX_TRIANGLES, (1.0, 0.0, 0.0, 1.0))]

    surface = robot_surfaces(model, read)["l"]
    assert [one.uri for one in asked] == ["package://p/part.stl"]
    assert volume(surface) == pytest.approx(6.0, rel=1e-5)
    assert surface.colors.tolist() == [[255, 0, 0]] * 12


def test_a_fine_mesh_is_simplified_and_keeps_its_shape():
    """Points of a cube of the grid become one: none moves by more than its diagonal."""
    turns, heights = np.meshgrid(np.linspace(0, math.tau, 200, endpoint=False), np.linspace(0, 1, 100))
    points = np.stack([np.cos(turns), np.sin(turns), heights], axis=-1).reshape(-1, 3)
    rows = np.arange(len(points)).reshape(100, 200)
    one, other = rows[:-1], np.roll(rows, -1, axis=1)[:-1]
    above, other_above = rows[1:], np.roll(rows, -1, axis=1)[1:]
    halves = [np.stack(half, axis=-1) for half in ((one, other, other_above), (one, other_above, above))]
    triangles = np.concatenate([half.reshape(-1, 3) for half in halves])
    model = load_model(link('<mesh filename="package://p/part.stl"/>'))
    surface = robot_surfaces(model, lambda _: [MeshPart(points, triangles, None)])["l"]
    assert 50 < len(surface) <= 400
    radii = np.hypot(surface.corners[..., 0], surface.corners[..., 1])
    assert np.abs(radii - 1.0).max() < 2.0 / 6 * math.sqrt(3)
    area = np.linalg.norm(area_normals(surface), axis=1).sum()
    assert area == pytest.approx(math.tau, rel=0.15)


def test_an_empty_mesh_is_no_surface():
    model = load_model(link('<mesh filename="package://p/part.stl"/>'))
    nothing = [MeshPart(np.zeros((0, 3)), np.zeros((0, 3), int), None)]
    assert len(robot_surfaces(model, lambda _: nothing)["l"]) == 0


def test_a_floor_covers_its_size_looks_up_and_changes_every_half_metre():
    surface = floor_surface((-1.0, 1.0), (-0.5, 0.5))
    assert area_normals(surface).sum(axis=0) == pytest.approx([0.0, 0.0, 2.0])
    assert (area_normals(surface)[:, 2] > 0.0).all()
    places = np.floor(surface.corners.mean(axis=1)[:, :2] / 0.5).sum(axis=1) % 2
    tones = surface.colors[:, 0]
    assert len(set(tones[places == 0.0])) == len(set(tones[places == 1.0])) == 1
    assert set(tones[places == 0.0]) != set(tones[places == 1.0])


def test_walls_stand_on_the_borders_of_occupied_cells_and_face_the_free_ones():
    cells = np.zeros((7, 9), dtype=bool)
    cells[[0, -1]] = cells[:, [0, -1]] = True
    cells[3, 4:6] = True
    corner = (2.0, -1.0, 0.4)
    surface = wall_surface(cells, 0.1, corner)
    normals = area_normals(surface)
    # Outside and inside of the room, and around the two cells: (18 + 14) + (14 + 10) + 6 borders.
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(62 * 0.1 * 2.5, rel=1e-5)
    units = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    padded = np.pad(cells, 1)
    for distance, expected in ((0.05, False), (-0.05, True)):
        x, y = ((surface.corners.mean(axis=1) + distance * units)[:, :2] - corner[:2]).T
        cosine, sine = math.cos(corner[2]), math.sin(corner[2])
        columns = np.floor((cosine * x + sine * y) / 0.1).astype(int) + 1
        rows = np.floor((cosine * y - sine * x) / 0.1).astype(int) + 1
        assert (padded[rows, columns] == expected).all()


def test_a_surface_has_four_corners_and_a_colour_for_each_face():
    for corners, colors in (((2, 3, 3), (2, 3)), ((2, 4, 3), (1, 3))):
        with pytest.raises(InvalidInput, match=r"corners \(N, 4, 3\) and colors \(N, 3\)"):
            Surface(np.zeros(corners, np.float32), np.zeros(colors, np.uint8))


def test_wrong_grids_are_refused():
    for cells, resolution in (([True], 0.1), ([[True]], 0.0)):
        with pytest.raises(InvalidInput, match="a grid has cells"):
            wall_surface(cells, resolution)
