"""Alignment: the first tilt and gyro bias of a base, at rest and in motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.odometry.alignment import Alignment, align
from zstate.odometry.fusion import Inertia

MS = 1_000_000
GRAVITY = 9.80665


def samples(seconds: float, push: float = 0.0, yaw_rate: float = 0.0) -> list[Inertia]:
    """Samples at 100 Hz of a level base, which is pushed to the front and to the back [m/s^2]."""
    return [
        Inertia(
            10 * step * MS,
            np.array([0.0, 0.0, yaw_rate]),
            np.array([push * (-1) ** (step // 10), 0, GRAVITY]),
        )
        for step in range(round(seconds * 100) + 1)
    ]


@pytest.mark.parametrize(("push", "tilt"), [(0.0, 0.02), (2.0, 0.2)])
def test_a_base_that_is_not_at_rest_is_aligned_to_0_2_rad_and_else_to_0_02(push: float, tilt: float):
    found = align(samples(2.5, push), [], np.eye(4))
    assert isinstance(found, Alignment)
    assert np.sqrt(np.diag(found.estimate.state.covariance)[:2]) == pytest.approx([tilt, tilt])


@pytest.mark.parametrize(
    ("edge", "after_ns", "is_counted"),
    [("start", -1, False), ("start", 0, True), ("end", 0, True), ("end", 1, False)],
)
def test_turns_by_wheels_count_from_the_first_sample_at_rest_to_the_last(
    edge: str, after_ns: int, is_counted: bool
):
    """What a gyro reads in an even turn is its bias, unless wheels measure that turn."""
    rate = np.array([0.0, 0.0, 0.02])
    at_rest = samples(0.6, yaw_rate=rate[2])
    without = align(at_rest, [], np.eye(4))
    assert isinstance(without, Alignment)
    edges = {"start": at_rest[0].stamp, "end": without.end}
    found = align(at_rest, [(edges[edge] + after_ns, rate)], np.eye(4))
    assert isinstance(found, Alignment)
    assert found.estimate.state.gyro_bias[2] == pytest.approx(0.0 if is_counted else rate[2])
    # A turn by wheels is right to 30 %; they may slip.
    sigma = math.hypot(0.01, 0.3 * rate[2]) if is_counted else 0.01
    assert math.sqrt(found.estimate.state.covariance[11, 11]) == pytest.approx(sigma)
