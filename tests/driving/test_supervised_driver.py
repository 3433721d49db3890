"""Setpoints compared with readings."""

from __future__ import annotations

import numpy as np
import pytest

from zstate.driving.limits import Limits
from zstate.driving.setpoint_limiter import Limited
from zstate.driving.supervised_driver import FollowingCheck
from zstate.errors import InvalidInput

LIMITS = Limits(("lift", "elbow"), [-1, -1], [1, 1], [1, 1], [1, 1], ("m", "rad"))
SECOND = 1_000_000_000


def written(positions: list[float], now: int = 10 * SECOND) -> FollowingCheck:
    check = FollowingCheck(LIMITS, 0.2, SECOND)
    modes = ("position",) * len(positions)
    check.written(Limited(np.array(positions), np.zeros(len(positions)), (), None, modes), now)
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


TICK = SECOND // 100


def turned(speeds: list[float], ratio: float, lag_s: float = 0.0) -> str:
    """What is found within 3 s if 'elbow' moves by ``ratio`` times its velocities, each for 0.5 s."""
    check = FollowingCheck(LIMITS, 0.2, SECOND)
    position = velocity = 0.0
    for tick in range(300):
        speed = speeds[tick // 50 % len(speeds)]
        setpoint = Limited(
            np.array([0.0, position]), np.array([0.0, speed]), (), None, ("position", "velocity")
        )
        check.written(setpoint, tick * TICK)
        velocity = speed if not lag_s else velocity + (speed - velocity) * 0.01 / (lag_s + 0.01)
        position += ratio * velocity * 0.01
        if text := check.deviation(np.array([0.0, position]), (tick + 1) * TICK, (tick + 1) * TICK):
            return text
    return ""


@pytest.mark.parametrize(
    ("speeds", "ratio", "text"),
    [
        ([1.0], 0.0, "'elbow' has moved by 0 rad in 1.0 s, where its velocities add up to 1"),  # no power
        ([1.0], -1.0, "do its encoder and its motor turn the same way?"),
        ([1.0], 1.7, "'elbow' has moved by 1.7"),
        ([0.0], 1.0, ""),
        ([20.0], 0.9, ""),
    ],
)
def test_a_joint_in_mode_velocity_moves_as_far_as_its_velocities_add_up_to(
    speeds: list[float], ratio: float, text: str
):
    found = turned(speeds, ratio)
    assert text in found
    assert bool(text) == bool(found)


@pytest.mark.parametrize("speeds", [[20.0, -20.0], [0.0, 50.0], [0.3]])
def test_the_lag_of_a_joint_in_mode_velocity_is_no_deviation(speeds: list[float]):
    assert turned(speeds, 1.0, lag_s=0.05) == ""


def test_a_joint_that_falls_at_zero_velocity_is_noticed():
    check = FollowingCheck(LIMITS, 0.2, SECOND)
    texts: list[str] = []
    for tick in range(210):
        at = np.array([-0.3 * tick / 100, 0.0])
        texts.append(check.deviation(at, tick * TICK, tick * TICK))
        check.written(Limited(at, np.zeros(2), (), None, ("velocity", "velocity")), tick * TICK)
    assert any("'lift' has moved by -0.3" in text for text in texts)


@pytest.mark.parametrize(
    ("modes", "tick_ns"),
    [
        ([("velocity", "velocity"), ("position", "velocity")], TICK),  # of another joint
        ([("position", "velocity"), ("position", "position")], TICK),  # of this joint
        ([("position", "velocity")], SECOND // 5),  # a slow loop
    ],
)
@pytest.mark.parametrize(("ratio", "is_found"), [(0.0, True), (-1.0, True), (1.0, False)])
def test_a_joint_is_compared_also_while_modes_change_and_in_slow_loops(modes, tick_ns, ratio, is_found):
    check = FollowingCheck(LIMITS, 0.2, SECOND)
    position, dt_s = 0.0, tick_ns * 1e-9
    texts: list[str] = []
    for tick in range(2 * SECOND // tick_ns):
        texts.append(check.deviation(np.array([0.0, position]), tick * tick_ns, tick * tick_ns))
        now_in = modes[tick % len(modes)]
        expected = np.array([0.0, position + dt_s])  # positions start from the measured ones
        check.written(Limited(expected, np.array([0.0, 1.0]), (), None, now_in), tick * tick_ns)
        position += ratio * dt_s
    assert any("'elbow' has moved by" in text for text in texts) == is_found


def test_a_joint_that_loses_power_after_ten_seconds_in_mode_velocity_is_noticed_within_two():
    check = FollowingCheck(LIMITS, 0.2, SECOND)
    position, found_at = 0.0, None
    for tick in range(1500):
        at, now = np.array([0.0, position]), tick * TICK
        if check.deviation(at, now, now):
            found_at = now
            break
        check.written(Limited(at, np.array([0.0, 1.0]), (), None, ("position", "velocity")), now)
        position += 0.01 if now < 10 * SECOND else 0.0
    # In the first second that begins without power it is 1 rad short; 0.2 + 1 / 4 + 0.1 are allowed.
    assert found_at is not None
    assert 10 * SECOND < found_at <= 12 * SECOND + 2 * TICK


def test_what_a_joint_does_while_the_host_is_frozen_is_not_compared():
    check = FollowingCheck(LIMITS, 0.2, SECOND)
    for tick in range(50):
        at = np.array([0.0, tick * 0.01])
        assert check.deviation(at, tick * TICK, tick * TICK) == ""
        check.written(Limited(at, np.array([0.0, 1.0]), (), None, ("position", "velocity")), tick * TICK)
    later = 3 * SECOND
    assert check.deviation(np.array([0.0, 3.0]), later, later) == ""
