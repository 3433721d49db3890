"""RobotModel: what the robot is. Frozen once made; everything else asks it.

Positions of a robot are one flat vector in the order of ``RobotModel.joint_names``, the order in
which the URDF names its driven joints. Each joint type takes a fixed count of numbers there:

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

Coordinates: a name for each number of a robot's position vector.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate._util.suggestions import suggestion_text
from zstate.checks import real_numbers
from zstate.errors import FindingLike, InvalidInput

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

NORM_TOLERANCE = 1e-3
"""A floating joint's quaternion this close to unit length is normalised; beyond, it is refused."""

_SEPARATORS = re.compile(r"[^a-z0-9]+")


@dataclass(frozen=True, slots=True)
class Limits:
    """What a joint may do: [rad] or [m], per second, and [Nm] or [N]. Infinite where not stated."""

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf


@dataclass(frozen=True, slots=True)
class Mimic:
    """``position = multiplier * position of joint + offset``."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Joint:
    """One edge of the robot: how ``child`` sits on ``parent``.

    ``origin`` is ``parent_from_joint`` as pose7; ``axis`` is the unit axis in the joint's frame.
    ``line`` is where the URDF names the joint.
    """

    name: str
    type: JointType
    parent: str
    child: str
    origin: tuple[float, float, float, float, float, float, float]
    axis: tuple[float, float, float]
    limits: Limits
    mimic: Mimic | None = None
    line: int | None = None

    @property
    def driven(self) -> bool:
        """Whether positions are given for this joint: neither fixed nor a mimic."""
        return self.type != "fixed" and self.mimic is None


@dataclass(frozen=True)
class RobotModel:
    """A robot: links and joints in the order of the URDF, which is kept as text.

    ``root`` is the link without a parent. ``findings`` are the validator's warnings.
    Made by ``load_model``; whoever builds one by hand answers for its consistency.
    """

    name: str
    root: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    urdf: str
    findings: tuple[FindingLike, ...] = ()

    def __repr__(self) -> str:
        return f"RobotModel({self.name!r}, {len(self.links)} links, {len(self.joint_names)} driven joints)"

    @cached_property
    def driven_joints(self) -> tuple[Joint, ...]:
        """The joints positions are given for, in the order of the URDF."""
        return tuple(joint for joint in self.joints if joint.driven)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """The driven joints by name, in the order of the URDF: the order of all positions."""
        return tuple(joint.name for joint in self.driven_joints)

    @cached_property
    def digest(self) -> str:
        """16 hexadecimal digits that change when the URDF text does."""
        return hashlib.blake2b(self.urdf.encode(), digest_size=8).hexdigest()

    @cached_property
    def position_count(self) -> int:
        """How many numbers a position vector of this robot has."""
        return sum(POSITION_COUNTS[joint.type] for joint in self.driven_joints)

    @cached_property
    def velocity_count(self) -> int:
        """How many numbers a velocity or effort vector of this robot has."""
        return sum(VELOCITY_COUNTS[joint.type] for joint in self.driven_joints)

    @cached_property
    def columns(self) -> dict[str, int]:
        """Where in the position vector each driven joint's numbers begin."""
        return _offsets(self.driven_joints, POSITION_COUNTS)

    @cached_property
    def velocity_columns(self) -> dict[str, int]:
        """Where in the velocity vector each driven joint's numbers begin."""
        return _offsets(self.driven_joints, VELOCITY_COUNTS)

    @cached_property
    def neutral(self) -> NDArray[np.float64]:
        """Positions of rest: zero, or the middle of the limits where zero is outside them."""
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
        """The driven joint behind ``joint``, with chains of mimics multiplied out."""
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

    def positions(self, values: Mapping[str, float | Sequence[float]]) -> NDArray[np.float64]:
        """A position vector from numbers by joint name; every driven joint must be named.

        Raises InvalidInput naming the joints that are unknown (with near misses) or missing.
        """
        missing = [name for name in self.joint_names if name not in values]
        problems = [self._unknown_joint(name, missing) for name in values if name not in self.columns]
        if missing:
            problems.append(f"missing: {', '.join(repr(name) for name in missing)}")
        if problems:
            raise InvalidInput(f"joint positions of {self.name!r}: {'; '.join(problems)}")
        numbers: list[float] = []
        for joint in self.driven_joints:
            given = np.atleast_1d(real_numbers(values[joint.name], f"the position of {joint.name!r}"))
            if given.size != POSITION_COUNTS[joint.type]:
                raise InvalidInput(
                    f"joint {joint.name!r} is {joint.type} and takes {POSITION_COUNTS[joint.type]} "
                    f"number(s), not {given.size}"
                )
            numbers.extend(given.tolist())
        return self.check_positions(numbers)

    def check_positions(self, positions: ArrayLike) -> NDArray[np.float64]:
        """``positions`` as a contiguous float64 vector of the right length without NaN or infinity.

        Raises InvalidInput saying how many numbers are wanted, or which joint is not finite, or is floating
        and has a quaternion whose length is more than 1e-3 from 1.
        """
        vector = self._check(positions, self.position_count, "positions", POSITION_COUNTS)
        for joint in self._floating_joints:
            column = self.columns[joint.name] + 3
            length = math.hypot(*vector[column : column + 4].tolist())
            if abs(length - 1.0) > NORM_TOLERANCE:
                raise InvalidInput(
                    f"the floating joint {joint.name!r} of {joint.parent!r} -> {joint.child!r} was given a "
                    f"quaternion of length {length:.6g}; its last four numbers are qx qy qz qw of length 1"
                )
        return vector

    @cached_property
    def _floating_joints(self) -> tuple[Joint, ...]:
        return tuple(joint for joint in self.driven_joints if joint.type == "floating")

    def check_velocities(self, velocities: ArrayLike) -> NDArray[np.float64]:
        """The same for velocities."""
        return self._check(velocities, self.velocity_count, "velocities", VELOCITY_COUNTS)

    def check_efforts(self, efforts: ArrayLike) -> NDArray[np.float64]:
        """The same for efforts [Nm] or [N], which are as many as velocities."""
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
        # The sum is finite nearly always and costs a third of asking each number.
        if not math.isfinite(sum(vector.tolist())) and not np.isfinite(vector).all():
            self._refuse_not_finite(vector, what, counts)
        return vector

    def _refuse_not_finite(
        self, vector: NDArray[np.float64], what: str, counts: Mapping[JointType, int]
    ) -> None:
        owners = [joint.name for joint in self.driven_joints for _ in range(counts[joint.type])]
        bad = [
            f"{name!r} ({value})"
            for name, value in zip(owners, vector.tolist(), strict=True)
            if not np.isfinite(value)
        ]
        raise InvalidInput(f"{what} of {self.name!r} must be finite; not so: {', '.join(bad)}")

    def _unknown_joint(self, name: str, missing: Sequence[str]) -> str:
        joint = self._joints_by_name.get(name)
        if joint is not None:
            kind = "fixed" if joint.mimic is None else f"a mimic of {joint.mimic.joint!r}"
            return f"{name!r} is {kind} and takes no position"
        near = near_joint(name, missing) or near_joint(name, self.joint_names)
        return f"unknown joint {name!r}{suggestion_text(near)}"


def near_joint(name: object, known: Sequence[str]) -> str | None:
    """The joint that was probably meant: one of nearly that name, or the only one that shares a word."""
    words = _words(str(name))
    by_words = {_words(one): one for one in reversed(known)}
    near = get_close_matches("_".join(words), map("_".join, by_words), n=1)
    if near:
        return next(one for parts, one in by_words.items() if "_".join(parts) == near[0])
    sharing = [one for parts, one in by_words.items() if set(parts).intersection(words)]
    return sharing[0] if len(sharing) == 1 else None


def _words(name: str) -> tuple[str, ...]:
    """What tells a joint's name from others: its words in small letters, without "joint"."""
    return tuple(word for word in _SEPARATORS.split(name.lower()) if word not in ("", "joint"))


def _offsets(joints: Sequence[Joint], counts: Mapping[JointType, int]) -> dict[str, int]:
    starts: dict[str, int] = {}
    total = 0
    for joint in joints:
        starts[joint.name] = total
        total += counts[joint.type]
    return starts


_PARTS = {
    "floating": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "planar": ("x", "y", "yaw"),
}


def coordinate_names(model: RobotModel) -> tuple[str, ...]:
    """One name for each position: the joint's, or "base.x", "base.y" ... where a joint has several."""
    return tuple(name for joint in model.driven_joints for name in _names(joint))


def velocity_columns_by_position(model: RobotModel) -> tuple[int, ...]:
    """The coordinate under which each number of a velocity or effort vector stands.

    A floating joint has six velocities for seven positions: nothing stands under its last coordinate.
    """
    return tuple(
        model.columns[joint.name] + number
        for joint in model.driven_joints
        for number in range(VELOCITY_COUNTS[joint.type])
    )


def _names(joint: Joint) -> tuple[str, ...]:
    parts = _PARTS.get(joint.type)
    return (joint.name,) if parts is None else tuple(f"{joint.name}.{part}" for part in parts)
