"""Setpoints compared with readings."""

from __future__ import annotations

import numpy as np
import pytest

from zstate.driving.limits import Limits
from zstate.driving.supervised_driver import FollowingCheck
from zstate.errors import InvalidInput

LIMITS = Limits(("lift", "elbow"), [-1, -1], [1, 1], [1, 1], [1, 1], ("m", "rad"))
SECOND = 1_000_000_000


def written(positions: list[float], now: int = 10 * SECOND) -> FollowingCheck:
    check = FollowingCheck(LIMITS, 0.2, SECOND)
    check.written(np.array(positions), now)
    return check


def deviation(check: FollowingCheck, measured: list[float], measured_at: int, now: int) -> str:
    return check.deviation(np.array(measured), measured_at * SECOND, now * SECOND)


def test_the_joint_that_is_furthest_from_its_setpoint_is_named():
    text = deviation(written([0.5, 0.5]), [0.1, 0.75], 11, 11)
    assert text.startswith("'lift' is 0.4 m from its setpoint, more than following_error=0.2")
    assert deviation(written([0.5, 0.5]), [0.375, 0.625], 11, 11) == ""


def test_a_reading_from_before_the_setpoint_is_not_compared_until_it_is_too_old():
    check = written([0.5, 0.5])
    assert deviation(check, [0.0, 0.0], 9, 10) == ""
    assert deviation(check, [0.0, 0.0], 9, 11) == "there is no new reading of the joints for 2.0 s"


def test_joints_that_are_not_commanded_may_be_anywhere():
    check = written([0.5, 0.5])
    check.stopped()
    assert deviation(check, [0.0, 0.0], 11, 100) == ""


@pytest.mark.parametrize("most", [0.0, -1.0, float("nan")])
def test_the_distance_is_above_zero(most: float):
    with pytest.raises(InvalidInput, match="following_error is a distance above zero"):
        FollowingCheck(LIMITS, most, SECOND)
