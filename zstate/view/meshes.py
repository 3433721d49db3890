"""Meshes of shapes as binary glTF, from files or primitives, loaded on a background thread.

The one module that uses trimesh.
"""

from __future__ import annotations

import io
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakValueDictionary, finalize
from xml.etree import ElementTree

import collada  # pyright: ignore[reportMissingTypeStubs]
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.resolvers import FilePathResolver
from trimesh.units import unit_conversion

from zstate.model.geometry import Box, Color, Cylinder, MeshFile, Shape, Sphere
from zstate.model.mesh_paths import MeshPaths, MissingFile
from zstate.view.gltf import GREY, Glb
from zstate.view.mesh_geometry import Mesh, MeshMaterial, primitive, smooth_normals

_T = TypeVar("_T")
_Source = Path | tuple[Box | Cylinder | Sphere, bool]

FORMATS = {".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl"}
IMAGES = {".bmp", ".gif", ".jpeg", ".jpg", ".png", ".tga", ".tif", ".tiff"}
MAX_BYTES = 512 * 1024 * 1024
_WIDEST_IMAGE = 2048
_load: Any = trimesh.load_scene  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
_INVISIBLE = 0.02  # exporters disagree on whether 0 or 1 is opaque
_Collada: Any = collada.Collada  # not typed

# Geometry kept in memory, for other robots and other colours.
_KEPT_BYTES = 256 * 1024 * 1024
# Each colour of a mesh is a copy, here and in every browser. Beyond this size, existing copies are shared.
_COPIED_BYTES = 512 * 1024 * 1024


@dataclass(frozen=True, eq=False)
class Copy:
    """A mesh in one colour, as binary glTF, with its bounds [m]; kept while an asset uses it."""

    glb: bytes
    bounds: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeshAsset:
    """A shape as binary glTF, to be scaled by ``scale`` along x, y, z.

    Shapes with the same appearance share a ``copy``. ``defect`` is a difference from the URDF.
    """

    copy: Copy
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    defect: MissingFile | None = None

    def corners(self) -> NDArray[np.float64]:
        """The corners of its bounding box, scaled: (8, 3) [m]."""
        ends = self.copy.bounds * self.scale
        return np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)

    @property
    def glb(self) -> bytes:
        """The glTF file."""
        return self.copy.glb


class Meshes:
    """Loads meshes; each file is read once for all robots. To be used by one thread.

    Memory is bounded: geometry by ``kept_bytes``, the most recently used first, and coloured copies by
    ``copied_bytes``, apart from the first copy of each mesh in use.
    """

    def __init__(self, kept_bytes: int = _KEPT_BYTES, copied_bytes: int = _COPIED_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._max_copied_bytes = copied_bytes
        self._paths: dict[Path | None, MeshPaths] = {}
        self._packed: OrderedDict[_Source, Glb] = OrderedDict()
        self.kept_byte_count = 0
        """Size of the geometry in memory [bytes]."""
        self._copies: WeakValueDictionary[tuple[_Source, MeshMaterial, Color | None], Copy] = (
            WeakValueDictionary()
        )
        self._firsts: WeakValueDictionary[_Source, Copy] = WeakValueDictionary()
        self._copied_bytes = 0
        # Sizes of copies that are no longer used; appended by any thread.
        self._dropped: deque[int] = deque()

    def load(
        self, shape: Shape, over: Color | None = None, base: Path | None = None
    ) -> MeshAsset | MissingFile:
        """The shape in its own colours, or all in the colour ``over``; or why it cannot be drawn.

        ``base`` is the folder of a URDF file that the user named, see MeshPaths.
        """
        geometry = shape.geometry
        if isinstance(geometry, MeshFile):
            uri, scale = geometry.uri, geometry.scale
            return self._read(
                uri, base, lambda path: replace(self._colored(path, shape, over, base, uri), scale=scale)
            )
        source = (geometry, shape.texture is not None)
        name = f"<{type(geometry).__name__.lower()}> of link {shape.link!r}"
        if self._pack(source).triangle_count:
            return self._colored(source, shape, over, base, name)
        return MissingFile(name, "nothing can be drawn: its size is zero, or not finite")

    def missing_texture(self, shape: Shape, base: Path | None = None) -> MissingFile | None:
        """Why the texture of the shape cannot be loaded; None if it can, or if there is none."""
        image = self._texture(shape, base)
        return image if isinstance(image, MissingFile) else None

    def _colored(
        self, source: _Source, shape: Shape, over: Color | None, base: Path | None, name: str
    ) -> MeshAsset:
        image = self._texture(shape, base) if over is None else None
        if isinstance(image, bytes):
            missing = MeshMaterial(shape.color or (1.0, 1.0, 1.0, 1.0), image)
        else:
            missing = MeshMaterial(GREY if shape.color is None or over is not None else shape.color)
        done = self._copies.get((source, missing, over))
        if done is not None:
            return MeshAsset(done)
        packed = self._pack(source)
        another = self._firsts.get(source)
        while self._dropped:
            self._copied_bytes -= self._dropped.popleft()
        if another is not None and self._copied_bytes + packed.byte_count > self._max_copied_bytes:
            limit = f"{self._max_copied_bytes / 1e6:.0f} MB"
            reason = f"drawn in another colour: the meshes on the page have reached the limit of {limit}"
            return MeshAsset(another, defect=MissingFile(name, reason))
        done = self._copies[source, missing, over] = Copy(packed.to_bytes(missing, over), packed.bounds)
        if another is None:
            self._firsts[source] = done
        self._copied_bytes += len(done.glb)
        finalize(done, self._dropped.append, len(done.glb)).atexit = False
        return MeshAsset(done)

    def _pack(self, source: _Source) -> Glb:
        done = self._packed.pop(source, None)
        if done is None:
            done = Glb(read_mesh(source) if isinstance(source, Path) else [primitive(*source)])
            self.kept_byte_count += done.byte_count
        self._packed[source] = done
        while self.kept_byte_count > self._kept_bytes and len(self._packed) > 1:
            self.kept_byte_count -= self._packed.popitem(last=False)[1].byte_count
        return done

    def _texture(self, shape: Shape, base: Path | None) -> bytes | MissingFile | None:
        """The image of the shape's texture; None without a texture."""
        return None if shape.texture is None else self._read(shape.texture, base, read_image)

    def _read(self, uri: str, base: Path | None, read: Callable[[Path], _T]) -> _T | MissingFile:
        """The result of ``read`` for a file, or why it cannot be read."""
        if base not in self._paths:
            self._paths[base] = MeshPaths(base)
        path = self._paths[base].find(uri)
        if isinstance(path, MissingFile):
            return path
        try:
            return read(path)
        except (OSError, UnreadableFile) as error:
            return MissingFile(uri, str(error), (str(path.parent),))


@dataclass(eq=False)
class MeshRequest:
    """A shape to load; ``over`` and ``base`` as for ``Meshes.load``. Requests compare by identity.

    When it ``is_loaded``, ``asset`` is None if it cannot be drawn, and ``missing`` are the files that it
    lacks: its own, its texture or a copy in its colour.
    """

    shape: Shape
    over: Color | None
    base: Path | None
    asset: MeshAsset | None = None
    missing: tuple[MissingFile, ...] = ()
    is_loaded: bool = False


class MeshLoader:
    """Loads meshes on a background thread that exits when its queue is empty: files do not delay pictures."""

    def __init__(self, meshes: Meshes) -> None:
        self._meshes = meshes
        self._lock = threading.Lock()
        self._queue: list[MeshRequest] = []
        self._running = False

    def request(self, requests: Sequence[MeshRequest]) -> None:
        """Queue requests."""
        with self._lock:
            self._queue += requests
            if self._queue and not self._running:
                self._running = True
                threading.Thread(target=self._run, name="zstate-meshes", daemon=True).start()

    def cancel(self, requests: Sequence[MeshRequest]) -> None:
        """Drop requests that are still queued."""
        with self._lock:
            self._queue = [request for request in self._queue if request not in requests]

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._queue:
                    self._running = False
                    return
                request = self._queue.pop(0)
            texture = None
            try:
                asset = self._meshes.load(request.shape, request.over, request.base)
                if request.over is None:
                    texture = self._meshes.missing_texture(request.shape, request.base)
            except Exception as error:  # one unforeseen file must not stop the others
                asset = MissingFile(str(request.shape.geometry), f"{type(error).__name__}: {error}")
            if isinstance(asset, MeshAsset):
                request.asset, lacks = asset, (texture, asset.defect)
            else:
                lacks = (asset, texture)
            request.missing = tuple(one for one in lacks if one is not None)
            request.is_loaded = True


class UnreadableFile(ValueError):
    """A file without a mesh or an image that can be drawn."""


def read_mesh(path: Path) -> tuple[Mesh, ...]:
    """The meshes of a mesh file in metres, in the axes of the file. Raises UnreadableFile.

    The <unit> of COLLADA is used and its <up_axis> is not, as in rviz.
    """
    _check(path, FORMATS)
    try:
        meshes = _loaded(path, path)
        if not meshes and path.suffix.lower() == ".dae":
            meshes = _loaded(path, strip_missing_materials(path))
    except Exception as error:  # readers of six formats raise exceptions of any type
        raise UnreadableFile(f"it cannot be read: {str(error)[:200] or type(error).__name__}") from None
    if not any(len(mesh.triangles) for mesh in meshes):
        raise UnreadableFile("there are no triangles in it")
    return meshes


def read_image(path: Path) -> bytes:
    """An image as JPEG or PNG, at most 2048 wide and high. Raises UnreadableFile."""
    _check(path, IMAGES)
    try:
        with Image.open(path) as image:
            return _encoded(image)
    except Exception as error:  # Pillow's readers raise exceptions of any type
        raise UnreadableFile(f"it is not an image: {str(error)[:200]}") from None


def _check(path: Path, formats: set[str]) -> None:
    if path.suffix.lower() not in formats:
        known = ", ".join(sorted(formats))
        raise UnreadableFile(f"the format '{path.suffix}' is not supported; supported are {known}")
    if (size := path.stat().st_size) > MAX_BYTES:
        raise UnreadableFile(f"it has {size} bytes; the limit is {MAX_BYTES}")


def _loaded(path: Path, data: Path | io.BytesIO) -> tuple[Mesh, ...]:
    """The meshes in ``data``, the content of ``path``; images are found relative to it."""
    kind = path.suffix.lower().removeprefix(".")
    resolver = FilePathResolver(str(path), allow_anywhere=True)
    scene: Any = _load(data, file_type=kind, resolver=resolver, process=kind == "stl")
    meshes: list[Mesh] = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        mesh = scene.geometry[name]
        if len(getattr(mesh, "faces", ())):
            scale = 1.0 if mesh.units is None else unit_conversion(mesh.units, "meters")
            matrix = np.asarray(transform, dtype=np.float64)[:3] * scale
            points = np.asarray(mesh.vertices, dtype=np.float64) @ matrix[:, :3].T + matrix[:, 3]
            # From the cache: the property would compute normals if the file has none.
            own: Any = mesh._cache.cache.get("vertex_normals")
            normals = (
                None if own is None else np.asarray(own, dtype=np.float64) @ np.linalg.inv(matrix[:, :3])
            )
            material, uv, colors = _visual(mesh.visual)
            faces = np.asarray(mesh.faces)
            meshes.append(smooth_normals(points, faces, material, normals=normals, uv=uv, colors=colors))
    return tuple(meshes)


def _visual(visual: Any) -> tuple[MeshMaterial | None, NDArray[np.float64] | None, NDArray[np.uint8] | None]:
    """Material, texture coordinates and point colours."""
    if visual.kind in {"vertex", "face"}:
        return MeshMaterial((1.0, 1.0, 1.0, 1.0)), None, np.asarray(visual.vertex_colors, dtype=np.uint8)
    if getattr(visual, "material", None) is None:
        return None, None, None
    material = _material(visual.material)
    # Without a material of its own, the URDF may have a texture for it.
    is_covered = visual.uv is not None and (material is None or material.image is not None)
    return material, np.asarray(visual.uv, dtype=np.float64) if is_covered else None, None


def _material(material: Any) -> MeshMaterial | None:
    if hasattr(material, "baseColorFactor"):
        factor, image = material.baseColorFactor, material.baseColorTexture
    elif getattr(material, "_name", None) is None:
        return None  # trimesh adds a material to an OBJ file with texture coordinates and no material
    else:
        factor, image = material.diffuse, material.image
    own = (1.0,) * 4 if factor is None else (np.asarray(factor, dtype=np.float64) / 255.0).tolist()
    red, green, blue, opacity = own
    color = (red, green, blue, opacity if opacity > _INVISIBLE else 1.0)
    return MeshMaterial(color, None if image is None else _encoded(image))


def _encoded(image: Any) -> bytes:
    image.thumbnail((_WIDEST_IMAGE, _WIDEST_IMAGE))
    buffer = io.BytesIO()
    if image.mode in {"RGBA", "LA", "PA"} or "transparency" in image.info:
        image.convert("RGBA").save(buffer, "PNG", compress_level=3)
    else:
        image.convert("RGB").save(buffer, "JPEG", quality=88)
    return buffer.getvalue()


def strip_missing_materials(path: Path) -> io.BytesIO:
    """A COLLADA file without references to materials that cannot be read.

    pycollada leaves out the whole mesh if a material lacks its effect, or the effect its image.
    """
    readable = {f"#{material.id}" for material in _Collada(str(path), ignore=[collada.DaeError]).materials}
    document = ElementTree.parse(path)
    for above in document.iter():
        for one in list(above):
            if one.tag.endswith("instance_material") and one.get("target") not in readable:
                above.remove(one)
    stripped = io.BytesIO()
    document.write(stripped)
    stripped.seek(0)
    return stripped
