"""Poses in numbers that a person reads."""

from __future__ import annotations

import math
from collections.abc import Sequence

from zstate.se3 import rpy_of_quaternion

Rows = list[tuple[str, str]]


def pose_rows(pose7: Sequence[float]) -> Rows:
    """What there is to say of a pose, with the names of the numbers and their units."""
    x, y, z, qx, qy, qz, qw = pose7
    rpy = rpy_of_quaternion((qx, qy, qz, qw))
    return [
        ("xyz [m]", listed((x, y, z), 4)),
        ("distance [m]", digits(math.hypot(x, y, z), 4)),
        ("rpy [deg]", listed([math.degrees(angle) for angle in rpy], 2, width=7)),
        ("rpy [rad]", listed(rpy, 4)),
        ("quat xyzw", listed((qx, qy, qz, qw), 3)),
    ]


def listed(values: Sequence[float], precision: int, *, width: int = 0) -> str:
    """Numbers side by side, as wide whether or not they are negative; ``width`` is for larger ones."""
    return " ".join(f"{digits(value, precision):>{max(width, precision + 3)}}" for value in values)


def digits(value: float, precision: int) -> str:
    """A number with so many digits behind the point, and no negative zero."""
    return f"{round(value, precision) + 0.0:.{precision}f}"
