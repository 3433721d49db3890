"""Which readings count: two that agree, of joints that are inside their limits or a little outside."""

from __future__ import annotations

import numpy as np
import pytest

from zstate.driving.limits import Limits
from zstate.driving.readings import Readings

SECOND = 1_000_000_000
LIMITS = Limits(("lift", "elbow"), [-1.0, -0.1], [1.0, 0.1], [0.5, 2.0], [1.0, 1.0], ("m", "rad"))
FOLLOWING_ERROR = 0.2
"""The default of a driver's host."""
EXACT = 1e-9


def opened() -> Readings:
    return Readings(LIMITS, FOLLOWING_ERROR, SECOND)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(("row", "velocity"), [(0, 0.5), (1, 2.0)])
def test_two_readings_agree_if_no_joint_has_moved_further_than_its_velocity_and_a_tenth_of_a_rad_or_m(
    row: int, velocity: float, side: float
):
    furthest = 0.25 * velocity + 0.1
    for way, is_confirmed in ((furthest - EXACT, True), (furthest + EXACT, False)):
        readings = opened()
        readings.add(np.zeros(2), 0)
        moved = np.zeros(2)
        moved[row] = side * way
        assert (readings.add(moved, SECOND // 4) == "") == is_confirmed
        assert readings.is_confirmed == is_confirmed


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("row", "furthest"), [(0, 1.0 + 0.35), (1, 0.1 + 0.2)], ids=["0.35 m", "its range of 0.2 rad"]
)
def test_a_joint_that_is_further_outside_than_0_35_or_its_range_is_not_moved(
    row: int, furthest: float, side: float
):
    at = np.zeros(2)
    at[row] = side * (furthest - EXACT)
    assert opened().outside_text(at) == ""
    at[row] = side * (furthest + EXACT)
    assert "too far to be moved (more than 0.35, or than its range)" in opened().outside_text(at)
