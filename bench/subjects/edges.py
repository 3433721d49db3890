"""A robot's edges as ROS names them, out of its URDF, and their poses; nothing but the standard library.

For systems that have no state publisher; apart from zstate on purpose, as a second opinion.
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
    """A joint of the URDF; ``joint`` is the one whose position moves it, itself or the one it mimics."""

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
        """Of the child in the parent."""
        if not self.moves:
            return self.origin
        position = self.multiplier * positions[self.joint] + self.offset
        if self.kind == "prismatic":
            x, y, z = (part * position for part in self.axis)
            return product(self.origin, (x, y, z, 0.0, 0.0, 0.0, 1.0))
        x, y, z = (part * math.sin(position / 2) for part in self.axis)
        return product(self.origin, (0.0, 0.0, 0.0, x, y, z, math.cos(position / 2)))


def edges_of(urdf: str) -> list[Edge]:
    """All of them, in the order of the file ``urdf``."""
    joints = {joint.get("name", ""): joint for joint in ET.parse(urdf).getroot().findall("joint")}
    return [_edge(joint, *_mover(name, joints)) for name, joint in joints.items()]


def path_between(edges: Sequence[Edge], base: str, tip: str) -> list[str]:
    """The children of the edges from ``base`` down to ``tip``."""
    parents = {edge.child: edge.parent for edge in edges}
    path: list[str] = []
    while tip != base:
        path.append(tip)
        tip = parents[tip]
    return path[::-1]


def composed(poses: Sequence[Pose]) -> Pose:
    """Of the last one's child in the first one's parent."""
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


def _mover(name: str, joints: Mapping[str, ET.Element]) -> tuple[str, float, float]:
    """The joint whose position moves this one, with multiplier and offset; a mimic may follow another."""
    multiplier, offset = 1.0, 0.0
    while (mimic := joints[name].find("mimic")) is not None:
        offset += multiplier * float(mimic.get("offset", 0.0))
        multiplier *= float(mimic.get("multiplier", 1.0))
        name = mimic.get("joint", "")
    return name, multiplier, offset


def _edge(joint: ET.Element, mover: str, multiplier: float, offset: float) -> Edge:
    return Edge(
        parent=_child(joint, "parent").get("link", ""),
        child=_child(joint, "child").get("link", ""),
        kind=joint.get("type", ""),
        origin=_origin(joint.find("origin")),
        axis=_axis(joint.find("axis")),
        joint=mover,
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
    turns = ((2, yaw), (1, pitch), (0, roll))
    found = composed([_turn(place, angle) for place, angle in turns])
    return found[3:]


def _turn(place: int, angle: float) -> Pose:
    rotation = [0.0, 0.0, 0.0, math.cos(angle / 2)]
    rotation[place] = math.sin(angle / 2)
    x, y, z, w = rotation
    return (0.0, 0.0, 0.0, x, y, z, w)
