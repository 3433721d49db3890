"""Dials: one number for each thing that a slider moves, and what they make of a robot's positions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from zstate.model.robot import Joint, RobotModel
from zstate.se3 import quaternion_of_rpy, rpy_of_quaternion

Unit = Literal["rad", "m"]
Values = NDArray[np.float64]

_REACH_M = 2.0
"""How far what has no limits may be moved, each way."""

_PLANAR: tuple[tuple[str, Unit, float], ...] = (
    ("x", "m", _REACH_M),
    ("y", "m", _REACH_M),
    ("yaw", "rad", math.pi),
)
_FLOATING: tuple[tuple[str, Unit, float], ...] = (
    ("x", "m", _REACH_M),
    ("y", "m", _REACH_M),
    ("z", "m", _REACH_M),
    ("roll", "rad", math.pi),
    ("pitch", "rad", math.pi / 2),
    ("yaw", "rad", math.pi),
)


@dataclass(frozen=True, slots=True)
class Dial:
    """A number between ``lower`` and ``upper`` [rad] or [m]: a joint's, or one of several of a joint.

    Where the model states no limit it is a turn each way, or 2 m.
    """

    name: str
    unit: Unit
    lower: float
    upper: float


class Dials:
    """The dials of a robot; a floating joint has six, of which three are roll, pitch and yaw."""

    def __init__(self, model: RobotModel) -> None:
        self.dials = tuple(dial for joint in model.driven_joints for dial in _dials(joint))
        self.lower = np.array([dial.lower for dial in self.dials])
        self.upper = np.array([dial.upper for dial in self.dials])
        self._model = model
        plain: list[tuple[int, int]] = []
        self._floating: list[tuple[int, int]] = []
        row = 0
        for joint in model.driven_joints:
            column, count = model.columns[joint.name], len(list(_dials(joint)))
            if joint.type == "floating":
                self._floating.append((row, column))
            else:
                plain += [(row + step, column + step) for step in range(count)]
            row += count
        self._rows, self._columns = np.array(plain, dtype=np.intp).reshape(-1, 2).T

    def positions(self, values: Values) -> Values:
        """The robot's positions, in the order of its ``joint_names``, for one value per dial."""
        positions = np.empty(self._model.position_count)
        positions[self._columns] = values[self._rows]
        for row, column in self._floating:
            x, y, z, roll, pitch, yaw = values[row : row + 6].tolist()
            positions[column : column + 7] = (x, y, z, *quaternion_of_rpy(roll, pitch, yaw))
        return positions

    def values(self, positions: Values) -> Values:
        """What the dials show of ``positions``, whether or not that is within their limits."""
        values = np.empty(len(self.dials))
        values[self._rows] = positions[self._columns]
        for row, column in self._floating:
            x, y, z, qx, qy, qz, qw = positions[column : column + 7].tolist()
            values[row : row + 6] = (x, y, z, *rpy_of_quaternion((qx, qy, qz, qw)))
        return values


def _dials(joint: Joint) -> Iterator[Dial]:
    if joint.type in ("planar", "floating"):
        for part, unit, reach in _PLANAR if joint.type == "planar" else _FLOATING:
            yield Dial(f"{joint.name}.{part}", unit, -reach, reach)
        return
    unit: Unit = "m" if joint.type == "prismatic" else "rad"
    reach = _REACH_M if unit == "m" else math.pi
    lower, upper = joint.limits.lower, joint.limits.upper
    if joint.type == "continuous":
        lower, upper = -math.inf, math.inf
    if not math.isfinite(lower):
        lower = -reach if not math.isfinite(upper) else upper - 2.0 * reach
    yield Dial(joint.name, unit, lower, upper if math.isfinite(upper) else lower + 2.0 * reach)
