"""The yaw rate of wheels against that of the gyro: for how long, from which rate and which factor on."""

from __future__ import annotations

import math

import pytest

from zstate.odometry.turning import Turning, constant_difference, disagreement, turned

EXACT = 1e-9


def turning(wheels: float, gyro: float, time_s: float = 10.0) -> Turning:
    """Both rates with equal turns to the left and to the right [rad/s]: their means are zero."""
    return Turning(time_s, 0.0, 0.0, wheels * wheels, gyro * gyro, wheels * gyro)


def test_rates_are_compared_as_means_of_ten_seconds():
    before = Turning(time_s=100.0)
    after = turned(before, rate=0.5, gyro=0.25, noise=0.0, dt_s=0.1)
    assert after.wheels == pytest.approx(0.5 * 0.1 / 10.0)
    assert after.gyro == pytest.approx(0.25 * 0.1 / 10.0)
    assert "rms of 10 s" in disagreement(turning(0.5, -0.5))


def test_rates_are_compared_from_five_seconds_on():
    assert disagreement(turning(0.5, -0.5, time_s=5.0))
    assert disagreement(turning(0.5, -0.5, time_s=5.0 - EXACT)) == ""
    assert constant_difference(turning(0.5, 0.5, time_s=5.0)) is not None
    assert constant_difference(turning(0.5, 0.5, time_s=5.0 - EXACT)) is None


def test_rates_below_0_08_rad_per_s_contradict_nothing():
    assert disagreement(turning(0.08, -0.08))
    assert disagreement(turning(0.08 - EXACT, -0.08 + EXACT)) == ""


@pytest.mark.parametrize("factor", [1.6, 1.0 / 1.6])
def test_the_track_is_wrong_from_a_factor_of_1_6_on(factor: float):
    further = math.copysign(EXACT, factor - 1.0)
    assert "the track is about" in disagreement(turning(0.5 * (factor + further), 0.5))
    assert disagreement(turning(0.5 * (factor - further), 0.5)) == ""


def test_a_gyro_that_measures_less_than_a_fifth_of_the_turn_does_not_turn_with_the_base():
    assert "the gyro does not turn with the base" in disagreement(turning(0.5, 0.1 - EXACT))
    assert "the gyro does not turn with the base" not in disagreement(turning(0.5, 0.1 + EXACT))


@pytest.mark.parametrize("gyro", [0.0, -0.01])
def test_a_gyro_that_hardly_turns_does_not_turn_in_the_opposite_direction(gyro: float):
    assert "the gyro does not turn with the base" in disagreement(turning(0.2, gyro))


def test_rates_above_0_16_rad_per_s_that_are_not_alike_are_at_different_times():
    def unlike(rate: float) -> Turning:
        return Turning(10.0, 0.0, 0.0, rate * rate, rate * rate, product=0.0)

    assert "at different times" in disagreement(unlike(0.16 + EXACT))
    assert disagreement(unlike(0.16)) == ""


def test_the_constant_by_which_wheels_turn_faster_is_that_of_the_line_through_both_rates():
    """Half the time straight on with -0.1 rad/s, half with 0.3; wheels turn by 1.2 times that and 0.02."""
    gyro, wheels = (-0.1, 0.3), (1.2 * -0.1 + 0.02, 1.2 * 0.3 + 0.02)
    means = [sum(one) / 2 for one in (wheels, gyro)]
    squares = [sum(rate * rate for rate in one) / 2 for one in (wheels, gyro)]
    product = sum(one * other for one, other in zip(wheels, gyro, strict=True)) / 2
    found = constant_difference(Turning(10.0, *means, *squares, product))
    # Both are on the line: what is left is 0.004 rad/s, for radii that differ.
    assert found == pytest.approx((0.02, 0.004))
