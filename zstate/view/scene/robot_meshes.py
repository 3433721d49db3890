"""Meshes of one robot on the nodes of its links, and of many identical robots as instances."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Literal, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.snapshot import FrameTable, Mask, Poses, Rows
from zstate.model.geometry import Color, Shape
from zstate.view.mesh_loader import LoadedMesh, MeshLoader, MeshRequest
from zstate.view.mesh_paths import MissingFile
from zstate.view.meshes import MeshAsset
from zstate.view.scene.frame_nodes import FrameNodes, in_frame, set_instances, wxyzs

RenderStyle = Literal["visual", "collision", "stale"]

STYLE_COLORS: dict[RenderStyle, Color | None] = {
    "visual": None,
    "collision": (0.98, 0.55, 0.12, 0.42),
    "stale": (0.55, 0.57, 0.60, 0.38),
}
"""The one colour of each style; None for the colours of the shapes. Stale robots have grey visuals."""

_INVISIBLE = 1e-5  # the precision of a browser
_NOWHERE = (0.0, 0.0, 0.0)
_UNTURNED = (1.0, 0.0, 0.0, 0.0)


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


@dataclass(eq=False)
class _InstancedNode(MeshNode):
    handle: viser.BatchedGlbHandle | None = None
    sent: NDArray[np.float32] | None = None
    shown: Mask | None = None


class InstancedMeshes:
    """Draws the shapes of ``robots``, which may change; ``base`` as for RobotMeshes.

    One node for each shape has an instance for each robot: each mesh is sent once, and one message moves a
    shape of all robots. For few robots the tree of frame nodes is cheaper, because most of its shapes need no
    message at all.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        loader: MeshLoader,
        shapes: Sequence[Shape],
        path: str,
        base: Path | None = None,
    ) -> None:
        self._scene = scene
        self._path = path
        self.meshes = StyledMeshes(loader, shapes, base, _InstancedNode)
        self.robots: dict[str, None] = {}
        # The rows of the links in ``_tree``, (robots, nodes), for the robots in ``_order``.
        self._rows: dict[RenderStyle, Rows] = {}
        self._origins = {
            style: np.array([node.shape.origin for node in nodes]).reshape(-1, 7)
            for style, nodes in self.meshes.nodes.items()
        }
        self._tree: FrameTable | None = None
        self._order: tuple[str, ...] = ()
        self._capacity = 0

    def show(self, tree: FrameTable, placed: Poses, styles: Mapping[str, set[RenderStyle]]) -> None:
        """Draw each robot in its styles, at the poses of its links in the fixed frame."""
        robots = tuple(self.robots)
        if robots and (tree is not self._tree or robots != self._order):
            self._rebuild(tree)
            self._tree, self._order = tree, robots
        for style, nodes in self.meshes.nodes.items():
            shown = np.array([style in styles[robot] for robot in robots], dtype=np.bool_)
            if shown.any():
                self.meshes.request(style)
            if robots and nodes and style in self.meshes.requested:
                self._show_style(style, placed, shown)

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """As of RobotMeshes, for every robot."""
        for link, corners in self.meshes.corners():
            yield from ((f"{robot}/{link}", corners) for robot in self.robots)

    def remove(self) -> None:
        """Remove all meshes."""
        self._remove_nodes()
        self.meshes.cancel()

    def _rebuild(self, tree: FrameTable) -> None:
        """Find the rows of the links, -1 for a missing link, and make room for the instances."""
        for style, nodes in self.meshes.nodes.items():
            rows = [
                [tree.index.get(f"{robot}/{node.shape.link}", -1) for node in nodes] for robot in self.robots
            ]
            self._rows[style] = np.array(rows, dtype=np.intp).reshape(len(self.robots), len(nodes))
        if len(self.robots) > self._capacity:
            self._remove_nodes()
            self._capacity = 1 << (len(self.robots) - 1).bit_length()

    def _remove_nodes(self) -> None:
        for nodes in self.meshes.nodes.values():
            for node in nodes:
                if node.handle is not None:
                    node.handle.remove()
                node.handle = node.sent = node.shown = None

    def _show_style(self, style: RenderStyle, placed: Poses, shown: Mask) -> None:
        nodes, rows = self.meshes.nodes[style], self._rows[style]
        links = np.where((rows >= 0)[:, :, None], placed[rows], np.nan)
        both = se3.compose(se3.unstack(links), se3.unstack(self._origins[style]))
        poses = np.stack(np.broadcast_arrays(*both), axis=-1)
        visible = shown[:, None] & np.isfinite(poses[:, :, 0])
        poses[~visible] = se3.IDENTITY
        for k, node in enumerate(nodes):
            if node.asset is not None and (node.handle is not None or visible[:, k].any()):
                self._move(node, node.asset, poses[:, k], visible[:, k])

    def _move(self, node: _InstancedNode, asset: MeshAsset, poses: Poses, visible: Mask) -> None:
        # 1 or -1 along each axis: a browser mirrors a whole node, but no instance in it.
        signs = np.where(np.array(asset.scale) < 0.0, -1.0, 1.0)
        if node.handle is None:
            # Nothing is visible yet.
            hidden = np.zeros((self._capacity, 3), dtype=np.float32)
            x, y, z = signs.tolist()
            node.handle = self._scene.add_batched_glb(
                f"{self._path}/{node.name}",
                asset.glb,
                self._padded(np.empty((0, 4), dtype=np.float32), _UNTURNED),
                hidden,
                batched_scales=hidden,
                scale=(x, y, z),
                lod="off",
            )
            node.sent = node.shown = None
        if node.shown is None or not np.array_equal(visible, node.shown):
            node.shown = visible.copy()
            scales = (visible[:, None] * np.abs(asset.scale)).astype(np.float32)
            node.handle.batched_scales = self._padded(scales, _NOWHERE)
        # Poses that become the given ones in a node mirrored by the diagonal S: S T S. A rotation keeps its
        # sense about a mirrored axis, and reverses it about the others.
        turns = signs * np.prod(signs)
        mirrored = np.concatenate([poses[:, :3] * signs, poses[:, 3:6] * turns, poses[:, 6:]], axis=1)
        mirrored = mirrored.astype(np.float32)
        sent = node.sent
        if sent is None or sent.shape != mirrored.shape or np.abs(mirrored - sent).max() > _INVISIBLE:
            node.sent = mirrored
            rotations = self._padded(wxyzs(mirrored), _UNTURNED)
            set_instances(node.handle, self._padded(mirrored[:, :3], _NOWHERE), rotations)

    def _padded(self, instances: NDArray[np.float32], filler: tuple[float, ...]) -> NDArray[np.float32]:
        """The instances, then ``filler`` up to the capacity."""
        padded = np.tile(np.array(filler, dtype=np.float32), (self._capacity, 1))
        padded[: len(instances)] = instances
        return padded
