"""Rotations as matrices: against their power series, and cross products against numpy's."""

import math

import numpy as np
import pytest

from zstate.odometry.rotations import SKEW, gammas, rotation_exp, skew


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.316, 0.317, 1.0, 3.1, 7.0])
def test_the_integrals_of_a_turn_are_their_power_series(angle: float):
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    power, expected = np.eye(3), np.zeros((3, 3, 3))
    for n in range(40):
        expected += [power / math.factorial(n + m) for m in range(3)]
        power = power @ np.cross(np.eye(3), vector)
    np.testing.assert_allclose(gammas(vector), expected, rtol=0.0, atol=1e-13)
    np.testing.assert_array_equal(rotation_exp(vector), gammas(vector)[0])


def test_a_skew_matrix_is_the_cross_product():
    u, v = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.0])
    np.testing.assert_allclose(skew(v) @ u, np.cross(v, u))
    np.testing.assert_array_equal((np.stack((u, v)) @ SKEW).reshape(2, 3, 3), [skew(u), skew(v)])
