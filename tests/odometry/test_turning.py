"""The yaw rate of wheels against that of the gyro: for how long, from which rate and which factor on."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.odometry.turning import Turning, constant_difference, disagreement, turned

EXACT = 1e-9
RADII = 0.004
"""[rad/s] The standard deviation of the rate of wheels, whose radii differ."""


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
    assert found is not None
    # Both are on the line: what is left is 0.004 rad/s, for radii that differ.
    assert found == pytest.approx((0.02, RADII, 0.0), abs=10.0 * EXACT)


def test_the_noise_of_the_gyro_averages_out_of_a_straight_drive_in_ten_seconds():
    comparison = Turning()
    for _ in range(200):
        comparison = turned(comparison, rate=0.0, gyro=0.0, noise=4e-4, dt_s=0.05)
    found = constant_difference(comparison)
    assert found is not None
    assert found.noise == pytest.approx(math.sqrt(4e-4 / 200))
    assert found.sigma == pytest.approx(math.hypot(RADII, found.noise))


def test_in_a_steady_turn_the_constant_is_as_unsure_as_the_scale_of_the_wheels():
    rate = 0.2
    found = constant_difference(Turning(10.0, rate, rate, rate * rate, rate * rate, rate * rate))
    assert found is not None
    assert found.noise == pytest.approx(0.3 * rate)


@pytest.mark.parametrize(("wheels", "gyro"), [(0.02, 0.0), (0.0, -0.02)])
def test_on_a_straight_drive_the_scale_of_the_wheels_makes_no_constant_unsure(wheels: float, gyro: float):
    found = constant_difference(Turning(10.0, wheels, gyro, wheels**2, gyro**2, wheels * gyro))
    assert found == pytest.approx((0.02, RADII, 0.0), abs=10.0 * EXACT)


@pytest.mark.parametrize("is_bounded", [False, True], ids=["white", "of a vibration"])
def test_the_constant_is_as_unsure_as_it_is_found_however_the_gyro_is_noisy(is_bounded: bool):
    """Drives of 10 s with wheels that turn 5 % too much: a rate for each 4 s, read at 20 Hz."""
    random, scores = np.random.default_rng(0), list[float]()
    for _ in range(400):
        rates = np.repeat(random.uniform(-0.3, 0.3, 3), 80)[:200]
        noise = 0.03 * random.standard_normal(len(rates) + 1)
        added = 0.1 * np.diff(noise) if is_bounded else noise[1:]
        comparison = Turning()
        for rate, gyro in zip((1.05 * rates).tolist(), (rates + added).tolist(), strict=True):
            comparison = turned(comparison, rate, gyro, 0.03**2, 0.05)
        found = constant_difference(comparison)
        if found is not None:
            scores.append(found.apart / found.sigma)
    assert len(scores) > 200
    assert np.sqrt(np.mean(np.square(scores))) < 1.0
    assert np.max(np.abs(scores)) < 3.5
