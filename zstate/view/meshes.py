"""Meshes: what the shapes of robots look like, as files that a browser draws."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zstate.model.shapes import Box, Color, Cylinder, MeshFile, Shape, Sphere
from zstate.view.geometry.files import UnreadableFile, read_image, read_mesh
from zstate.view.geometry.glb import GREY, Glb, Paint
from zstate.view.geometry.paths import MeshPaths, Missing
from zstate.view.geometry.primitives import primitive
from zstate.view.geometry.surface import Look

_Source = Path | tuple[Box | Cylinder | Sphere, bool]


@dataclass(frozen=True, eq=False)
class Drawing:
    """A shape as binary glTF, to be drawn ``scale`` times as large along x, y, z.

    Shapes that look the same have the same ``glb``, one object.
    """

    glb: bytes
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)


class Meshes:
    """Reads each file once, however many robots have it. To be used by one thread.

    ``base`` is the folder of the URDF, where it is known: relative names start there.
    """

    def __init__(self, base: Path | None = None) -> None:
        self._paths = MeshPaths(base)
        self._packed: dict[_Source, Glb] = {}
        self._painted: dict[tuple[_Source, Paint], bytes] = {}

    def draw(self, shape: Shape, over: Color | None = None) -> Drawing | Missing:
        """The shape in its own colours, or all ``over`` in one; or why it cannot be drawn."""
        geometry = shape.geometry
        if not isinstance(geometry, MeshFile):
            source = (geometry, shape.texture is not None)
            if self._pack(source).triangle_count:
                return Drawing(self._paint(source, shape, over))
            name = f"<{type(geometry).__name__.lower()}> of link {shape.link!r}"
            return Missing(name, "there is nothing to see: it has no size, or one beyond all measure")
        found = self._paths.find(geometry.uri)
        if isinstance(found, Missing):
            return found
        try:
            return Drawing(self._paint(found, shape, over), geometry.scale)
        except (OSError, UnreadableFile) as error:
            return Missing(geometry.uri, str(error), (str(found.parent),))

    def missing_texture(self, shape: Shape) -> Missing | None:
        """Why the image that the URDF lays over the shape cannot be drawn, if so: its colour is then."""
        image = None if shape.texture is None else self._image(shape.texture)
        return image if isinstance(image, Missing) else None

    def _paint(self, source: _Source, shape: Shape, over: Color | None) -> bytes:
        paint = Paint(over=over) if over is not None else Paint(self._look(shape))
        done = self._painted.get((source, paint))
        if done is None:
            done = self._painted[source, paint] = self._pack(source).painted(paint)
        return done

    def _pack(self, source: _Source) -> Glb:
        done = self._packed.get(source)
        if done is None:
            surfaces = (
                read_mesh(source) if isinstance(source, Path) else [primitive(source[0], textured=source[1])]
            )
            done = self._packed[source] = Glb(surfaces)
        return done

    def _look(self, shape: Shape) -> Look:
        image = None if shape.texture is None else self._image(shape.texture)
        if isinstance(image, bytes):
            return Look(shape.color or (1.0, 1.0, 1.0, 1.0), image)
        return Look(shape.color or GREY)

    def _image(self, uri: str) -> bytes | Missing:
        found = self._paths.find(uri)
        if isinstance(found, Missing):
            return found
        try:
            return read_image(found)
        except (OSError, UnreadableFile) as error:
            return Missing(uri, str(error), (str(found.parent),))
