"""A robot's edges, read from its URDF, and their poses; standard library only.

For systems without a state publisher; deliberately independent of zstate, as a second implementation.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

Vector: TypeAlias = "tuple[float, float, float]"
Rotation: TypeAlias = "tuple[float, float, float, float]"
Pose: TypeAlias = "tuple[float, float, float, float, float, float, float]"
"""x y z qx qy qz qw."""

IDENTITY: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Edge:
    """A joint of the URDF; ``joint`` is the joint that drives it: itself or the mimicked joint."""

    parent: str
    child: str
    kind: str
    origin: Pose
    axis: Vector
    joint: str
    multiplier: float
    offset: float

    @property
    def moves(self) -> bool:
        """Whether it is on /tf rather than on /tf_static."""
        return self.kind != "fixed"

    def pose(self, positions: Mapping[str, float]) -> Pose:
        """The pose of the child in the parent."""
        if not self.moves:
            return self.origin
        position = self.multiplier * positions[self.joint] + self.offset
        if self.kind == "prismatic":
            x, y, z = (part * position for part in self.axis)
            return product(self.origin, (x, y, z, 0.0, 0.0, 0.0, 1.0))
        x, y, z = (part * math.sin(position / 2) for part in self.axis)
        return product(self.origin, (0.0, 0.0, 0.0, x, y, z, math.cos(position / 2)))


def read_edges(urdf: str) -> list[Edge]:
    """All edges, in the order of the file ``urdf``."""
    joints = {joint.get("name", ""): joint for joint in ET.parse(urdf).getroot().findall("joint")}
    return [_edge(joint, *_driving_joint(name, joints)) for name, joint in joints.items()]


def path_between(edges: Sequence[Edge], base: str, tip: str) -> list[str]:
    """The children of the edges from ``base`` down to ``tip``."""
    parents = {edge.child: edge.parent for edge in edges}
    path: list[str] = []
    while tip != base:
        path.append(tip)
        tip = parents[tip]
    return path[::-1]


def compose(poses: Sequence[Pose]) -> Pose:
    """The pose of the last edge's child in the first edge's parent."""
    found = IDENTITY
    for pose in poses:
        found = product(found, pose)
    return found


def product(a: Pose, b: Pose) -> Pose:
    """``a_from_c`` of ``a_from_b`` and ``b_from_c``."""
    ax, ay, az, i, j, k, w = a
    x, y, z, bi, bj, bk, bw = b
    tx, ty, tz = 2 * (j * z - k * y), 2 * (k * x - i * z), 2 * (i * y - j * x)
    return (
        ax + x + w * tx + j * tz - k * ty,
        ay + y + w * ty + k * tx - i * tz,
        az + z + w * tz + i * ty - j * tx,
        w * bi + i * bw + j * bk - k * bj,
        w * bj - i * bk + j * bw + k * bi,
        w * bk + i * bj - j * bi + k * bw,
        w * bw - i * bi - j * bj - k * bk,
    )


def _driving_joint(name: str, joints: Mapping[str, ET.Element]) -> tuple[str, float, float]:
    """The joint that drives ``name``, with multiplier and offset; mimic joints may be chained."""
    multiplier, offset = 1.0, 0.0
    while (mimic := joints[name].find("mimic")) is not None:
        offset += multiplier * float(mimic.get("offset", 0.0))
        multiplier *= float(mimic.get("multiplier", 1.0))
        name = mimic.get("joint", "")
    return name, multiplier, offset


def _edge(joint: ET.Element, driver: str, multiplier: float, offset: float) -> Edge:
    return Edge(
        parent=_child(joint, "parent").get("link", ""),
        child=_child(joint, "child").get("link", ""),
        kind=joint.get("type", ""),
        origin=_origin(joint.find("origin")),
        axis=_axis(joint.find("axis")),
        joint=driver,
        multiplier=multiplier,
        offset=offset,
    )


def _child(joint: ET.Element, name: str) -> ET.Element:
    found = joint.find(name)
    if found is None:
        raise ValueError(f"joint {joint.get('name')!r} has no {name}")
    return found


def _vector(text: str) -> Vector:
    x, y, z = map(float, text.split())
    return x, y, z


def _axis(element: ET.Element | None) -> Vector:
    x, y, z = (1.0, 0.0, 0.0) if element is None else _vector(element.get("xyz", "1 0 0"))
    length = math.sqrt(x * x + y * y + z * z) or 1.0  # fixed joints may have an axis of zeros
    return x / length, y / length, z / length


def _origin(element: ET.Element | None) -> Pose:
    if element is None:
        return IDENTITY
    return (*_vector(element.get("xyz", "0 0 0")), *_from_rpy(*_vector(element.get("rpy", "0 0 0"))))


def _from_rpy(roll: float, pitch: float, yaw: float) -> Rotation:
    """URDF's order: about the fixed x, then y, then z."""
    rotations = ((2, yaw), (1, pitch), (0, roll))
    found = compose([_axis_rotation(axis, angle) for axis, angle in rotations])
    return found[3:]


def _axis_rotation(axis: int, angle: float) -> Pose:
    rotation = [0.0, 0.0, 0.0, math.cos(angle / 2)]
    rotation[axis] = math.sin(angle / 2)
    x, y, z, w = rotation
    return (0.0, 0.0, 0.0, x, y, z, w)
