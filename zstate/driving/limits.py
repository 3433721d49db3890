"""Limits of driven joints: positions, velocities, accelerations and efforts.

A URDF states positions, velocities and efforts, also those of the joints that mimic a driven one, and limits
of commands: see ``zstate.model.command_limits``. Accelerations come from the manual of the actuators.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from zstate._util.format import suggestion_text
from zstate.checks import Floats, real_numbers, reduced_to_fields
from zstate.errors import InvalidInput
from zstate.model.robot import POSITION_COUNTS, DeclaredLimits, Joint, Mimic, RobotModel, near_joint
from zstate.wire.keys import shortened

ROUNDING = 1e-9
"""[rad] or [m], and as a ratio for rates: rounding of interpolated values, far below any encoder."""

BRAKING_S = 0.2
"""For how long a joint brakes from its velocity limit if no limit of its acceleration is known [s]."""

FARTHEST = 1e9
"""[rad] or [m]; positions further away are refused, whose squares and sums would lose the joint's motion.

It is 100,000 km of a wheel with a radius of 0.1 m; there float64 has steps of 1e-7.
"""

_SHOWN = 3
"""Unknown joints in an error: near names take time, and names may come from the network."""


@dataclass(frozen=True, eq=False, slots=True)
class Limits:
    """Limits of the joints ``joint_names``, one number each, (n,); infinite where there is none.

    ``lower`` and ``upper`` are positions [rad] or [m]; ``velocity`` and ``acceleration`` are bounds of the
    absolute value, per s and per s^2, and so is ``effort`` [Nm] or [N], infinite if left out. ``units`` are
    "rad" or "m"; "rad" for each joint if left out. The arrays are read-only copies. Raises InvalidInput for
    no or repeated joints, other shapes, NaN, a lower limit above the upper one, rates that are not above
    zero, and efforts below it, with all joints and values.
    """

    joint_names: tuple[str, ...]
    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats
    units: tuple[str, ...] = ()
    effort: Floats = field(default_factory=lambda: np.array(np.inf))

    def __post_init__(self) -> None:
        object.__setattr__(self, "joint_names", check_joint_names(self.joint_names))
        object.__setattr__(self, "units", tuple(self.units) or ("rad",) * len(self.joint_names))
        if len(self.units) != len(self.joint_names) or not {"rad", "m"}.issuperset(self.units):
            raise InvalidInput(f"units are 'rad' or 'm' for each of {self.joint_names}; got {self.units}")
        for name in ("lower", "upper", "velocity", "acceleration", "effort"):
            values = real_numbers(getattr(self, name), f"{name} limits").copy()
            if name == "effort" and values.shape == ():
                values = np.full(len(self.joint_names), values)
            if values.shape != (len(self.joint_names),):
                raise InvalidInput(
                    f"{name} limits of {len(self.joint_names)} joints have shape "
                    f"({len(self.joint_names)},); got {values.shape}"
                )
            values.flags.writeable = False
            object.__setattr__(self, name, values)
        if problems := self._problems():
            raise InvalidInput(f"joint limits: {'; '.join(problems)}")

    __reduce__ = reduced_to_fields

    def _problems(self) -> list[str]:
        ranges = zip(self.joint_names, self.lower.tolist(), self.upper.tolist(), strict=True)
        problems = [
            f"positions of {name!r} reach from {lower:g} to {upper:g}"
            for name, lower, upper in ranges
            if not lower <= upper
        ]
        for kind, values in (("velocity", self.velocity), ("acceleration", self.acceleration)):
            problems += [
                f"the {kind} limit of {name!r} is {value:g}; it must be above zero"
                for name, value in zip(self.joint_names, values.tolist(), strict=True)
                if not value > 0.0
            ]
        problems += [
            f"the effort limit of {name!r} is {value:g}; it must not be below zero"
            for name, value in zip(self.joint_names, self.effort.tolist(), strict=True)
            if not value >= 0.0
        ]
        return problems

    @classmethod
    def of(
        cls,
        model: RobotModel,
        joints: Sequence[str] | None = None,
        *,
        velocity: float | Mapping[str, float] | None = None,
        acceleration: float | Mapping[str, float] | None = None,
        effort: float | Mapping[str, float] | None = None,
    ) -> Limits:
        """The limits that the URDF of ``model`` states for ``joints``, which are all if left out.

        All are the driven joints with one position each: floating and planar joints have no limits in a URDF.
        Continuous joints have no position limits. The limits of joints that mimic one of them, soft limits,
        and those of the command interfaces of <ros2_control> count as well, except for ranges that leave no
        positions. ``velocity``, ``acceleration``
        and ``effort`` are one number for all joints, or numbers by joint. They may be lower than those of the
        URDF, never higher, unless that is zero, as exporters write for an unknown one. A joint without any
        limit of its acceleration gets the one with which it brakes from its velocity limit in 0.2 s; pass
        infinity to let it stop in one step. Raises InvalidInput for other joints, NaN, and numbers that are
        not above zero, with the joint and the value.
        """
        chosen = _driven_joints(model, joints)
        names = tuple(joint.name for joint in chosen)
        stated = [_stated_limits(model, joint)[0] for joint in chosen]
        problems: list[str] = []
        velocities = _rates(velocity, names, np.array([one.velocity for one in stated]), "velocity")
        efforts = _rates(effort, names, np.array([max(one.effort, 0.0) for one in stated]), "effort")
        braking = np.array([one.acceleration for one in stated])
        braking = np.where(np.isfinite(braking), braking, velocities / BRAKING_S)
        accelerations = _rates(acceleration, names, braking, "acceleration")
        for name, limits, asked in zip(names, stated, velocities.tolist(), strict=True):
            if asked <= 0.0:
                at_most = f"{limits.velocity:g}, where it could not move"
                problems.append(f"the URDF limits the velocity of {name!r} to {at_most}")
        for kind, asked in (("velocity", velocities), ("effort", efforts), ("acceleration", accelerations)):
            limits = [getattr(one, kind) for one in stated]
            problems += [
                f"{kind} {number:g} of {name!r} is above {limit:g}, the limit in the URDF"
                for name, number, limit in zip(names, asked.tolist(), limits, strict=True)
                if number > limit > 0.0
            ]
        if problems:
            raise InvalidInput(f"{'; '.join(problems)}; pass other limits, or correct the URDF")
        return cls(
            names,
            np.array([one.lower for one in stated]),
            np.array([one.upper for one in stated]),
            velocities,
            accelerations,
            tuple("m" if joint.type == "prismatic" else "rad" for joint in chosen),
            efforts,
        )

    def part(self, joint_names: Sequence[str]) -> Limits:
        """The limits of ``joint_names``, in that order. Raises InvalidInput for unknown or repeated ones."""
        unknown = [name for name in joint_names if name not in self.joint_names]
        if unknown:
            shown = [shortened(name) for name in unknown[:_SHOWN]]
            texts = [f"{name!r}{suggestion_text(near_joint(name, self.joint_names))}" for name in shown]
            rest = f" and {len(unknown) - _SHOWN} more" if len(unknown) > _SHOWN else ""
            raise InvalidInput(f"there are no limits of {', '.join(texts)}{rest}")
        rows = [self.joint_names.index(name) for name in check_joint_names(joint_names)]
        return Limits(
            tuple(joint_names),
            self.lower[rows],
            self.upper[rows],
            self.velocity[rows],
            self.acceleration[rows],
            tuple(self.units[row] for row in rows),
            self.effort[rows],
        )

    def check_positions(self, positions: ArrayLike) -> Floats:
        """``positions`` as a vector (n,) in the order of ``joint_names``.

        Raises InvalidInput for another shape, NaN, infinity, and positions outside the limits, with each
        joint, its value and its limits.
        """
        vector = self.vector(positions, "positions")
        if findings := self.position_findings(vector):
            raise InvalidInput("; ".join(findings))
        return vector

    def position_findings(self, positions: Floats) -> tuple[str, ...]:
        """A text for each joint that is outside its limits at ``positions``, (n,)."""
        lower, upper = self.bounds
        outside = (positions < lower - ROUNDING) | (positions > upper + ROUNDING)
        return tuple(
            f"{self.joint_names[row]!r} at {positions[row]:.9g} {self.units[row]} is outside "
            f"{self.range_text(row)}{self.degrees_text(row, float(positions[row]))}"
            for row in np.flatnonzero(outside).tolist()
        )

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """The least and the greatest positions (n,), which are 1e9 [rad] or [m] where there is no limit."""
        return np.maximum(self.lower, -FARTHEST), np.minimum(self.upper, FARTHEST)

    def range_text(self, row: int) -> str:
        """The bounds of the joint ``joint_names[row]``: "-2 to 2"."""
        lower, upper = self.bounds
        return f"{lower[row]:.9g} to {upper[row]:.9g}"

    def containing(self, positions: ArrayLike) -> Limits:
        """The same limits, as far extended as ``positions``, (n,), are outside.

        For a robot that is outside its limits: each joint may stay where it is, or move inwards.
        """
        vector = self.vector(positions, "positions")
        return replace(self, lower=np.minimum(self.lower, vector), upper=np.maximum(self.upper, vector))

    def vector(self, values: ArrayLike, what: str) -> Floats:
        """``values``, a number for each joint, as a finite vector (n,) of float64. Raises InvalidInput.

        ``what`` names them in the error: "positions".
        """
        vector = real_numbers(values, what)
        if vector.shape != (len(self.joint_names),):
            raise InvalidInput(
                f"{what} of {len(self.joint_names)} joints have shape ({len(self.joint_names)},), in the "
                f"order {', '.join(self.joint_names)}; got {vector.shape}"
            )
        if not math.isfinite(sum(vector.tolist())) and not np.isfinite(vector).all():
            pairs = zip(self.joint_names, vector.tolist(), strict=True)
            bad = ", ".join(f"{name!r} ({value})" for name, value in pairs if not math.isfinite(value))
            raise InvalidInput(f"{what} must be finite; not so: {bad}")
        return vector

    def degrees_text(self, row: int, value: float) -> str:
        """A hint for a position ``value`` of the joint ``joint_names[row]`` that is probably in degrees."""
        is_angle = self.units[row] == "rad" and abs(value) > math.tau
        if is_angle and self.lower[row] <= math.radians(value) <= self.upper[row]:
            return "; this looks like degrees: convert with math.radians"
        return ""


def check_joint_names(names: Sequence[str]) -> tuple[str, ...]:
    """``names`` as a tuple. Raises InvalidInput if there are none, or one is repeated."""
    if isinstance(names, str) or not names:
        raise InvalidInput(f"joint names are a sequence of names, at least one; got {names!r}")
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise InvalidInput(f"joints given twice: {', '.join(map(repr, repeated))}")
    return tuple(names)


def _driven_joints(model: RobotModel, names: Sequence[str] | None) -> tuple[Joint, ...]:
    """The joints of ``names`` in that order, or all, if they have one position each."""
    single = {joint.name: joint for joint in model.driven_joints if POSITION_COUNTS[joint.type] == 1}
    chosen = check_joint_names(tuple(single) if names is None else names)
    problems = [_not_single_text(model, name, tuple(single)) for name in chosen if name not in single]
    if problems:
        raise InvalidInput(f"limits of {model.name!r}: {'; '.join(problems)}")
    return tuple(single[name] for name in chosen)


def unused_ranges(model: RobotModel, joint_names: Sequence[str]) -> tuple[str, ...]:
    """A text for each range of positions in the URDF that ``Limits.of`` cannot use for ``joint_names``."""
    chosen = _driven_joints(model, joint_names)
    return tuple(text for joint in chosen for text in _stated_limits(model, joint)[1])


def _stated_limits(model: RobotModel, joint: Joint) -> tuple[DeclaredLimits, list[str]]:
    """The limits of ``joint``, of its commands, and of the joints that mimic it, as limits of its own.

    A range of which less than two positions are left is not used, and has a text: followers often have that
    of their leader in the URDF, with the wrong sign.
    """
    found, texts = joint.limits, list[str]()
    narrower = [("its commands", joint.command_limits)]
    for follower in model.joints:
        if follower.mimic is not None and (mimic := model.mimic_of(follower)).joint == joint.name:
            limits = follower.limits.narrowed(follower.command_limits)
            narrower.append((f"{follower.name!r}, which follows it", _through(mimic, limits)))
    for source, limits in narrower:
        both = found.narrowed(limits)
        is_narrower = (both.lower, both.upper) != (found.lower, found.upper)
        if is_narrower and not both.lower < both.upper:
            texts.append(
                f"{joint.name!r} is limited to {found.lower:g} to {found.upper:g}, and not by {source}: that "
                f"would be {limits.lower:g} to {limits.upper:g}"
            )
            both = replace(both, lower=found.lower, upper=found.upper)
        found = both
    return found, texts


def _through(mimic: Mimic, limits: DeclaredLimits) -> DeclaredLimits:
    """The ``limits`` of a joint as those of the joint that it follows by ``mimic``.

    A range or a rate of zero is none, as exporters write for an unknown one. The effort of the leading joint
    may all be at this one.
    """
    ratio = mimic.multiplier
    if ratio == 0.0:
        return DeclaredLimits()
    ends = sorted((end - mimic.offset) / ratio for end in (limits.lower, limits.upper))
    lower, upper = ends if limits.lower < limits.upper else (-math.inf, math.inf)
    velocity = limits.velocity / abs(ratio) if limits.velocity > 0.0 else math.inf
    effort = limits.effort * abs(ratio) if limits.effort > 0.0 else math.inf
    return DeclaredLimits(lower, upper, velocity, effort, limits.acceleration / abs(ratio))


def _not_single_text(model: RobotModel, name: str, single: Sequence[str]) -> str:
    joint = next((joint for joint in model.joints if joint.name == name), None)
    if joint is None:
        return f"unknown joint {name!r}{suggestion_text(near_joint(name, single))}"
    if joint.mimic is not None:
        return f"{name!r} follows {model.mimic_of(joint).joint!r} and is not driven itself"
    return f"{name!r} is {joint.type}; only joints with one position have limits"


def _rates(
    given: float | Mapping[str, float] | None, names: tuple[str, ...], stated: Floats, kind: str
) -> Floats:
    """A number for each joint: those ``given``, else those ``stated``."""
    if given is None:
        return stated
    if not isinstance(given, Mapping):
        return np.full(len(names), _rate(given, f"{kind} limit"))
    unknown = [f"{name!r}{suggestion_text(near_joint(name, names))}" for name in given if name not in names]
    if unknown:
        raise InvalidInput(f"{kind} limits of unknown joints: {', '.join(unknown)}")
    numbers = {name: _rate(value, f"{kind} limit of {name!r}") for name, value in given.items()}
    return np.array([numbers.get(name, limit) for name, limit in zip(names, stated.tolist(), strict=True)])


def _rate(value: float, what: str) -> float:
    number = real_numbers(value, what)
    if number.shape != () or not number > 0.0:
        raise InvalidInput(f"the {what} is {value!r}; it must be a number above zero")
    return float(number)
