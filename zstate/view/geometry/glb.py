"""Glb: surfaces as binary glTF 2.0, which browsers draw; and the same in other colours.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. Its colours are linear, those of URDF, COLLADA
and OBJ are sRGB. The points stay as they are, z up.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zstate.model.shapes import Color
from zstate.view.geometry.surface import Look, Surface

GREY: Color = (0.74, 0.75, 0.77, 1.0)
"""What has no colour of its own."""

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123}
_VERTICES, _INDICES = 34962, 34963
_ROUGHNESS = 0.65


_PLAIN = Look(GREY)
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Paint:
    """How a surface is coloured: ``missing`` where the file says nothing, or ``over`` everything."""

    missing: Look = _PLAIN
    over: Color | None = None


class Glb:
    """Surfaces packed once, to be painted in several ways; those that look the same are drawn as one."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self._looks: list[tuple[Look | None, bool]] = []
        self._primitives: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._binary = bytearray()
        self._corner_count = 0
        for surface in _joined(surfaces):
            self._add(surface)

    @property
    def triangle_count(self) -> int:
        """How many triangles are drawn."""
        return self._corner_count // 3

    @property
    def bounds(self) -> tuple[Corner, Corner]:
        """The lowest and the highest coordinates of its points [m]; there have to be some."""
        boxes = [one for one in self._accessors if "min" in one]
        low = np.min([one["min"] for one in boxes], axis=0).tolist()
        high = np.max([one["max"] for one in boxes], axis=0).tolist()
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])

    @property
    def byte_count(self) -> int:
        """How much memory it takes, and what is painted of it at least."""
        images = {look.image for look, _ in self._looks if look is not None and look.image is not None}
        return len(self._binary) + sum(map(len, images))

    def painted(self, paint: Paint) -> bytes:
        """The file, ready to be drawn."""
        looks = [_look(*own, paint) for own in self._looks]
        images = list(dict.fromkeys(look.image for look in looks if look.image is not None))
        binary, views = bytearray(self._binary), list(self._views)
        for image in images:
            views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(image)})
            binary += image + bytes(-len(image) % 4)
        first = len(self._views)
        document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": self._primitives}],
            "accessors": self._accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": len(binary)}],
            "materials": [_material(look, images) for look in looks],
        }
        if images:
            document["images"] = [
                {"bufferView": first + k, "mimeType": _mime_type(image)} for k, image in enumerate(images)
            ]
            document["textures"] = [{"source": k} for k in range(len(images))]
        return _packed(document, bytes(binary))

    def _add(self, surface: Surface) -> None:
        attributes = {
            "POSITION": self._array(surface.points, _VERTICES, bounded=True),
            "NORMAL": self._array(surface.normals(), _VERTICES),
        }
        if surface.uv is not None:
            # glTF counts from the upper edge of an image.
            attributes["TEXCOORD_0"] = self._array(surface.uv * (1, -1) + (0, 1), _VERTICES)
        if surface.colors is not None:
            attributes["COLOR_0"] = self._array(_linear_colors(surface.colors), _VERTICES)
        self._corner_count += surface.triangles.size
        # The largest number of a kind means something else.
        narrow = np.uint16 if len(surface.points) < 0xFFFF else np.uint32
        rows = self._array(surface.triangles.reshape(-1, 1).astype(narrow), _INDICES)
        self._primitives.append({"attributes": attributes, "indices": rows, "material": len(self._looks)})
        self._looks.append((surface.look, surface.uv is not None))

    def _array(self, array: NDArray[Any], target: Literal[34962, 34963], *, bounded: bool = False) -> int:
        data = array if array.dtype.name in _COMPONENTS else array.astype(np.float32)
        view = {
            "buffer": 0,
            "byteOffset": len(self._binary),
            "byteLength": data.nbytes,
            "target": target,
        }
        accessor: dict[str, Any] = {
            "bufferView": len(self._views),
            "componentType": _COMPONENTS[data.dtype.name],
            "count": len(data),
            "type": _TYPES[data.shape[1]],
        }
        if bounded:
            accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        self._binary += data.tobytes() + bytes(-data.nbytes % 4)
        self._views.append(view)
        self._accessors.append(accessor)
        return len(self._accessors) - 1


def _joined(surfaces: Iterable[Surface]) -> list[Surface]:
    """One surface for each look: a browser draws few large ones faster than many small ones.

    All of them have places in an image, and colours, where one has: viser draws instances of no others.
    """
    alike: dict[Look | None, list[Surface]] = {}
    for surface in surfaces:
        if len(surface.triangles):
            alike.setdefault(surface.look, []).append(surface)
    every = [surface for group in alike.values() for surface in group]
    has_uv = any(one.uv is not None for one in every)
    has_colors = any(one.colors is not None for one in every)
    return [_join(group, has_uv, has_colors) for group in alike.values()]


def _join(group: list[Surface], has_uv: bool, has_colors: bool) -> Surface:
    starts = np.cumsum([0, *(len(one.points) for one in group[:-1])])
    rows = [one.triangles + np.uint32(start) for one, start in zip(group, starts, strict=True)]
    return Surface(
        np.concatenate([one.points for one in group]),
        np.concatenate(rows).astype(np.uint32),
        group[0].look,
        np.concatenate([_uv(one) for one in group]) if has_uv else None,
        np.concatenate([_colors(one) for one in group]) if has_colors else None,
    )


def _uv(surface: Surface) -> NDArray[np.float32]:
    return np.zeros((len(surface.points), 2), dtype=np.float32) if surface.uv is None else surface.uv


def _colors(surface: Surface) -> NDArray[np.uint8]:
    white = np.full((len(surface.points), 4), 255, dtype=np.uint8)
    return white if surface.colors is None else surface.colors


def _look(own: Look | None, has_uv: bool, paint: Paint) -> Look:
    if paint.over is not None:
        return Look(paint.over)
    look = paint.missing if own is None else own
    return look if has_uv else Look(look.color)


def _material(look: Look, images: list[bytes]) -> dict[str, Any]:
    red, green, blue, opacity = look.color
    surface: dict[str, Any] = {
        "baseColorFactor": [*_linear(np.array([red, green, blue])).tolist(), opacity],
        "metallicFactor": 0.0,
        "roughnessFactor": _ROUGHNESS,
    }
    if look.image is not None:
        surface["baseColorTexture"] = {"index": images.index(look.image)}
    material: dict[str, Any] = {"pbrMetallicRoughness": surface, "doubleSided": opacity >= 1.0}
    return material | ({"alphaMode": "BLEND"} if opacity < 1.0 else {})


def _linear(channels: NDArray[np.float64]) -> NDArray[np.float64]:
    """sRGB to linear light (IEC 61966-2-1)."""
    return np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)


def _linear_colors(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    scaled = colors / 255.0
    return np.concatenate([_linear(scaled[:, :3]), scaled[:, 3:]], axis=1).astype(np.float32)


def _mime_type(image: bytes) -> str:
    return "image/png" if image.startswith(b"\x89PNG") else "image/jpeg"


def _packed(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    head = struct.pack("<III", _MAGIC, 2, size) + struct.pack("<II", len(text), _JSON)
    return head + text + struct.pack("<II", len(binary), _BINARY) + binary
