"""Poses that readers gave, beside those they should have given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.recording import Recording

Said = tuple[int, int, "list[float] | str | None"]
"""Stamp, number of the robot, and the pose7 of the tip, or an error; None of a system without answers."""


def pose_errors(
    sent: Recording, expected: NDArray[np.float64], said: Sequence[Said], begin: int
) -> dict[str, Any]:
    """How far answers are from ``expected`` (N, 7), the poses of the rows that were sent again and again."""
    keys, moved, turned, errors = sent.keys(begin), [0.0], [0.0], []
    for stamp, robot, pose in said:
        asked = Recording(np.array([stamp]), np.array([robot])).keys(begin)
        places = np.flatnonzero(keys == asked)
        if not places.size:
            errors.append(f"an answer at {stamp}, when nothing was sent")
        elif isinstance(pose, str):
            errors.append(pose)
        elif pose is not None:
            row = expected[sent.ticks[places[0]] % len(expected)].tolist()
            moved.append(moved_by(pose, row))
            turned.append(turned_by(pose, row))
    return {
        "compared": len(moved) - 1,
        "most_m": max(moved),
        "most_rad": max(turned),
        "errors": len(errors),
        "first_error": next(iter(errors), None),
    }


def moved_by(pose: Sequence[float], other: Sequence[float]) -> float:
    """The distance between two pose7 [m]."""
    return float(np.linalg.norm(np.array(pose[:3]) - np.array(other[:3])))


def turned_by(pose: Sequence[float], other: Sequence[float]) -> float:
    """The angle between two pose7 [rad]."""
    p, q = np.array(pose[3:]), np.array(other[3:])
    # By the chord between the quaternions: their cosine does not tell angles below 1e-8 from none.
    chord = min(float(np.linalg.norm(p - q)), float(np.linalg.norm(p + q)))
    return 4.0 * float(np.arcsin(min(1.0, 0.5 * chord)))
