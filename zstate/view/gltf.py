"""Binary glTF 2.0 files of meshes, in their own or in other colours.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. Its colours are linear, those of URDF, COLLADA
and OBJ are sRGB. The points stay as they are, z up.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zstate.model.geometry import Color
from zstate.view.mesh_geometry import Mesh, MeshMaterial

GREY: Color = (0.74, 0.75, 0.77, 1.0)
"""The colour of a mesh without a material."""

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123}
_VERTICES, _INDICES = 34962, 34963
_PNG = b"\x89PNG"
_ROUGHNESS = 0.65


class Glb:
    """Meshes packed once, for files in several colours; meshes with the same material are joined."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self._materials: list[tuple[MeshMaterial | None, bool]] = []
        self._primitives: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._binary = bytearray()
        self.triangle_count = 0
        for mesh in _joined(meshes):
            self._add(mesh)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """The lowest and the highest coordinates of its points: (2, 3) [m]; needs at least one point."""
        boxes = [one for one in self._accessors if "min" in one]
        return np.array([np.min([one["min"] for one in boxes], 0), np.max([one["max"] for one in boxes], 0)])

    @property
    def byte_count(self) -> int:
        """Size in memory [bytes], the least size of a file."""
        images = {material.image for material, _ in self._materials if material and material.image}
        return len(self._binary) + sum(map(len, images))

    def to_bytes(self, missing: MeshMaterial, over: Color | None) -> bytes:
        """The glTF file; meshes without a material have ``missing``, or all have the colour ``over``."""
        materials: list[MeshMaterial] = []
        for own, has_uv in self._materials:
            material = missing if own is None else own
            if over is not None or not has_uv:
                material = MeshMaterial(over or material.color)
            materials.append(material)
        images = list(dict.fromkeys(material.image for material in materials if material.image is not None))
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
            "materials": [_material(material, images) for material in materials],
        }
        if images:
            document["images"] = [
                {"bufferView": first + k, "mimeType": "image/png" if image.startswith(_PNG) else "image/jpeg"}
                for k, image in enumerate(images)
            ]
            document["textures"] = [{"source": k} for k in range(len(images))]
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(binary)
        head = struct.pack("<III", _MAGIC, 2, size) + struct.pack("<II", len(text), _JSON)
        return head + text + struct.pack("<II", len(binary), _BINARY) + bytes(binary)

    def _add(self, mesh: Mesh) -> None:
        attributes = {
            "POSITION": self._array(mesh.points, _VERTICES, bounded=True),
            "NORMAL": self._array(mesh.normals(), _VERTICES),
        }
        if mesh.uv is not None:
            # glTF counts from the upper edge of an image.
            attributes["TEXCOORD_0"] = self._array(mesh.uv * (1, -1) + (0, 1), _VERTICES)
        if mesh.colors is not None:
            colors = mesh.colors / 255.0
            colors[:, :3] = _linear(colors[:, :3])
            attributes["COLOR_0"] = self._array(colors.astype(np.float32), _VERTICES)
        self.triangle_count += len(mesh.triangles)
        # The largest index of a type means primitive restart.
        narrow = np.uint16 if len(mesh.points) < 0xFFFF else np.uint32
        rows = self._array(mesh.triangles.reshape(-1, 1).astype(narrow), _INDICES)
        self._primitives.append({"attributes": attributes, "indices": rows, "material": len(self._materials)})
        self._materials.append((mesh.material, mesh.uv is not None))

    def _array(self, array: NDArray[Any], target: Literal[34962, 34963], *, bounded: bool = False) -> int:
        data = array if array.dtype.name in _COMPONENTS else array.astype(np.float32)
        view = {"buffer": 0, "byteOffset": len(self._binary), "byteLength": data.nbytes, "target": target}
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


def _joined(meshes: Iterable[Mesh]) -> list[Mesh]:
    """One mesh for each material: a browser draws few large ones faster than many small ones.

    If one has texture coordinates or colours, all get them: viser draws instances of no others.
    """
    by_material: dict[MeshMaterial | None, list[Mesh]] = {}
    for mesh in meshes:
        if len(mesh.triangles):
            by_material.setdefault(mesh.material, []).append(mesh)
    every = [mesh for group in by_material.values() for mesh in group]
    has_uv = any(one.uv is not None for one in every)
    has_colors = any(one.colors is not None for one in every)
    joined: list[Mesh] = []
    for material, group in by_material.items():
        counts = [len(one.points) for one in group]
        starts = np.cumsum([0, *counts[:-1]])
        rows = [one.triangles + np.uint32(start) for one, start in zip(group, starts, strict=True)]
        uv = [np.zeros((len(one.points), 2), np.float32) if one.uv is None else one.uv for one in group]
        white = [np.full((count, 4), 255, dtype=np.uint8) for count in counts]
        colors = [hue if one.colors is None else one.colors for one, hue in zip(group, white, strict=True)]
        joined.append(
            Mesh(
                np.concatenate([one.points for one in group]),
                np.concatenate(rows).astype(np.uint32),
                material,
                np.concatenate(uv) if has_uv else None,
                np.concatenate(colors) if has_colors else None,
            )
        )
    return joined


def _material(material: MeshMaterial, images: list[bytes]) -> dict[str, Any]:
    red, green, blue, opacity = material.color
    shading: dict[str, Any] = {
        "baseColorFactor": [*_linear(np.array([red, green, blue])).tolist(), opacity],
        "metallicFactor": 0.0,
        "roughnessFactor": _ROUGHNESS,
    }
    if material.image is not None:
        shading["baseColorTexture"] = {"index": images.index(material.image)}
    entry: dict[str, Any] = {"pbrMetallicRoughness": shading, "doubleSided": opacity >= 1.0}
    return entry | ({"alphaMode": "BLEND"} if opacity < 1.0 else {})


def _linear(channels: NDArray[np.float64]) -> NDArray[np.float64]:
    """sRGB to linear light (IEC 61966-2-1)."""
    return np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
