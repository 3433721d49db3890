"""Meshes: what the shapes of robots look like, as files that a browser draws."""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, replace
from pathlib import Path
from weakref import WeakValueDictionary, finalize

import numpy as np
from numpy.typing import NDArray

from zstate.model.shapes import Box, Color, Cylinder, MeshFile, Shape, Sphere
from zstate.view.geometry.files import UnreadableFile, read_image, read_mesh
from zstate.view.geometry.glb import GREY, Corner, Glb, Paint
from zstate.view.geometry.paths import MeshPaths, Missing
from zstate.view.geometry.primitives import primitive
from zstate.view.geometry.surface import Look

_Source = Path | tuple[Box | Cylinder | Sphere, bool]


# A mesh that is drawn again, by another robot or in another colour, is packed from memory, up to here.
_KEPT_BYTES = 256 * 1024 * 1024
# Each colour of a mesh is a copy, here and in every browser: beyond this, copies that are there are shared.
_DRAWN_BYTES = 512 * 1024 * 1024


@dataclass(frozen=True, eq=False)
class Copy:
    """A mesh in one colour, as binary glTF, and between which coordinates [m] it is.

    It is kept while something that looks so is drawn.
    """

    glb: bytes
    low: Corner
    high: Corner


@dataclass(frozen=True, eq=False)
class Drawing:
    """A shape as binary glTF, to be drawn ``scale`` times as large along x, y, z.

    Shapes that look the same have the same ``copy``. ``lack`` says what is not as the URDF has it.
    """

    copy: Copy
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    lack: Missing | None = None

    def corners(self) -> NDArray[np.float64]:
        """The corners of the box around it, scaled: (8, 3) [m]."""
        ends = np.array([self.copy.low, self.copy.high]) * self.scale
        return np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3)

    @property
    def glb(self) -> bytes:
        """What a browser draws."""
        return self.copy.glb


class Meshes:
    """Reads each file once, however many robots have it. To be used by one thread.

    What is kept is bounded, whatever is published: geometry by ``kept_bytes``, with the latest used; and
    coloured copies by ``drawn_bytes``, apart from the first copy of each mesh that is drawn.
    """

    def __init__(self, kept_bytes: int = _KEPT_BYTES, drawn_bytes: int = _DRAWN_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._drawn_bytes = drawn_bytes
        self._paths: dict[Path | None, MeshPaths] = {}
        self._packed: OrderedDict[_Source, Glb] = OrderedDict()
        self.kept_byte_count = 0
        """How large the geometry is that is kept to be drawn again."""
        self._copies: WeakValueDictionary[tuple[_Source, Paint], Copy] = WeakValueDictionary()
        self._firsts: WeakValueDictionary[_Source, Copy] = WeakValueDictionary()
        self._copied_bytes = 0
        # Sizes of copies that nothing draws any more, from whichever thread dropped them.
        self._dropped: deque[int] = deque()

    def draw(self, shape: Shape, over: Color | None = None, base: Path | None = None) -> Drawing | Missing:
        """The shape in its own colours, or all ``over`` in one; or why it cannot be drawn.

        ``base`` is the folder of a URDF file that the user named, see MeshPaths.
        """
        geometry = shape.geometry
        if not isinstance(geometry, MeshFile):
            source = (geometry, shape.texture is not None)
            name = f"<{type(geometry).__name__.lower()}> of link {shape.link!r}"
            if self._pack(source).triangle_count:
                return self._painted(source, shape, over, base, name)
            return Missing(name, "there is nothing to see: it has no size, or one beyond all measure")
        found = self._finder(base).find(geometry.uri)
        if isinstance(found, Missing):
            return found
        try:
            return replace(self._painted(found, shape, over, base, geometry.uri), scale=geometry.scale)
        except (OSError, UnreadableFile) as error:
            return Missing(geometry.uri, str(error), (str(found.parent),))

    def missing_texture(self, shape: Shape, base: Path | None = None) -> Missing | None:
        """Why the image that the URDF lays over the shape cannot be drawn, if so: its colour is then."""
        image = None if shape.texture is None else self._image(shape.texture, base)
        return image if isinstance(image, Missing) else None

    def _painted(
        self, source: _Source, shape: Shape, over: Color | None, base: Path | None, name: str
    ) -> Drawing:
        paint = Paint(over=over) if over is not None else Paint(self._look(shape, base))
        done = self._copies.get((source, paint))
        if done is not None:
            return Drawing(done)
        packed = self._pack(source)
        another = self._firsts.get(source)
        if another is not None and self._in_use() + packed.byte_count > self._drawn_bytes:
            reason = (
                f"in the colour of another: the meshes drawn take {_megabytes(self._drawn_bytes)} already"
            )
            return Drawing(another, lack=Missing(name, reason))
        done = self._copies[source, paint] = Copy(packed.painted(paint), *packed.bounds)
        if another is None:
            self._firsts[source] = done
        self._copied_bytes += len(done.glb)
        finalize(done, self._dropped.append, len(done.glb)).atexit = False
        return Drawing(done)

    def _in_use(self) -> int:
        """The bytes of all copies that something draws."""
        while self._dropped:
            self._copied_bytes -= self._dropped.popleft()
        return self._copied_bytes

    def _pack(self, source: _Source) -> Glb:
        done = self._packed.pop(source, None)
        if done is None:
            surfaces = (
                read_mesh(source) if isinstance(source, Path) else [primitive(source[0], textured=source[1])]
            )
            done = Glb(surfaces)
            self.kept_byte_count += done.byte_count
        self._packed[source] = done
        while self.kept_byte_count > self._kept_bytes and len(self._packed) > 1:
            self.kept_byte_count -= self._packed.popitem(last=False)[1].byte_count
        return done

    def _look(self, shape: Shape, base: Path | None) -> Look:
        image = None if shape.texture is None else self._image(shape.texture, base)
        if isinstance(image, bytes):
            return Look(shape.color or (1.0, 1.0, 1.0, 1.0), image)
        return Look(shape.color or GREY)

    def _image(self, uri: str, base: Path | None) -> bytes | Missing:
        found = self._finder(base).find(uri)
        if isinstance(found, Missing):
            return found
        try:
            return read_image(found)
        except (OSError, UnreadableFile) as error:
            return Missing(uri, str(error), (str(found.parent),))

    def _finder(self, base: Path | None) -> MeshPaths:
        finder = self._paths.get(base)
        if finder is None:
            finder = self._paths[base] = MeshPaths(base)
        return finder


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.0f} MB"
