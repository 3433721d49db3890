"""Meshes of identical robots: one node for each shape, with an instance for each robot.

Each mesh is sent once, and one message moves a shape of all robots. For few robots the tree of frame nodes is
cheaper, because most of its shapes need no message at all.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from zstate import se3
from zstate.buffer.snapshot import FrameTable, Mask, Poses, Rows
from zstate.model.geometry import Shape
from zstate.view.mesh_loader import MeshLoader
from zstate.view.meshes import MeshAsset
from zstate.view.scene.frame_nodes import set_instances, wxyzs
from zstate.view.scene.robot_meshes import MeshNode, RenderStyle, StyledMeshes

_INVISIBLE = 1e-5  # the precision of a browser
_NOWHERE = (0.0, 0.0, 0.0)
_UNTURNED = (1.0, 0.0, 0.0, 0.0)


@dataclass(eq=False)
class _InstancedNode(MeshNode):
    handle: viser.BatchedGlbHandle | None = None
    sent: NDArray[np.float32] | None = None
    shown: Mask | None = None


class InstancedMeshes:
    """Draws the shapes of ``robots``, which may change; ``base`` as for RobotMeshes."""

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
        mirrored = _in_mirror(poses, signs).astype(np.float32)
        sent = node.sent
        if sent is None or sent.shape != mirrored.shape or np.abs(mirrored - sent).max() > _INVISIBLE:
            node.sent = mirrored
            rotations = self._padded(wxyzs(mirrored), _UNTURNED)
            set_instances(node.handle, self._padded(mirrored[:, :3], _NOWHERE), rotations)

    def _padded(self, instances: NDArray[np.float32], rest: tuple[float, ...]) -> NDArray[np.float32]:
        """The instances, then ``rest`` up to the capacity."""
        padded = np.tile(np.array(rest, dtype=np.float32), (self._capacity, 1))
        padded[: len(instances)] = instances
        return padded


def _in_mirror(poses: Poses, signs: NDArray[np.float64]) -> Poses:
    """Poses that become the given ones in a node mirrored by the diagonal S: S T S.

    A rotation keeps its sense about a mirrored axis, and reverses it about the others.
    """
    turns = signs * np.prod(signs)
    return np.concatenate([poses[:, :3] * signs, poses[:, 3:6] * turns, poses[:, 6:]], axis=1)
