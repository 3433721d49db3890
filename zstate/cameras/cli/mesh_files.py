"""Mesh files of robots that simulated cameras see; the view reads them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from zstate.cli.output.console import print_status
from zstate.model.mesh_paths import MeshPaths, MissingFile

if TYPE_CHECKING:
    from zstate.cameras.surfaces import MeshPart
    from zstate.model.geometry import MeshFile


class MeshFiles:
    """Reads mesh files; prints each one that cannot be read once."""

    def __init__(self) -> None:
        self._paths = MeshPaths()
        self._missing: set[str] = set()

    def read(self, geometry: MeshFile) -> Sequence[MeshPart]:
        """The parts of a mesh, scaled; none if it cannot be read."""
        import numpy as np

        from zstate.cameras.surfaces import MeshPart

        try:
            from zstate.view.meshes import UnreadableFile, read_mesh
        except ImportError:
            self._report("meshes", "they need pip install 'zstate[view]'")
            return ()
        path = self._paths.find(geometry.uri)
        if isinstance(path, MissingFile):
            self._report(geometry.uri, path.why)
            return ()
        try:
            meshes = read_mesh(path)
        except (OSError, UnreadableFile) as error:
            self._report(geometry.uri, str(error))
            return ()
        scale = np.array(geometry.scale)
        flip = slice(None, None, -1 if scale.prod() < 0.0 else 1)  # a mirror turns the faces inside out
        return [
            MeshPart(
                mesh.points * scale,
                mesh.triangles[:, flip],
                None if mesh.material is None else mesh.material.color,
            )
            for mesh in meshes
        ]

    def _report(self, name: str, reason: str) -> None:
        if name not in self._missing:
            self._missing.add(name)
            print_status(f"not drawn: {name}: {reason}", event="mesh missing", level="warning")
