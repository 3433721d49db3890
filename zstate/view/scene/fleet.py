"""Fleet: robots that look the same, each shape of theirs one node with an instance for each robot.

A browser is sent each mesh once, and one message moves a shape of all robots. For few robots the tree of
nodes is cheaper, because there most shapes need no message at all.
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
from zstate.model.shapes import Shape
from zstate.view.geometry.paths import Missing
from zstate.view.meshes import Drawing
from zstate.view.scene.dress import OVER, Dress, role_of
from zstate.view.scene.nodes import in_frame
from zstate.view.scene.posing import place
from zstate.view.scene.workshop import Made, Order, Workshop

_UNSEEN = 1e-5  # what a browser draws with has not more digits


@dataclass
class _Batch:
    """One shape in one dress, for all robots."""

    name: str
    drawing: Drawing | None = None
    handle: viser.BatchedGlbHandle | None = None
    sent: NDArray[np.float32] | None = None
    worn: Mask | None = None


class _Wardrobe:
    """All shapes in one dress."""

    def __init__(self, dress: Dress, shapes: Sequence[Shape], path: str) -> None:
        self.dress: Dress = dress
        self.shapes = [shape for shape in shapes if shape.role == role_of(dress)]
        self.origins = np.array([shape.origin for shape in self.shapes]).reshape(-1, 7)
        self.batches = [_Batch(f"{path}/{dress[0]}{k}") for k in range(len(self.shapes))]
        self.ordered = False
        self.rows: Rows = np.empty((0, 0), dtype=np.intp)


class Fleet:
    """Draws the shapes of ``robots``, which come and go; ``base`` is as for a Body."""

    def __init__(
        self,
        scene: viser.SceneApi,
        workshop: Workshop,
        shapes: Sequence[Shape],
        path: str,
        base: Path | None = None,
    ) -> None:
        self._scene = scene
        self._workshop = workshop
        self._base = base
        self._wardrobes = [_Wardrobe(dress, shapes, path) for dress in OVER]
        self._orders: dict[Order, _Batch] = {}
        # What the rows of the links were found in.
        self._tree: FrameTable | None = None
        self._lined_up: tuple[str, ...] = ()
        self._capacity = 0
        self.robots: dict[str, None] = {}
        self.missing: list[Missing] = []

    def take(self, made: Made) -> bool:
        """Take what was ordered for this fleet; False when it was not."""
        batch = self._orders.pop(made.order, None)
        if batch is None:
            return False
        lost = [one for one in (made.drawing, *made.lacks) if isinstance(one, Missing)]
        self.missing += [one for one in lost if one not in self.missing]
        if isinstance(made.drawing, Drawing):
            batch.drawing = made.drawing
        return True

    def show(self, tree: FrameTable, placed: Poses, worn: Mapping[str, set[Dress]]) -> None:
        """Draw each robot in what it wears, at the poses of its links in the fixed frame."""
        if not self.robots:
            return
        robots = tuple(self.robots)
        if tree is not self._tree or robots != self._lined_up:
            self._line_up(tree)
            self._tree, self._lined_up = tree, robots
        for wardrobe in self._wardrobes:
            wears = np.array([wardrobe.dress in worn[robot] for robot in self.robots])
            if wears.any() or wardrobe.ordered:
                self._show(wardrobe, placed, wears)

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """As of a Body, for every robot."""
        (wardrobe,) = (one for one in self._wardrobes if one.dress == "visual")
        for shape, batch in zip(wardrobe.shapes, wardrobe.batches, strict=True):
            if batch.drawing is not None:
                corners = in_frame(shape.origin, batch.drawing.corners())
                yield from ((f"{robot}/{shape.link}", corners) for robot in self.robots)

    def remove(self) -> None:
        """Draw none of them any more."""
        self._remove_nodes()
        self._workshop.cancel(self._orders)
        self._orders.clear()

    def _line_up(self, tree: FrameTable) -> None:
        """Find the rows of the links, -1 where a tree lacks one, and places for as many robots."""
        for wardrobe in self._wardrobes:
            links = [shape.link for shape in wardrobe.shapes]
            rows = [[tree.index.get(f"{robot}/{link}", -1) for link in links] for robot in self.robots]
            wardrobe.rows = np.array(rows, dtype=np.intp).reshape(len(self.robots), len(links))
        if len(self.robots) > self._capacity:
            self._remove_nodes()
            self._capacity = 1 << (len(self.robots) - 1).bit_length()

    def _remove_nodes(self) -> None:
        for wardrobe in self._wardrobes:
            for batch in wardrobe.batches:
                if batch.handle is not None:
                    batch.handle.remove()
                batch.handle = batch.sent = batch.worn = None

    def _show(self, wardrobe: _Wardrobe, placed: Poses, wears: Mask) -> None:
        if not wardrobe.ordered:
            wardrobe.ordered = True
            orders = [Order(shape, OVER[wardrobe.dress], self._base) for shape in wardrobe.shapes]
            self._orders |= dict(zip(orders, wardrobe.batches, strict=True))
            self._workshop.order(orders)
        if not wardrobe.shapes:
            return
        links = np.where((wardrobe.rows >= 0)[:, :, None], placed[wardrobe.rows], np.nan)
        both = se3.compose(se3.columns(links), se3.columns(wardrobe.origins))
        poses = np.stack(np.broadcast_arrays(*both), axis=-1)
        worn = wears[:, None] & np.isfinite(poses[:, :, 0])
        poses[~worn] = se3.IDENTITY
        for k, batch in enumerate(wardrobe.batches):
            if batch.drawing is not None and (batch.handle is not None or worn[:, k].any()):
                self._move(batch, batch.drawing, poses[:, k], worn[:, k])

    def _move(self, batch: _Batch, drawing: Drawing, poses: Poses, worn: Mask) -> None:
        mirrored, sizes = _mirrored(drawing.scale), np.abs(drawing.scale)
        if batch.handle is None:
            self._draw(batch, drawing, len(poses))
        assert batch.handle is not None
        if batch.worn is None or not np.array_equal(worn, batch.worn):
            batch.worn = worn.copy()
            scales = np.zeros((self._capacity, 3), dtype=np.float32)
            scales[: len(worn)] = worn[:, None] * sizes
            batch.handle.batched_scales = scales
        turned = _in_mirror(poses, mirrored).astype(np.float32)
        if (
            batch.sent is None
            or batch.sent.shape != turned.shape
            or np.abs(turned - batch.sent).max() > _UNSEEN
        ):
            batch.sent = turned
            wxyzs = self._all(turned[:, [6, 3, 4, 5]], (1.0, 0.0, 0.0, 0.0))
            place(batch.handle, self._all(turned[:, :3], (0.0, 0.0, 0.0)), wxyzs)

    def _draw(self, batch: _Batch, drawing: Drawing, count: int) -> None:
        """Begin with nothing to be seen; ``_move`` goes on."""
        nowhere = np.zeros((self._capacity, 3), dtype=np.float32)
        x, y, z = _mirrored(drawing.scale).tolist()
        batch.handle = self._scene.add_batched_glb(
            batch.name,
            drawing.glb,
            self._all(np.empty((0, 4), dtype=np.float32), (1.0, 0.0, 0.0, 0.0)),
            nowhere,
            batched_scales=nowhere,
            scale=(x, y, z),
            lod="off",
        )
        batch.sent = batch.worn = None

    def _all(self, instances: NDArray[np.float32], rest: tuple[float, ...]) -> NDArray[np.float32]:
        """The instances, and something for the places that no robot has."""
        places = np.tile(np.array(rest, dtype=np.float32), (self._capacity, 1))
        places[: len(instances)] = instances
        return places


def _mirrored(scale: tuple[float, float, float]) -> NDArray[np.float64]:
    """1 or -1 along each axis: a browser mirrors a whole node, but no instance in it."""
    return np.where(np.array(scale) < 0.0, -1.0, 1.0)


def _in_mirror(poses: Poses, mirrored: NDArray[np.float64]) -> Poses:
    """Poses that become the given ones in a node mirrored by the diagonal S: S T S.

    A turn keeps its sense about an axis along which is mirrored, and changes it about one across.
    """
    turns = mirrored * np.prod(mirrored)
    return np.concatenate([poses[:, :3] * mirrored, poses[:, 3:6] * turns, poses[:, 6:]], axis=1)
