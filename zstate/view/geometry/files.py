"""Meshes read from files, with their materials. The one place that knows trimesh and Pillow."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.units import unit_conversion

from zstate.view.geometry.mending import without_lost_materials
from zstate.view.geometry.smoothing import smooth
from zstate.view.geometry.surface import Look, Surface

FORMATS = {".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl"}
IMAGES = {".bmp", ".gif", ".jpeg", ".jpg", ".png", ".tga", ".tif", ".tiff"}
MAX_BYTES = 512 * 1024 * 1024
_WIDEST_IMAGE = 2048
_load: Any = trimesh.load_scene  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
_INVISIBLE = 0.02  # exporters disagree on whether 0 or 1 is opaque


class UnreadableFile(ValueError):
    """A file that holds no mesh, or no image, that can be drawn."""


def read_mesh(path: Path) -> tuple[Surface, ...]:
    """The surfaces of a mesh file in metres, in the axes of the file. Raises UnreadableFile.

    COLLADA's <unit> is heeded and its <up_axis> is not, as in rviz.
    """
    _check(path, FORMATS)
    try:
        surfaces = _loaded(path, path)
        if not surfaces and path.suffix.lower() == ".dae":
            surfaces = _loaded(path, without_lost_materials(path))
    except Exception as error:  # readers of six formats raise whatever they stumble over
        raise UnreadableFile(f"it cannot be read: {str(error)[:200] or type(error).__name__}") from None
    if not any(len(surface.triangles) for surface in surfaces):
        raise UnreadableFile("there are no triangles in it")
    return surfaces


def read_image(path: Path) -> bytes:
    """An image as JPEG or PNG, at most 2048 wide and high. Raises UnreadableFile."""
    _check(path, IMAGES)
    try:
        with Image.open(path) as image:
            return _encoded(image)
    except Exception as error:  # Pillow's readers raise what they like
        raise UnreadableFile(f"it is no image: {str(error)[:200]}") from None


def _check(path: Path, formats: set[str]) -> None:
    if path.suffix.lower() not in formats:
        known = ", ".join(sorted(formats))
        raise UnreadableFile(f"files of the kind '{path.suffix}' are not read; {known} are")
    if (size := path.stat().st_size) > MAX_BYTES:
        raise UnreadableFile(f"it has {size} bytes; the limit is {MAX_BYTES}")


def _loaded(path: Path, data: Path | io.BytesIO) -> tuple[Surface, ...]:
    """The surfaces of a file whose contents are ``data``; images are found from where it is."""
    kind = path.suffix.lower().removeprefix(".")
    resolver = FilePathResolver(str(path), allow_anywhere=True)
    scene: Any = _load(data, file_type=kind, resolver=resolver, process=kind == "stl")
    return tuple(_surfaces(scene))


def _surfaces(scene: Any) -> Iterator[Surface]:
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        if len(getattr(mesh, "faces", ())):
            yield _surface(mesh, np.asarray(matrix, dtype=np.float64) * _in_metres(mesh))


def _in_metres(mesh: Any) -> NDArray[np.float64]:
    scale = 1.0 if mesh.units is None else unit_conversion(mesh.units, "meters")
    return np.array([[scale], [scale], [scale], [1.0]])


def _surface(mesh: Any, matrix: NDArray[np.float64]) -> Surface:
    points = np.asarray(mesh.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    # A look at the cache: asked for, trimesh would compute them where the file has none.
    own: Any = mesh._cache.cache.get("vertex_normals")
    normals = None if own is None else np.asarray(own, dtype=np.float64) @ np.linalg.inv(matrix[:3, :3])
    look, uv, colors = _visual(mesh.visual)
    return smooth(points, np.asarray(mesh.faces), look, normals=normals, uv=uv, colors=colors)


def _visual(visual: Any) -> tuple[Look | None, NDArray[np.float64] | None, NDArray[np.uint8] | None]:
    """The look of a mesh, where its points lie in the image, and their own colours."""
    if visual.kind in {"vertex", "face"}:
        return Look((1.0, 1.0, 1.0, 1.0)), None, np.asarray(visual.vertex_colors, dtype=np.uint8)
    material = getattr(visual, "material", None)
    if material is None:
        return None, None, None
    look = _look(material)
    # Without a look of its own, an image of the URDF may be laid over it.
    is_covered = visual.uv is not None and (look is None or look.image is not None)
    return look, np.asarray(visual.uv, dtype=np.float64) if is_covered else None, None


def _look(material: Any) -> Look | None:
    if hasattr(material, "baseColorFactor"):
        factor, image = material.baseColorFactor, material.baseColorTexture
    elif getattr(material, "_name", None) is None:
        return None  # made up by trimesh for an OBJ file that has places in an image, and no material
    else:
        factor, image = material.diffuse, material.image
    given = (1.0,) * 4 if factor is None else (np.asarray(factor, dtype=np.float64) / 255.0).tolist()
    red, green, blue, opacity = given
    color = (red, green, blue, opacity if opacity > _INVISIBLE else 1.0)
    return Look(color, None if image is None else _encoded(image))


def _encoded(image: Any) -> bytes:
    image.thumbnail((_WIDEST_IMAGE, _WIDEST_IMAGE))
    has_opacity = image.mode in {"RGBA", "LA", "PA"} or "transparency" in image.info
    buffer = io.BytesIO()
    if has_opacity:
        image.convert("RGBA").save(buffer, "PNG", compress_level=3)
    else:
        image.convert("RGB").save(buffer, "JPEG", quality=88)
    return buffer.getvalue()
