"""Calibration between counts and positions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.driving.driver import Calibration
from zstate.errors import InvalidInput


def test_a_quarter_of_a_turn_of_a_geared_joint_is_that_of_its_motor_times_the_ratio():
    calibration = Calibration(4096, zero=2048, sign=-1, ratio=50.0)
    quarter = 4096 * 50 // 4
    assert calibration.to_counts([math.pi / 2]).tolist() == [2048 - quarter]
    assert np.allclose(calibration.to_positions([2048 - quarter, 2048]), [math.pi / 2, 0.0], atol=1e-15)
    assert np.allclose(calibration.to_velocities([-4096 * 50]), [2 * math.pi])


def test_each_joint_has_its_own_numbers():
    calibration = Calibration([4096, 1000], zero=[0, 10], sign=[1, -1], travel=[math.tau, 0.005])
    assert np.allclose(calibration.to_positions([1024, -490]), [math.pi / 2, 0.0025])


@given(
    st.integers(-(2**31), 2**31 - 1),
    st.integers(1, 2**24),
    st.integers(-(2**31), 2**31 - 1),
    st.sampled_from([-1, 1]),
    st.floats(0.01, 1000.0),
)
def test_counts_survive_the_way_to_positions_and_back(counts, resolution, zero, sign, ratio):
    calibration = Calibration(resolution, zero, sign, ratio)
    assert calibration.to_counts(calibration.to_positions([counts])).tolist() == [counts]


@given(st.floats(-100.0, 100.0), st.integers(100, 2**20), st.sampled_from([-1, 1]))
def test_a_position_is_reproduced_to_half_a_count(position, resolution, sign):
    calibration = Calibration(resolution, sign=sign)
    back = calibration.to_positions(calibration.to_counts([position]))
    assert abs(back[0] - position) <= 0.5 * math.tau / resolution * (1 + 1e-9)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((0,), "counts_per_revolution is positive"),
        ((math.nan,), "counts_per_revolution is positive"),
        ((4096, 0, 0), "sign is 1 or -1"),
        ((4096, 0, 1, -2.0), "ratio is positive"),
        ((4096, math.inf), "zero is a finite number"),
        (([1, 2], [1, 2, 3]), "one number for all joints, or one for each"),
    ],
)
def test_a_calibration_that_no_encoder_has_is_refused(arguments, text: str):
    with pytest.raises(InvalidInput, match=text):
        Calibration(*arguments)


def test_a_position_that_is_no_number_has_no_counts():
    with pytest.raises(InvalidInput, match="must be finite"):
        Calibration(4096).to_counts([0.0, math.nan])
