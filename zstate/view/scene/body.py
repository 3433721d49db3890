"""Body: the shapes of one robot, hung on the nodes of its links."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.model.shapes import Shape
from zstate.view.geometry.paths import Missing
from zstate.view.meshes import Drawing
from zstate.view.scene.dress import OVER, Dress, role_of
from zstate.view.scene.nodes import Nodes, in_frame
from zstate.view.scene.workshop import Made, Order, Workshop


@dataclass
class _Piece:
    """One shape in one dress: what it looks like once that is known, and where it hangs."""

    shape: Shape
    frame: str
    name: str
    drawing: Drawing | None = None
    path: str | None = None
    handle: viser.GlbHandle | None = None


@dataclass
class _Wardrobe:
    """All shapes in one dress. They are ordered when they are worn for the first time."""

    pieces: list[_Piece]
    worn: bool = False
    ordered: bool = False


@dataclass
class Body:
    """Draws the shapes of ``robot`` in up to three dresses: as they are, for collisions, or all grey.

    ``base`` is the folder of its URDF file, if the user named that.
    What hangs on a node goes with it, so that all is looked through whenever the nodes are others.
    """

    scene: viser.SceneApi
    workshop: Workshop
    robot: str
    shapes: Sequence[Shape]
    base: Path | None = None
    missing: list[Missing] = field(default_factory=list[Missing])

    def __post_init__(self) -> None:
        self._wardrobes: dict[Dress, _Wardrobe] = {dress: self._wardrobe(dress) for dress in OVER}
        self._orders: dict[Order, _Piece] = {}
        self._nodes_version = -1

    def wear(self, dresses: set[Dress]) -> None:
        """Show the body in these, and in no others."""
        for dress, wardrobe in self._wardrobes.items():
            if wardrobe.worn != (dress in dresses):
                wardrobe.worn = not wardrobe.worn
                self._nodes_version = -1
            if wardrobe.worn and not wardrobe.ordered:
                wardrobe.ordered = True
                self._order(dress, wardrobe)

    def take(self, made: Made) -> bool:
        """Take what was ordered for this body; False when it was not."""
        piece = self._orders.pop(made.order, None)
        if piece is None:
            return False
        if isinstance(made.drawing, Missing):
            self._miss(made.drawing)
        else:
            piece.drawing = made.drawing
            self._nodes_version = -1
        for lack in made.lacks:
            self._miss(lack)
        return True

    def hang(self, nodes: Nodes) -> None:
        """Put everything on the nodes as they are now."""
        if self._nodes_version == nodes.version:
            return
        self._nodes_version = nodes.version
        for wardrobe in self._wardrobes.values():
            for piece in wardrobe.pieces:
                if piece.drawing is not None:
                    self._hang(piece, piece.drawing, nodes, wardrobe.worn)

    def remove(self, nodes: Nodes) -> None:
        """Draw it no more."""
        for wardrobe in self._wardrobes.values():
            for piece in wardrobe.pieces:
                if piece.handle is not None and nodes.paths.get(piece.frame) == piece.path:
                    piece.handle.remove()
        self.workshop.cancel(self._orders)
        self._orders.clear()

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """The frames of all visuals that are known, each with the corners of the box around it (8, 3)."""
        for piece in self._wardrobes["visual"].pieces:
            if piece.drawing is not None:
                yield piece.frame, in_frame(piece.shape.origin, piece.drawing.corners())

    @property
    def frames(self) -> set[str]:
        """The frames on whose nodes something hangs, or will."""
        return {f"{self.robot}/{shape.link}" for shape in self.shapes}

    def _wardrobe(self, dress: Dress) -> _Wardrobe:
        shapes = [shape for shape in self.shapes if shape.role == role_of(dress)]
        named = [(shape, f"{self.robot}/{shape.link}") for shape in shapes]
        return _Wardrobe([_Piece(shape, frame, f"{dress[0]}{k}") for k, (shape, frame) in enumerate(named)])

    def _order(self, dress: Dress, wardrobe: _Wardrobe) -> None:
        orders = {Order(piece.shape, OVER[dress], self.base): piece for piece in wardrobe.pieces}
        self._orders |= orders
        self.workshop.order(list(orders))

    def _miss(self, missing: Missing) -> None:
        if missing not in self.missing:
            self.missing.append(missing)

    def _hang(self, piece: _Piece, drawing: Drawing, nodes: Nodes, worn: bool) -> None:
        path = nodes.paths.get(piece.frame)
        if piece.path != path:
            piece.path, piece.handle = path, None
        if path is None:
            return
        visible = worn and nodes.is_shown(piece.frame)
        if piece.handle is not None:
            piece.handle.visible = visible
        elif worn:
            x, y, z, qx, qy, qz, qw = piece.shape.origin
            piece.handle = self.scene.add_glb(
                f"{path}/{piece.name}",
                drawing.glb,
                scale=drawing.scale,
                position=(x, y, z),
                wxyz=(qw, qx, qy, qz),
                visible=visible,
            )
