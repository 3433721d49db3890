"""Robot model: links, joints and the layout of position vectors, as frozen values.

Positions of a robot are one flat vector in the order of ``RobotModel.joint_names``, the order in
which the URDF names its driven joints. The count of numbers depends on the joint type:

============  =========  =======================================  ==========
type          positions  meaning                                  velocities
============  =========  =======================================  ==========
revolute      1          angle [rad]                              1
continuous    1          angle [rad], any number of turns         1
prismatic     1          travel [m]                               1
planar        3          x, y [m], yaw [rad]                      3
floating      7          pose7: x y z [m], qx qy qz qw            6
fixed, mimic  0          -                                        0
============  =========  =======================================  ==========

Velocities are the rates of these numbers; those of a floating joint are its linear velocity [m/s]
and its angular velocity [rad/s], both in the axes of the joint's own (zero) frame.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from itertools import accumulate
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.format import suggestion_text
from zstate.checks import QUATERNION_TOLERANCE, real_numbers, reduced_to_fields
from zstate.errors import FindingLike, InvalidInput

Pose7 = tuple[float, float, float, float, float, float, float]
Vector3 = tuple[float, float, float]
JointType = Literal["fixed", "revolute", "continuous", "prismatic", "floating", "planar"]

POSITION_COUNTS: dict[JointType, int] = {
    "fixed": 0,
    "revolute": 1,
    "continuous": 1,
    "prismatic": 1,
    "planar": 3,
    "floating": 7,
}
VELOCITY_COUNTS: dict[JointType, int] = {**POSITION_COUNTS, "floating": 6}

_SHOWN_JOINTS = 40
"""The joints in the table of a notebook; larger robots have the most."""

_SEPARATORS = re.compile(r"[^a-z0-9]+")
_COORDINATES = {
    "floating": (".x", ".y", ".z", ".qx", ".qy", ".qz", ".qw"),
    "planar": (".x", ".y", ".yaw"),
}


@dataclass(frozen=True, slots=True)
class DeclaredLimits:
    """Limits of a joint: [rad] or [m], per s, [Nm] or [N], and per s^2. Infinite unless stated."""

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf
    acceleration: float = np.inf
    """A limit of commands: a joint of a URDF has none."""

    def narrowed(self, other: DeclaredLimits) -> DeclaredLimits:
        """The narrower of these limits and ``other``, each."""
        return DeclaredLimits(
            max(self.lower, other.lower),
            min(self.upper, other.upper),
            min(self.velocity, other.velocity),
            min(self.effort, other.effort),
            min(self.acceleration, other.acceleration),
        )


@dataclass(frozen=True, slots=True)
class Mimic:
    """``position = multiplier * position of joint + offset``."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Joint:
    """One edge of the robot, from link ``parent`` to link ``child``.

    ``origin`` is ``parent_from_joint`` as pose7; ``axis`` is the unit axis in the joint's frame.
    ``line`` is its line in the URDF. ``command_limits`` are for commands alone: soft limits, and those of
    <ros2_control>.
    """

    name: str
    type: JointType
    parent: str
    child: str
    origin: Pose7
    axis: Vector3
    limits: DeclaredLimits
    mimic: Mimic | None = None
    line: int | None = None
    command_limits: DeclaredLimits = DeclaredLimits()

    @property
    def driven(self) -> bool:
        """Whether the position vector has numbers for this joint: neither fixed nor a mimic."""
        return self.type != "fixed" and self.mimic is None


@dataclass(frozen=True)
class RobotModel:
    """A robot: ``links`` and ``joints`` in the order of the URDF, which is kept as text, ``urdf``.

    ``name`` is that in the URDF, ``root`` is the link without a parent. ``findings`` are the validator's
    warnings. ``load_model`` returns consistent models; the constructor checks nothing.
    """

    name: str
    root: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    urdf: str
    findings: tuple[FindingLike, ...] = ()

    def __repr__(self) -> str:
        return f"RobotModel({self.name!r}, {len(self.links)} links, {len(self.joint_names)} driven joints)"

    __reduce__ = reduced_to_fields  # without what is cached

    def _repr_html_(self) -> str:
        from zstate._util.html import html_table  # noqa: PLC0415 - for notebooks alone

        headings = ("joint", "type", "parent", "child", "lower", "upper", "velocity", "effort")
        rows = [_shown_cells(joint) for joint in self.driven_joints[:_SHOWN_JOINTS]]
        more = len(self.driven_joints) - len(rows)
        return html_table(repr(self), [*rows, *[(f"and {more} more",)] * bool(more)], headings)

    @cached_property
    def driven_joints(self) -> tuple[Joint, ...]:
        """The joints with positions, in the order of the URDF."""
        return tuple(joint for joint in self.joints if joint.driven)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the driven joints in the order of the URDF, which is the order of all positions."""
        return tuple(joint.name for joint in self.driven_joints)

    @cached_property
    def digest(self) -> str:
        """16 hexadecimal digits that change when the URDF text does."""
        return hashlib.blake2b(self.urdf.encode(), digest_size=8).hexdigest()

    @cached_property
    def position_count(self) -> int:
        """Length of a position vector."""
        return sum(POSITION_COUNTS[joint.type] for joint in self.driven_joints)

    @cached_property
    def velocity_count(self) -> int:
        """Length of a velocity or effort vector."""
        return sum(VELOCITY_COUNTS[joint.type] for joint in self.driven_joints)

    @cached_property
    def columns(self) -> dict[str, int]:
        """Index of each driven joint's first number in the position vector."""
        return _offsets(self.driven_joints, POSITION_COUNTS)

    @cached_property
    def velocity_columns(self) -> dict[str, int]:
        """Index of each driven joint's first number in the velocity vector."""
        return _offsets(self.driven_joints, VELOCITY_COUNTS)

    @cached_property
    def neutral(self) -> NDArray[np.float64]:
        """Rest positions: zero, or the middle of the limits if zero is outside them."""
        positions = np.zeros(self.position_count)
        for joint in self.driven_joints:
            column = self.columns[joint.name]
            if joint.type == "floating":
                positions[column + 6] = 1.0
            elif not joint.limits.lower <= 0.0 <= joint.limits.upper:
                positions[column] = 0.5 * (joint.limits.lower + joint.limits.upper)
        positions.flags.writeable = False
        return positions

    def mimic_of(self, joint: Joint) -> Mimic:
        """The driven joint that ``joint`` follows, with chains of mimics multiplied out."""
        if joint.mimic is None:
            return Mimic(joint.name)
        master = self.mimic_of(self._joints_by_name[joint.mimic.joint])
        return Mimic(
            master.joint,
            joint.mimic.multiplier * master.multiplier,
            joint.mimic.multiplier * master.offset + joint.mimic.offset,
        )

    @cached_property
    def _joints_by_name(self) -> dict[str, Joint]:
        return {joint.name: joint for joint in self.joints}

    def part(self, joints: Sequence[str]) -> RobotModel:
        """The same model with the driven ``joints`` only, in this order, and the joints that mimic them.

        Its position vectors are those of a driver of these joints. Raises InvalidInput for no joint, an
        unknown one, with near misses, one without positions, and one that is given twice.
        """
        if isinstance(joints, str):
            joints = (joints,)
        problems = [
            self._unknown_joint(name, self.joint_names) for name in joints if name not in self.columns
        ]
        problems += [f"{name!r} is given twice" for name, count in Counter(joints).items() if count > 1]
        if problems or not joints:
            raise InvalidInput(f"some joints of {self.name!r}: {'; '.join(problems) or 'none is given'}")
        driven = tuple(self._joints_by_name[name] for name in joints)
        followers = tuple(
            joint for joint in self.joints if joint.mimic is not None and self.mimic_of(joint).joint in joints
        )
        return replace(self, joints=driven + followers)

    def positions(self, values: Mapping[str, float | Sequence[float]]) -> NDArray[np.float64]:
        """A position vector from numbers by joint name; every driven joint is required.

        Raises InvalidInput, which names the unknown (with near misses) and the missing joints.
        """
        missing = [name for name in self.joint_names if name not in values]
        problems = [self._unknown_joint(name, missing) for name in values if name not in self.columns]
        if missing:
            problems.append(f"missing: {', '.join(map(repr, missing))}")
        if problems:
            raise InvalidInput(f"joint positions of {self.name!r}: {'; '.join(problems)}")
        numbers: list[float] = []
        for joint in self.driven_joints:
            value = np.atleast_1d(real_numbers(values[joint.name], f"the position of {joint.name!r}"))
            count = POSITION_COUNTS[joint.type]
            if value.size != count:
                raise InvalidInput(
                    f"joint {joint.name!r} is {joint.type} and takes {count} number(s), not {value.size}"
                )
            numbers.extend(value.tolist())
        return self.check_positions(numbers)

    def check_positions(self, positions: ArrayLike) -> NDArray[np.float64]:
        """``positions`` as a contiguous, finite float64 vector of the right length.

        Raises InvalidInput if the count is wrong, a number is NaN or infinite, or the length of a floating
        joint's quaternion is more than 1e-3 from 1.
        """
        vector = self._check(positions, self.position_count, "positions", POSITION_COUNTS)
        for joint in self._floating_joints:
            column = self.columns[joint.name] + 3
            length = math.hypot(*vector[column : column + 4].tolist())
            if abs(length - 1.0) > QUATERNION_TOLERANCE:
                raise InvalidInput(
                    f"the floating joint {joint.name!r} of {joint.parent!r} -> {joint.child!r} was given a "
                    f"quaternion of length {length:.6g}; its last four numbers are qx qy qz qw of length 1"
                )
        return vector

    @cached_property
    def _floating_joints(self) -> tuple[Joint, ...]:
        return tuple(joint for joint in self.driven_joints if joint.type == "floating")

    def check_velocities(self, velocities: ArrayLike) -> NDArray[np.float64]:
        """``velocities`` as a contiguous, finite float64 vector. Raises InvalidInput."""
        return self._check(velocities, self.velocity_count, "velocities", VELOCITY_COUNTS)

    def check_efforts(self, efforts: ArrayLike) -> NDArray[np.float64]:
        """``efforts`` [Nm] or [N], as many as velocities, likewise."""
        return self._check(efforts, self.velocity_count, "efforts", VELOCITY_COUNTS)

    def _check(
        self, values: ArrayLike, count: int, what: str, counts: Mapping[JointType, int]
    ) -> NDArray[np.float64]:
        vector = np.ascontiguousarray(real_numbers(values, f"{what} of {self.name!r}"))
        if vector.shape != (count,):
            raise InvalidInput(
                f"{self.name!r} takes {count} {what}, shape ({count},), in the order of its "
                f"{len(self.joint_names)} joint_names; got shape {vector.shape}"
            )
        # The sum is nearly always finite and costs a third of checking each number.
        if not math.isfinite(sum(vector.tolist())) and not np.isfinite(vector).all():
            owners = [joint.name for joint in self.driven_joints for _ in range(counts[joint.type])]
            pairs = zip(owners, vector.tolist(), strict=True)
            bad = ", ".join(f"{name!r} ({value})" for name, value in pairs if not math.isfinite(value))
            raise InvalidInput(f"{what} of {self.name!r} must be finite; not so: {bad}")
        return vector

    def _unknown_joint(self, name: str, missing: Sequence[str]) -> str:
        joint = self._joints_by_name.get(name)
        if joint is not None:
            kind = "fixed" if joint.mimic is None else f"a mimic of {joint.mimic.joint!r}"
            return f"{name!r} is {kind} and takes no position"
        near = near_joint(name, missing) or near_joint(name, self.joint_names)
        return f"unknown joint {name!r}{suggestion_text(near)}"


def _shown_cells(joint: Joint) -> tuple[str, ...]:
    limits = (f"{limit:.4g}" if math.isfinite(limit) else "" for limit in astuple(joint.limits)[:4])
    return (joint.name, joint.type, joint.parent, joint.child, *limits)


def near_joint(name: object, joints: Sequence[str]) -> str | None:
    """The most similar joint name, else the only one that has a word in common with ``name``."""
    parts = _name_parts(str(name))
    by_parts = {_name_parts(joint): joint for joint in reversed(joints)}
    near = get_close_matches("_".join(parts), map("_".join, by_parts), n=1)
    if near:
        return next(joint for key, joint in by_parts.items() if "_".join(key) == near[0])
    sharing = [joint for key, joint in by_parts.items() if set(key).intersection(parts)]
    return sharing[0] if len(sharing) == 1 else None


def _name_parts(name: str) -> tuple[str, ...]:
    """The distinctive parts of a joint's name: its words in lower case, without "joint"."""
    return tuple(part for part in _SEPARATORS.split(name.lower()) if part not in ("", "joint"))


def _offsets(joints: Sequence[Joint], counts: Mapping[JointType, int]) -> dict[str, int]:
    starts = accumulate((counts[joint.type] for joint in joints), initial=0)
    return {joint.name: start for joint, start in zip(joints, starts, strict=False)}


def coordinate_names(model: RobotModel) -> tuple[str, ...]:
    """One name for each position: the joint's, or "base.x", "base.y" ... if a joint has several."""
    return tuple(
        f"{joint.name}{part}" for joint in model.driven_joints for part in _COORDINATES.get(joint.type, ("",))
    )


def velocity_columns_by_position(model: RobotModel) -> tuple[int, ...]:
    """For each number of a velocity or effort vector, the index of its coordinate in the positions.

    A floating joint has six velocities for seven positions: its last coordinate has none.
    """
    return tuple(
        model.columns[joint.name] + number
        for joint in model.driven_joints
        for number in range(VELOCITY_COUNTS[joint.type])
    )
