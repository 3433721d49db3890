"""Robots: which are drawn each for itself, and which as a fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TypeAlias

import numpy as np
import viser
from numpy.typing import NDArray

from zstate.buffer.snapshot import FrameTable, Poses
from zstate.model.shapes import Shape
from zstate.view.geometry.paths import Missing
from zstate.view.scene.body import Body
from zstate.view.scene.dress import Dress
from zstate.view.scene.fleet import Fleet
from zstate.view.scene.nodes import Nodes
from zstate.view.scene.workshop import Workshop

# What the robots of a fleet share: shapes, and the folder of the URDF file, if the user named that.
_Kind: TypeAlias = tuple[tuple[Shape, ...], Path | None]

_FLEET = 4  # so many robots that look the same are one


class Robots:
    """The bodies of all robots. ``frames`` are those on whose nodes something of them hangs."""

    def __init__(self, scene: viser.SceneApi, workshop: Workshop) -> None:
        self._scene = scene
        self._workshop = workshop
        self._bodies: dict[str, Body] = {}
        self._fleets: dict[_Kind, Fleet] = {}
        self._made = 0
        self.frames: frozenset[str] = frozenset()

    def set(self, name: str, shapes: tuple[Shape, ...], nodes: Nodes, base: Path | None = None) -> None:
        """Draw a robot, in place of an earlier one of that name; ``base`` as for a Body."""
        self.remove(name, nodes)
        kind = shapes, base
        alike = [robot for robot, body in self._bodies.items() if (body.shapes, body.base) == kind]
        if kind in self._fleets or len(alike) + 1 >= _FLEET:
            for robot in alike:
                self._bodies.pop(robot).remove(nodes)
            self._fleet(kind).robots |= dict.fromkeys([*alike, name])
        else:
            self._bodies[name] = Body(self._scene, self._workshop, name, shapes, base)
        self._look_at_frames()

    def remove(self, name: str, nodes: Nodes) -> None:
        """Draw a robot no more; without one of that name, do nothing."""
        body = self._bodies.pop(name, None)
        if body is not None:
            body.remove(nodes)
        for kind, fleet in list(self._fleets.items()):
            fleet.robots.pop(name, None)
            if not fleet.robots:
                fleet.remove()
                del self._fleets[kind]
        self._look_at_frames()

    def missing(self, name: str) -> Sequence[Missing]:
        """What cannot be drawn of a robot."""
        if name in self._bodies:
            return self._bodies[name].missing
        fleets = [fleet for fleet in self._fleets.values() if name in fleet.robots]
        return fleets[0].missing if fleets else ()

    def show(
        self, nodes: Nodes, tree: FrameTable, placed: Poses, dresses: Callable[[str], set[Dress]]
    ) -> None:
        """Draw each robot in its dresses, with all that the workshop has made since."""
        for made in self._workshop.fetch():
            any(one.take(made) for one in chain(self._bodies.values(), self._fleets.values()))
        for name, body in self._bodies.items():
            body.wear(dresses(name))
            body.hang(nodes)
        for fleet in self._fleets.values():
            fleet.show(tree, placed, {name: dresses(name) for name in fleet.robots})

    def corners(self) -> Iterator[tuple[str, NDArray[np.float64]]]:
        """The frames of all visuals that are known, each with the corners of the box around it (8, 3)."""
        return chain.from_iterable(one.corners() for one in (*self._bodies.values(), *self._fleets.values()))

    def _fleet(self, kind: _Kind) -> Fleet:
        fleet = self._fleets.get(kind)
        if fleet is None:
            self._made += 1
            shapes, base = kind
            fleet = Fleet(self._scene, self._workshop, shapes, f"/fleets/{self._made}", base)
            self._fleets[kind] = fleet
        return fleet

    def _look_at_frames(self) -> None:
        self.frames = frozenset(chain.from_iterable(body.frames for body in self._bodies.values()))
