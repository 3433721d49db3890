"""The wheels of a robot by its model: what the table [diff_drive] would have.

Wheels are continuous joints about an axis across the base, at places that mirror each other. Which of them
turn with the ground, and how much skid steering turns less than its wheels say, no model has: it is a
proposal to check.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from zstate import se3
from zstate.checks import Floats
from zstate.model.geometry import Cylinder, Sphere, read_shapes
from zstate.model.kinematics import Kinematics
from zstate.model.robot import Joint, RobotModel

_ACROSS = 0.99
"""The part of an axle that is along the y axis of the base."""
_NEAR = 0.01
"""[m] What mirrors the other side is as near."""


class ProposedWheels(NamedTuple):
    """Names of joints on the left and right, from rear to front, and lengths [m].

    ``radius`` None is not in the model; ``radius_from`` tells where it is from. ``track`` is the distance of
    left and right, ``length`` that of the first and last axle, 0 of one. ``frame`` is a link in the middle
    between all, None for the base. ``remarks`` are doubts.
    """

    left: tuple[str, ...]
    right: tuple[str, ...]
    radius: float | None
    radius_from: str
    track: float
    length: float
    frame: str | None
    remarks: tuple[str, ...]

    @property
    def turning_track(self) -> float:
        """The track that turns as skid steering does, if all wheels carry the same [m].

        The moment of Coulomb's friction of four wheels about their middle is zero for it.
        """
        return self.track * (1.0 + (self.length / self.track) ** 2)


class _Wheel(NamedTuple):
    joint: Joint
    place: Floats
    """The position of its middle in the base, (3,) [m]."""
    is_backwards: bool


def proposed_wheels(model: RobotModel, base: str) -> ProposedWheels | None:
    """The wheels of ``model``, seen from the link ``base``; None if it has none that mirror each other."""
    poses = dict(zip(model.links, Kinematics(model).link_poses(model.neutral), strict=True))
    base_from_root = np.linalg.inv(se3.to_matrix(poses[base]))
    places = {link: base_from_root @ se3.to_matrix(pose) for link, pose in poses.items()}
    moving = {joint.child for joint in model.joints if joint.type != "fixed"}
    above = {joint.child: joint.parent for joint in model.joints}
    wheels: list[_Wheel] = []
    is_steered = False
    for joint in model.driven_joints:
        if joint.type != "continuous":
            continue
        axis = places[joint.child][:3, :3] @ joint.axis
        if abs(axis[1]) < _ACROSS * math.sqrt(axis @ axis):
            continue
        if not moving.isdisjoint(_ancestors(joint.parent, above)):
            is_steered = True
            continue
        wheels.append(_Wheel(joint, places[joint.child][:3, 3], bool(axis[1] < 0.0)))
    left = sorted((one for one in wheels if one.place[1] > _NEAR), key=_ahead)
    right = sorted((one for one in wheels if one.place[1] < -_NEAR), key=_ahead)
    if not left or not _are_mirrored(left, right):
        return None
    middle = np.mean([one.place for one in (*left, *right)], axis=0)
    frame = _link_at(middle, base, places, moving, above)
    radius, radius_from = _radius(model, [one.joint.child for one in (*left, *right)], middle, base)
    remarks = [
        f"{one.joint.name} turns about an axis to the right: its positions count backwards"
        for one in wheels
        if one.is_backwards
    ]
    if frame is None and math.hypot(middle[0], middle[1]) > _NEAR:
        remarks.append(
            f"their middle is {middle[0]:.3f} m ahead and {middle[1]:.3f} m to the left of {base}: `frame` "
            "needs a link there"
        )
    if is_steered:
        remarks.append("other wheels are steered, or are casters: [ackermann] may be what it has")
    track = float(np.mean([one.place[1] for one in left]) - np.mean([one.place[1] for one in right]))
    return ProposedWheels(
        tuple(one.joint.name for one in left),
        tuple(one.joint.name for one in right),
        radius,
        radius_from,
        track,
        float(left[-1].place[0] - left[0].place[0]),
        frame,
        tuple(remarks),
    )


def _ahead(wheel: _Wheel) -> float:
    return float(wheel.place[0])


def _are_mirrored(left: list[_Wheel], right: list[_Wheel]) -> bool:
    mirror = (1.0, -1.0, 1.0)
    return len(left) == len(right) and all(
        np.abs(one.place - other.place * mirror).max() < _NEAR for one, other in zip(left, right, strict=True)
    )


def _ancestors(link: str, above: Mapping[str, str]) -> Iterable[str]:
    yield link
    while link in above:
        link = above[link]
        yield link


def _link_at(
    place: Floats, base: str, places: Mapping[str, Floats], moving: set[str], above: Mapping[str, str]
) -> str | None:
    """A link that is fixed on the base at x and y of ``place``; None if it is the base, or there is none."""
    for link in (base, *places):
        is_there = float(np.hypot(*(places[link][:2, 3] - place[:2]))) < _NEAR
        is_level = np.abs(places[link][:3, :3] - np.eye(3)).max() < 1e-3
        if is_there and is_level and moving.isdisjoint(_ancestors(link, above)):
            return None if link == base else link
    return None


def _radius(model: RobotModel, links: list[str], middle: Floats, base: str) -> tuple[float | None, str]:
    """The radius of wheels [m], and where it is from."""
    shapes, _ = read_shapes(model)
    radii = [
        shape.geometry.radius
        for shape in shapes
        if shape.link in links and isinstance(shape.geometry, Cylinder | Sphere)
    ]
    if radii:
        return max(radii), "of their shape in the model"
    if base.endswith("footprint") and middle[2] > 0.0:
        return float(middle[2]), f"the height of the axle above {base}"
    return None, ""
