"""Meshes: shapes as binary glTF, in the colours of the URDF and of the files, each file read once."""

from __future__ import annotations

import gc
import io
import weakref
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

trimesh = pytest.importorskip("trimesh")

from zstate import load_model  # noqa: E402
from zstate.model.geometry import Box, Cylinder, MeshFile, Shape, Sphere, read_shapes  # noqa: E402
from zstate.model.mesh_paths import MissingFile  # noqa: E402
from zstate.se3 import IDENTITY  # noqa: E402
from zstate.view.mesh_geometry import smooth_normals  # noqa: E402
from zstate.view.meshes import MeshAsset, Meshes  # noqa: E402

HERE = Path(__file__).parent
"""Folder of a URDF file that the user named, so that every file is found."""
TRIANGLE_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n{}f 1/1 2/2 3/3\n"
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><unit meter="{unit}" name="unit"/><up_axis>{up}</up_axis></asset>
  <library_effects><effect id="e"><profile_COMMON><technique sid="common"><lambert>
    <diffuse><color>1 0 0 1</color></diffuse></lambert></technique></profile_COMMON></effect>
  </library_effects>
  <library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
  <library_geometries><geometry id="g"><mesh>
    <source id="p"><float_array id="pa" count="9">0 0 0 10 0 0 0 20 30</float_array><technique_common>
      <accessor source="#pa" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
      <param name="Z" type="float"/></accessor></technique_common></source>
    <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
    <triangles material="s" count="1"><input semantic="VERTEX" source="#v" offset="0"/>
      <p>0 1 2</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="S"><node><instance_geometry url="#g"><bind_material>
    <technique_common><instance_material symbol="s" target="#m"/></technique_common></bind_material>
    </instance_geometry></node></visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#S"/></scene>
</COLLADA>"""


def shape(geometry: object, color: tuple[float, ...] | None = None, texture: str | None = None) -> Shape:
    return Shape("base", "visual", IDENTITY, geometry, color, texture)


def drawn(one: Shape, meshes: Meshes | None = None, **options: object) -> MeshAsset:
    drawing = (meshes or Meshes()).load(one, **{"base": HERE, **options})
    assert isinstance(drawing, MeshAsset), str(drawing)
    return drawing


def read(drawing: MeshAsset):
    """The meshes of a glTF file, read by trimesh."""
    scene = trimesh.load_scene(io.BytesIO(drawing.glb), file_type="glb", process=False)
    return list(scene.geometry.values())


def the_mesh(drawing: MeshAsset):
    (mesh,) = read(drawing)
    return mesh


def linear(channel: float) -> float:
    """sRGB to linear light (IEC 61966-2-1)."""
    return channel / 12.92 if channel <= 0.04045 else ((channel + 0.055) / 1.055) ** 2.4


def color_of(drawing: MeshAsset) -> list[int]:
    return the_mesh(drawing).visual.material.baseColorFactor.tolist()


def as_read(color: tuple[float, float, float, float]) -> list[int]:
    """An sRGB colour as a glTF reader returns it: linear, in 255 steps."""
    return [*(round(linear(channel) * 255) for channel in color[:3]), round(color[3] * 255)]


def picture(path: Path, mode: str = "RGB", size: tuple[int, int] = (8, 4)) -> Path:
    Image.new(mode, size, (10, 200, 30, 128)[: len(mode)]).save(path)
    return path


@pytest.mark.parametrize(
    ("geometry", "size", "volume"),
    [
        (Box((1.0, 2.0, 3.0)), (1.0, 2.0, 3.0), 6.0),
        (Cylinder(0.5, 2.0), (1.0, 1.0, 2.0), 2.0 * np.pi * 0.25),
        (Sphere(0.5), (1.0, 1.0, 1.0), np.pi / 6.0),
    ],
)
def test_primitive_is_centred_has_its_size_and_faces_outwards(geometry, size, volume):
    mesh = the_mesh(drawn(shape(geometry)))
    assert mesh.bounds == pytest.approx(np.array([-0.5, 0.5])[:, None] * size, abs=1e-6)
    mesh.merge_vertices(merge_norm=True)
    assert mesh.is_watertight
    # Positive only where the triangles are seen counterclockwise from outside; 32 sides are not quite round.
    assert mesh.volume == pytest.approx(volume, rel=0.05)


def test_box_has_sharp_edges_and_sphere_is_smooth():
    # Each corner of a box is three points, one for each side that meets there.
    assert len(the_mesh(drawn(shape(Box((1, 1, 1))))).vertices) == 24
    ball = the_mesh(drawn(shape(Sphere(2.0))))
    assert ball.vertex_normals == pytest.approx(ball.vertices / 2.0, abs=0.05)


def test_edges_are_smooth_up_to_35_degrees():
    def fold(degrees: float) -> int:
        """The number of points of two triangles that meet at the y axis at this angle."""
        x, z = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        points = np.array([(0, 0, 0), (0, 1, 0), (-1, 0, 0), (x, 0, z)])
        return len(smooth_normals(points, np.array([(0, 1, 2), (0, 3, 1)])).points)

    assert (fold(0), fold(30), fold(40), fold(90)) == (4, 4, 6, 6)


def test_triangles_without_area_are_dropped():
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (np.nan, 0, 0)])
    surface = smooth_normals(points, np.array([(0, 1, 2), (0, 1, 1), (0, 1, 3)]))
    assert surface.points[surface.triangles].tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]


def test_urdf_colour_is_written_as_linear_light():
    color = (0.9, 0.5, 0.01, 0.25)
    assert color_of(drawn(shape(Box((1, 1, 1)), color))) == as_read(color)


def test_shape_without_colour_is_light_grey():
    red, green, blue, opacity = color_of(drawn(shape(Sphere(1.0))))
    assert max(red, green, blue) - min(red, green, blue) < 15
    assert opacity == 255


def test_override_colour_replaces_all_colours():
    over = (1.0, 0.0, 0.0, 0.5)
    assert color_of(drawn(shape(Sphere(1.0), (0, 1, 0, 1)), over=over)) == as_read(over)


def test_mesh_file_without_colours_has_the_urdf_colour(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.stl")
    color = (0.0, 0.0, 1.0, 1.0)
    one = shape(MeshFile(str(tmp_path / "box.stl"), (1, -1, 2)), color)
    assert color_of(drawn(one)) == as_read(color)
    assert drawn(one).scale == (1, -1, 2)


def test_colours_of_a_mesh_file_take_precedence_over_the_urdf(tmp_path):
    (tmp_path / "red.dae").write_text(DAE.format(unit=1, up="Z_UP"))
    one = shape(MeshFile(str(tmp_path / "red.dae")), (0, 0, 1, 1))
    assert color_of(drawn(one)) == as_read((1, 0, 0, 1))


@pytest.mark.parametrize("up", ["Y_UP", "Z_UP"])
def test_collada_unit_is_used_and_up_axis_is_ignored_as_in_rviz(tmp_path, up):
    (tmp_path / "cm.dae").write_text(DAE.format(unit=0.01, up=up))
    mesh = the_mesh(drawn(shape(MeshFile(str(tmp_path / "cm.dae")))))
    assert mesh.bounds == pytest.approx(np.array([(0, 0, 0), (0.1, 0.2, 0.3)]))


def test_collada_file_with_a_missing_material_has_the_urdf_colour(tmp_path):
    lost = DAE.format(unit=1, up="Z_UP").replace('<effect id="e">', '<effect id="other">')
    (tmp_path / "lost.dae").write_text(lost)
    one = shape(MeshFile(str(tmp_path / "lost.dae")), (0, 0, 1, 1))
    assert the_mesh(drawn(one)).bounds.tolist() == [[0, 0, 0], [10, 20, 30]]
    assert color_of(drawn(one)) == as_read((0, 0, 1, 1))


def test_obj_file_is_read_with_its_mtl_file_and_images(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "textures").mkdir()
    picture(tmp_path / "textures" / "green.png")
    (tmp_path / "meshes" / "a.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd ../textures/green.png\n")
    obj = tmp_path / "meshes" / "a.obj"
    obj.write_text(TRIANGLE_OBJ.format("mtllib a.mtl\nusemtl skin\n"))
    mesh = the_mesh(drawn(shape(MeshFile(str(obj)))))
    assert mesh.visual.material.baseColorTexture.size == (8, 4)
    placed = {tuple(point[:2]): tuple(uv) for point, uv in zip(mesh.vertices, mesh.visual.uv, strict=True)}
    assert placed == {(0, 0): (0, 0), (1, 0): (1, 0), (0, 1): (0, 1)}


def test_urdf_texture_is_used_for_a_mesh_without_a_material(tmp_path):
    (tmp_path / "a.obj").write_text(TRIANGLE_OBJ.format(""))
    image = picture(tmp_path / "see through.png", "RGBA")
    one = shape(MeshFile(str(tmp_path / "a.obj")), None, image.as_uri())
    assert the_mesh(drawn(one)).visual.material.baseColorTexture.mode == "RGBA"


def test_texture_is_used_for_primitives_and_a_missing_one_is_reported(tmp_path):
    image = picture(tmp_path / "wood.png")
    assert the_mesh(drawn(shape(Box((1, 1, 1)), None, str(image)))).visual.material.baseColorTexture
    gone = shape(Box((1, 1, 1)), (1, 0, 0, 1), str(tmp_path / "gone.png"))
    assert color_of(drawn(gone)) == as_read((1, 0, 0, 1))
    missing = Meshes().missing_texture(gone, HERE)
    assert missing is not None
    assert missing.searched == (str(tmp_path),)


def test_large_images_are_reduced_to_2048_pixels(tmp_path):
    image = picture(tmp_path / "wide.png", size=(5000, 1000))
    mesh = the_mesh(drawn(shape(Box((1, 1, 1)), None, str(image))))
    assert max(mesh.visual.material.baseColorTexture.size) == 2048


def test_equal_shapes_share_one_copy_and_each_file_is_read_once(tmp_path):
    path = tmp_path / "box.stl"
    trimesh.creation.box().export(path)
    meshes = Meshes()
    first = drawn(shape(MeshFile(str(path))), meshes)
    grey = drawn(shape(MeshFile(str(path))), meshes, over=(0.5, 0.5, 0.5, 0.5))
    path.unlink()
    path.write_bytes(b"nothing")
    again = drawn(shape(MeshFile(str(path), (2, 2, 2))), meshes)
    assert again.glb is first.glb
    assert grey.glb is not first.glb


@pytest.mark.parametrize("ending", ["dae", "obj", "stl", "ply", "glb"])
@pytest.mark.parametrize("content", [b"", b"solid nothing", bytes(200), b"<COLLADA/>"])
def test_unreadable_mesh_file_is_reported_as_missing(tmp_path, ending, content):
    path = tmp_path / f"bad.{ending}"
    path.write_bytes(content)
    missing = Meshes().load(shape(MeshFile(str(path))), base=HERE)
    assert isinstance(missing, MissingFile)
    assert missing.reason


@pytest.mark.parametrize("geometry", [Box((0, 0, 0)), Cylinder(0, 1), Sphere(0), Box((1e300, 1, 1))])
def test_primitive_without_finite_size_is_reported_as_missing(geometry):
    missing = Meshes().load(shape(geometry))
    assert isinstance(missing, MissingFile)
    assert missing.uri.endswith("of link 'base'")


def test_unsupported_format_error_lists_supported_formats(tmp_path):
    (tmp_path / "old.mesh").write_bytes(b"ogre")
    missing = Meshes().load(shape(MeshFile(str(tmp_path / "old.mesh"))), base=HERE)
    assert isinstance(missing, MissingFile)
    assert "'.mesh' is not supported; supported are .dae, .glb" in missing.reason


@pytest.mark.robots
@pytest.mark.parametrize(
    "name", ["panda", "ur5", *(pytest.param(name, marks=pytest.mark.soak) for name in ("talos", "anymal_c"))]
)
@pytest.mark.long
def test_all_meshes_of_known_robots_are_found(name):
    meshes = Meshes()
    for one in read_shapes(load_model(name))[0]:
        assert not isinstance(meshes.load(one), MissingFile)
        assert meshes.missing_texture(one) is None


def painted(tmp_path: Path, meshes: Meshes, shade: float) -> MeshAsset:
    """A mesh of some kilobytes in a shade of grey."""
    path = tmp_path / "ball.stl"
    if not path.exists():
        trimesh.creation.icosphere(3).export(path)
    return drawn(shape(MeshFile(str(path)), (shade, shade, shade, 1.0)), meshes)


def test_unused_colour_copies_are_freed(tmp_path):
    meshes = Meshes()
    gone = [weakref.ref(painted(tmp_path, meshes, k / 100).copy) for k in range(100)]
    gc.collect()
    assert [one() for one in gone if one() is not None] == []


def test_colour_copies_beyond_the_memory_limit_share_the_first_colour(tmp_path):
    size = len(painted(tmp_path, Meshes(), 0.0).glb)
    meshes = Meshes(copied_bytes=10 * size)
    drawings = [painted(tmp_path, meshes, k / 100) for k in range(100)]
    copies = {one.copy for one in drawings}
    assert 5 <= len(copies) <= 11
    defects = [one.defect for one in drawings if one.defect is not None]
    assert len(defects) == 100 - len(copies)
    assert "drawn in another colour" in defects[0].reason
    # The first copy of another mesh is not limited, and unused copies make room again.
    assert drawn(shape(Box((1, 1, 1))), meshes).defect is None
    del drawings, copies
    gc.collect()
    assert painted(tmp_path, meshes, 0.995).defect is None


def test_geometry_cache_keeps_the_most_recently_used_within_its_limit(tmp_path):
    size = len(painted(tmp_path, Meshes(), 0.0).glb)
    meshes = Meshes(kept_bytes=2 * size)
    for k in range(20):
        for solid in (Box((1, 1, k)), Sphere(1.0 + k), Cylinder(1.0 + k, 1.0)):
            meshes.load(shape(solid))
        painted(tmp_path, meshes, 0.5)
    assert meshes.kept_byte_count <= 2 * size
    (tmp_path / "ball.stl").write_bytes(b"nothing")
    assert painted(tmp_path, meshes, 0.7).defect is None
