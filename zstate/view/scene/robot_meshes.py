"""Meshes of one robot on the nodes of its links, and of many identical robots as instances."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.snapshot import FrameTable, Mask, Poses, Rows
from zstate.model.geometry import Color, Shape
from zstate.model.mesh_paths import MissingFile
from zstate.view.meshes import MeshAsset, MeshLoader, MeshRequest
from zstate.view.scene.frames import FrameNodes, in_frame, set_instances, wxyzs

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


class RobotKind(NamedTuple):
    """What identical robots share: their shapes, and the folder of the URDF file if the user named one."""

    shapes: tuple[Shape, ...]
    base: Path | None


class StyledMeshes:
    """The shapes of ``robots`` as ``meshes`` by style; those of a style are loaded when it is first shown.

    ``pending`` meshes are still being loaded, ``version`` grows with each that is loaded, and ``missing`` are
    the files that cannot be drawn.
    """

    def __init__(self, scene: viser.SceneApi, loader: MeshLoader, kind: RobotKind) -> None:
        self.kind = kind
        self.robots: dict[str, None] = {}
        self.meshes: dict[RenderStyle, list[MeshRequest]] = {}
        for style, color in STYLE_COLORS.items():
            role = "collision" if style == "collision" else "visual"
            shapes = [shape for shape in kind.shapes if shape.role == role]
            self.meshes[style] = [MeshRequest(shape, color, kind.base) for shape in shapes]
        self.requested: set[RenderStyle] = set()
        self.missing: list[MissingFile] = []
        self.version = 0
        self._scene = scene
        self._loader = loader
        self.pending: list[MeshRequest] = []

    def load(self, styles: Collection[RenderStyle]) -> None:
        """Request the meshes of the styles, once, and count the meshes that have been loaded."""
        for style, meshes in self.meshes.items():
            if style in styles and style not in self.requested:
                self.requested.add(style)
                self.pending += meshes
                self._loader.request(meshes)
        loaded = [mesh for mesh in self.pending if mesh.is_loaded]
        for mesh in loaded:
            self.pending.remove(mesh)
            self.version += 1
            self.missing += [one for one in mesh.missing if one not in self.missing]

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """The frame of each loaded visual, with the corners of its bounding box in it (8, 3) [m]."""
        for mesh in self.meshes["visual"]:
            if mesh.asset is not None:
                corners = in_frame(mesh.shape.origin, mesh.asset.corners())
                yield from ((f"{robot}/{mesh.shape.link}", corners) for robot in self.robots)


class RobotMeshes(StyledMeshes):
    """Draws the shapes of one robot on the nodes of its links, which are ``frames``.

    A mesh is removed with its node, so all meshes are checked when nodes change.
    """

    def __init__(self, scene: viser.SceneApi, loader: MeshLoader, kind: RobotKind, robot: str) -> None:
        super().__init__(scene, loader, kind)
        self.robots[robot] = None
        self.frames = {f"{robot}/{shape.link}" for shape in kind.shapes}
        self._robot = robot
        # With the paths of the frame nodes that they are on.
        self._handles: dict[MeshRequest, tuple[str, viser.GlbHandle]] = {}
        self._drawn: tuple[int, int, frozenset[RenderStyle]] | None = None

    def show(self, nodes: FrameNodes, styles: set[RenderStyle]) -> None:
        """Draw the robot in these styles, and in no others."""
        self.load(styles)
        state = nodes.version, self.version, frozenset(styles)
        if state != self._drawn:
            self._drawn = state
            for style, meshes in self.meshes.items():
                for k, mesh in enumerate(meshes):
                    if mesh.asset is not None:
                        self._draw(mesh, mesh.asset, f"{style[0]}{k}", nodes, style in styles)

    def _draw(self, mesh: MeshRequest, asset: MeshAsset, name: str, nodes: FrameNodes, is_on: bool) -> None:
        frame = f"{self._robot}/{mesh.shape.link}"
        path = nodes.paths.get(frame)
        node_path, handle = self._handles.get(mesh, (None, None))
        visible = is_on and nodes.is_shown(frame)
        if handle is not None and node_path == path:
            handle.visible = visible
            return
        self._handles.pop(mesh, None)
        if path is not None and is_on:
            x, y, z, qx, qy, qz, qw = mesh.shape.origin
            handle = self._scene.add_glb(
                f"{path}/{name}",
                asset.glb,
                scale=asset.scale,
                position=(x, y, z),
                wxyz=(qw, qx, qy, qz),
                visible=visible,
            )
            self._handles[mesh] = path, handle

    def remove(self, nodes: FrameNodes) -> None:
        """Remove all meshes."""
        for mesh, (path, handle) in self._handles.items():
            if nodes.paths.get(f"{self._robot}/{mesh.shape.link}") == path:
                handle.remove()
        self._loader.cancel(self.pending)


@dataclass(eq=False)
class _Batch:
    """The instances of one mesh; the poses and the visibility that were sent last."""

    handle: viser.BatchedGlbHandle
    sent: NDArray[np.float32]
    shown: Mask


class InstancedMeshes(StyledMeshes):
    """Draws the shapes of ``robots``, one or more, which may change.

    One node for each shape has an instance for each robot: each mesh is sent once, and one message moves a
    shape of all robots. For few robots the tree of frame nodes is cheaper, because most of its shapes need no
    message at all.
    """

    def __init__(self, scene: viser.SceneApi, loader: MeshLoader, kind: RobotKind, path: str) -> None:
        super().__init__(scene, loader, kind)
        self._path = path
        # The rows of the links in ``_tree``, (robots, meshes), for the robots in ``_order``; -1 if missing.
        self._rows: dict[RenderStyle, Rows] = {}
        self._origins = {
            style: np.array([mesh.shape.origin for mesh in meshes]).reshape(-1, 7)
            for style, meshes in self.meshes.items()
        }
        self._tree: FrameTable | None = None
        self._order: tuple[str, ...] = ()
        self._batches: dict[MeshRequest, _Batch] = {}
        self._capacity = 0

    def show(self, tree: FrameTable, placed: Poses, styles: Mapping[str, set[RenderStyle]]) -> None:
        """Draw each robot in its styles, at the poses of its links in the fixed frame."""
        robots = tuple(self.robots)
        if tree is not self._tree or robots != self._order:
            self._tree, self._order = tree, robots
            for style, meshes in self.meshes.items():
                links = [f"{robot}/{mesh.shape.link}" for robot in robots for mesh in meshes]
                rows = np.array([tree.index.get(link, -1) for link in links], dtype=np.intp)
                self._rows[style] = rows.reshape(len(robots), len(meshes))
            if len(robots) > self._capacity:
                self._remove_nodes()
                self._capacity = 1 << (len(robots) - 1).bit_length()
        self.load(set[RenderStyle]().union(*styles.values()))
        for style, meshes in self.meshes.items():
            if meshes and style in self.requested:
                shown = np.array([style in styles[robot] for robot in robots], dtype=np.bool_)
                self._show_style(style, placed, shown)

    def remove(self) -> None:
        """Remove all meshes."""
        self._remove_nodes()
        self._loader.cancel(self.pending)

    def _remove_nodes(self) -> None:
        for batch in self._batches.values():
            batch.handle.remove()
        self._batches.clear()

    def _show_style(self, style: RenderStyle, placed: Poses, shown: Mask) -> None:
        rows = self._rows[style]
        links = np.where((rows >= 0)[:, :, None], placed[rows], np.nan)
        both = se3.compose(se3.unstack(links), se3.unstack(self._origins[style]))
        poses = np.stack(np.broadcast_arrays(*both), axis=-1)
        visible = shown[:, None] & np.isfinite(poses[:, :, 0])
        poses[~visible] = se3.IDENTITY
        for k, mesh in enumerate(self.meshes[style]):
            if mesh.asset is not None and (mesh in self._batches or visible[:, k].any()):
                self._move(mesh, mesh.asset, f"{style[0]}{k}", poses[:, k], visible[:, k])

    def _move(self, mesh: MeshRequest, asset: MeshAsset, name: str, poses: Poses, visible: Mask) -> None:
        # 1 or -1 along each axis: a browser mirrors a whole node, but no instance in it.
        signs = np.where(np.array(asset.scale) < 0.0, -1.0, 1.0)
        batch = self._batches.get(mesh)
        if batch is None:
            # Nothing is visible yet.
            hidden = np.zeros((self._capacity, 3), dtype=np.float32)
            x, y, z = signs.tolist()
            handle = self._scene.add_batched_glb(
                f"{self._path}/{name}",
                asset.glb,
                self._padded(np.empty((0, 4), dtype=np.float32), _UNTURNED),
                hidden,
                batched_scales=hidden,
                scale=(x, y, z),
                lod="off",
            )
            batch = self._batches[mesh] = _Batch(handle, np.empty(0, np.float32), np.empty(0, np.bool_))
        if not np.array_equal(visible, batch.shown):
            batch.shown = visible.copy()
            scales = (visible[:, None] * np.abs(asset.scale)).astype(np.float32)
            batch.handle.batched_scales = self._padded(scales, _NOWHERE)
        # Poses that become the given ones in a node mirrored by the diagonal S: S T S. A rotation keeps its
        # sense about a mirrored axis, and reverses it about the others.
        turns = signs * np.prod(signs)
        mirrored = np.concatenate([poses[:, :3] * signs, poses[:, 3:6] * turns, poses[:, 6:]], axis=1)
        mirrored = mirrored.astype(np.float32)
        if batch.sent.shape != mirrored.shape or np.abs(mirrored - batch.sent).max() > _INVISIBLE:
            batch.sent = mirrored
            rotations = self._padded(wxyzs(mirrored), _UNTURNED)
            set_instances(batch.handle, self._padded(mirrored[:, :3], _NOWHERE), rotations)

    def _padded(self, instances: NDArray[np.float32], filler: tuple[float, ...]) -> NDArray[np.float32]:
        """The instances, then ``filler`` up to the capacity."""
        padded = np.tile(np.array(filler, dtype=np.float32), (self._capacity, 1))
        padded[: len(instances)] = instances
        return padded
