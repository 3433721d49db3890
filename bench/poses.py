"""Comparison of readers' answers with the expected poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.recording import Recording

Answer = tuple[int, int, "list[float] | str | None"]
"""Stamp, robot index, and the pose7 of the tip or an error text; None if the system computes no poses."""


def pose_errors(
    sent: Recording, expected: NDArray[np.float64], answers: Sequence[Answer], begin: int
) -> dict[str, Any]:
    """Differences between answers and ``expected`` (N, 7), the poses of the repeated rows."""
    keys, distances, angles, errors = sent.keys(begin), [0.0], [0.0], []
    for stamp, robot, pose in answers:
        asked = Recording(np.array([stamp]), np.array([robot])).keys(begin)
        places = np.flatnonzero(keys == asked)
        if not places.size:
            errors.append(f"an answer at {stamp}, where no sample was sent")
        elif isinstance(pose, str):
            errors.append(pose)
        elif pose is not None:
            row = expected[sent.ticks[places[0]] % len(expected)].tolist()
            distances.append(distance(pose, row))
            angles.append(rotation_angle(pose, row))
    return {
        "compared": len(distances) - 1,
        "most_m": max(distances),
        "most_rad": max(angles),
        "errors": len(errors),
        "first_error": next(iter(errors), None),
    }


def distance(pose: Sequence[float], other: Sequence[float]) -> float:
    """The distance between two pose7 [m]."""
    return float(np.linalg.norm(np.array(pose[:3]) - np.array(other[:3])))


def rotation_angle(pose: Sequence[float], other: Sequence[float]) -> float:
    """The angle between two pose7 [rad]."""
    p, q = np.array(pose[3:]), np.array(other[3:])
    # From the chord between the quaternions: the cosine cannot distinguish angles below 1e-8 from zero.
    chord = min(float(np.linalg.norm(p - q)), float(np.linalg.norm(p + q)))
    return 4.0 * float(np.arcsin(min(1.0, 0.5 * chord)))
