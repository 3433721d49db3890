"""Meshes of one robot on the nodes of its links, and what they share with instanced meshes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.model.geometry import Color, Shape
from zstate.view.mesh_loader import LoadedMesh, MeshLoader, MeshRequest
from zstate.view.mesh_paths import MissingFile
from zstate.view.meshes import MeshAsset
from zstate.view.scene.frame_nodes import FrameNodes, in_frame

RenderStyle = Literal["visual", "collision", "stale"]

STYLE_COLORS: dict[RenderStyle, Color | None] = {
    "visual": None,
    "collision": (0.98, 0.55, 0.12, 0.42),
    "stale": (0.55, 0.57, 0.60, 0.38),
}
"""The one colour of each style; None for the colours of the shapes. Stale robots have grey visuals."""


@dataclass(eq=False)
class MeshNode:
    """One shape in one style; ``asset`` is None until it is loaded."""

    shape: Shape
    name: str
    asset: MeshAsset | None = None


Node = TypeVar("Node", bound=MeshNode)


class StyledMeshes(Generic[Node]):
    """The shapes of a robot as ``nodes`` by style; the meshes of a style are loaded on its first request.

    ``version`` grows with each loaded mesh, ``missing`` are the files that cannot be drawn.
    """

    def __init__(
        self,
        loader: MeshLoader,
        shapes: Sequence[Shape],
        base: Path | None,
        node_type: Callable[[Shape, str], Node],
    ) -> None:
        self.nodes: dict[RenderStyle, list[Node]] = {}
        for style in STYLE_COLORS:
            role = "collision" if style == "collision" else "visual"
            own = [shape for shape in shapes if shape.role == role]
            self.nodes[style] = [node_type(shape, f"{style[0]}{k}") for k, shape in enumerate(own)]
        self.missing: list[MissingFile] = []
        self.version = 0
        self.requested: set[RenderStyle] = set()
        self._loader = loader
        self._base = base
        self._requests: dict[MeshRequest, Node] = {}

    def request(self, style: RenderStyle) -> None:
        """Load the meshes of a style, once."""
        if style not in self.requested:
            self.requested.add(style)
            color = STYLE_COLORS[style]
            requests = {MeshRequest(node.shape, color, self._base): node for node in self.nodes[style]}
            self._requests |= requests
            self._loader.request(list(requests))

    def receive(self, loaded: LoadedMesh) -> bool:
        """Use a loaded mesh; False if it was requested for other meshes."""
        node = self._requests.pop(loaded.request, None)
        if node is None:
            return False
        self.version += 1
        if isinstance(loaded.asset, MeshAsset):
            node.asset = loaded.asset
        for one in (loaded.asset, *loaded.defects):
            if isinstance(one, MissingFile) and one not in self.missing:
                self.missing.append(one)
        return True

    def cancel(self) -> None:
        """Drop all requests."""
        self._loader.cancel(self._requests)
        self._requests.clear()

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """The link of each loaded visual, with the corners of its bounding box in the link (8, 3) [m]."""
        for node in self.nodes["visual"]:
            if node.asset is not None:
                yield node.shape.link, in_frame(node.shape.origin, node.asset.corners())


@dataclass(eq=False)
class _LinkNode(MeshNode):
    path: str | None = None
    handle: viser.GlbHandle | None = None


class RobotMeshes:
    """Draws the shapes of one robot on the nodes of its links.

    ``base`` is the folder of its URDF file, if the user named one. A mesh is removed with its node, so all
    meshes are checked when nodes change.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        loader: MeshLoader,
        robot: str,
        shapes: Sequence[Shape],
        base: Path | None = None,
    ) -> None:
        self._scene = scene
        self._robot = robot
        self.shapes = shapes
        self.base = base
        self.meshes = StyledMeshes(loader, shapes, base, _LinkNode)
        self._drawn: tuple[int, int, frozenset[RenderStyle]] | None = None

    @property
    def frames(self) -> set[str]:
        """The frames whose nodes carry a shape."""
        return {f"{self._robot}/{shape.link}" for shape in self.shapes}

    def show(self, nodes: FrameNodes, styles: set[RenderStyle]) -> None:
        """Draw the robot in these styles, and in no others."""
        for style in self.meshes.nodes:
            if style in styles:
                self.meshes.request(style)
        state = nodes.version, self.meshes.version, frozenset(styles)
        if state != self._drawn:
            self._drawn = state
            for style, meshes in self.meshes.nodes.items():
                for mesh in meshes:
                    if mesh.asset is not None:
                        self._draw(mesh, mesh.asset, nodes, style in styles)

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """The frame of each loaded visual, with the corners of its bounding box in it (8, 3) [m]."""
        return ((f"{self._robot}/{link}", corners) for link, corners in self.meshes.corners())

    def remove(self, nodes: FrameNodes) -> None:
        """Remove all meshes."""
        for meshes in self.meshes.nodes.values():
            for mesh in meshes:
                path = nodes.paths.get(f"{self._robot}/{mesh.shape.link}")
                if mesh.handle is not None and path == mesh.path:
                    mesh.handle.remove()
        self.meshes.cancel()

    def _draw(self, mesh: _LinkNode, asset: MeshAsset, nodes: FrameNodes, is_on: bool) -> None:
        frame = f"{self._robot}/{mesh.shape.link}"
        path = nodes.paths.get(frame)
        if mesh.path != path:
            mesh.path, mesh.handle = path, None
        if path is None:
            return
        visible = is_on and nodes.is_shown(frame)
        if mesh.handle is not None:
            mesh.handle.visible = visible
        elif is_on:
            x, y, z, qx, qy, qz, qw = mesh.shape.origin
            mesh.handle = self._scene.add_glb(
                f"{path}/{mesh.name}",
                asset.glb,
                scale=asset.scale,
                position=(x, y, z),
                wxyz=(qw, qx, qy, qz),
                visible=visible,
            )
