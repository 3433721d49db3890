"""Rigid motions against matrices and closed forms; one formula for floats and for arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate import se3

angles = st.floats(-math.pi, math.pi)
lengths = st.floats(-10.0, 10.0)
vectors = st.tuples(lengths, lengths, lengths)
quaternions = st.tuples(angles, angles, angles).map(lambda rpy: se3.quaternion_from_rpy(*rpy))
poses = st.builds(lambda t, q: (*t, *q), vectors, quaternions)
ratios = st.floats(0.0, 1.0)


def hat(vector) -> np.ndarray:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def matrix_of(q) -> np.ndarray:
    """R = 1 + 2 w [u] + 2 [u]^2, written with matrices."""
    u = hat(q[:3])
    return np.eye(3) + 2.0 * q[3] * u + 2.0 * u @ u


@given(poses, vectors)
def test_a_pose_acts_on_points_as_its_matrix_does(pose, point) -> None:
    moved = np.add(pose[:3], se3.rotate(pose[3:], point))
    expected = matrix_of(pose[3:]) @ point + pose[:3]
    np.testing.assert_allclose(moved, expected, atol=1e-13)
    np.testing.assert_allclose((se3.to_matrix(pose) @ (*point, 1.0))[:3], expected, atol=1e-13)


@given(poses, poses)
def test_composing_poses_multiplies_their_matrices(a, b) -> None:
    product = se3.to_matrix(a) @ se3.to_matrix(b)
    np.testing.assert_allclose(se3.to_matrix(se3.compose(a, b)), product, atol=1e-13)


@given(poses)
def test_a_pose_after_its_inverse_is_the_identity(pose) -> None:
    np.testing.assert_allclose(se3.to_matrix(se3.compose(pose, se3.invert(pose))), np.eye(4), atol=1e-13)


@given(st.tuples(angles, angles, angles))
def test_rpy_is_roll_then_pitch_then_yaw_about_fixed_axes(rpy) -> None:
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    np.testing.assert_allclose(matrix_of(se3.quaternion_from_rpy(*rpy)), yaw @ pitch @ roll, atol=1e-14)


@given(quaternions)
def test_rpy_and_matrix_of_a_quaternion_lead_back_to_the_same_turn(q) -> None:
    again = se3.quaternion_from_rpy(*se3.rpy_from_quaternion(q))
    np.testing.assert_allclose(matrix_of(again), matrix_of(q), atol=1e-11)
    again = se3.quaternion_from_matrix(matrix_of(q))
    np.testing.assert_allclose(matrix_of(again), matrix_of(q), atol=1e-14)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_at_a_pitch_of_a_right_angle_roll_is_zero(sign: float) -> None:
    q = se3.quaternion_from_rpy(0.25, sign * math.pi / 2, 0.5)
    roll, pitch, yaw = se3.rpy_from_quaternion(q)
    assert roll == 0.0
    assert pitch == pytest.approx(sign * math.pi / 2)
    assert yaw == pytest.approx(0.5 - sign * 0.25)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.0, -0.8)])
def test_the_matrix_of_half_a_turn_gives_its_axis(axis) -> None:
    q = se3.quaternion_from_matrix(2.0 * np.outer(axis, axis) - np.eye(3))
    assert abs(np.dot(q[:3], axis)) == pytest.approx(1.0, abs=1e-15)


@given(st.tuples(angles, angles, angles))
def test_a_turn_and_its_rotation_vector_undo_each_other(vector) -> None:
    if np.linalg.norm(vector) >= math.pi:
        vector = tuple(0.3 * np.array(vector))
    again = se3.rotation_vector(se3.quaternion_exp(vector, se3.SCALARS), se3.SCALARS)
    np.testing.assert_allclose(again, vector, atol=1e-14)


@given(st.floats(0.0, 3.1), ratios, vectors)
def test_slerp_turns_at_a_constant_rate_about_one_axis(angle, ratio, translation) -> None:
    first = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    second = (*translation, *se3.quaternion_exp((0.0, angle, 0.0), se3.SCALARS))
    between = se3.interpolate(first, second, ratio, se3.SCALARS)
    np.testing.assert_allclose(between[:3], np.multiply(ratio, translation), atol=1e-14)
    np.testing.assert_allclose(
        between[3:], se3.quaternion_exp((0.0, ratio * angle, 0.0), se3.SCALARS), atol=1e-14
    )


@given(st.floats(-16.0, -6.0))
def test_slerp_keeps_the_smallest_turns(exponent) -> None:
    angle = 10.0**exponent
    second = (0.0, 0.0, 0.0, math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2))
    between = se3.interpolate(se3.IDENTITY, second, 0.25, se3.SCALARS)
    assert between[3] == pytest.approx(angle / 8, rel=1e-9)


@given(poses, poses, ratios)
def test_slerp_ignores_the_sign_of_a_quaternion(first, second, ratio) -> None:
    opposite = (*second[:3], *(-value for value in second[3:]))
    a = se3.interpolate(first, second, ratio, se3.SCALARS)
    b = se3.interpolate(first, opposite, ratio, se3.SCALARS)
    if abs(np.dot(first[3:], second[3:])) > 1e-9:
        np.testing.assert_allclose(matrix_of(a[3:]), matrix_of(b[3:]), atol=1e-9)


def test_at_exactly_half_a_turn_the_quaternion_keeps_its_sign() -> None:
    for axis in (1.0, -1.0):
        between = se3.interpolate(se3.IDENTITY, (0, 0, 0, 0, 0, axis, 0), 0.5, se3.SCALARS)
        np.testing.assert_allclose(between[3:], (0, 0, axis * math.sqrt(0.5), math.sqrt(0.5)), atol=1e-15)


@given(st.lists(st.tuples(poses, poses, ratios), min_size=1, max_size=8))
def test_arrays_and_floats_give_the_same_numbers(cases) -> None:
    firsts, seconds, many = (np.array(column) for column in zip(*cases, strict=True))
    together = se3.interpolate(se3.unstack(firsts), se3.unstack(seconds), many, se3.ARRAYS)
    together = se3.normalize(se3.compose(together, se3.invert(se3.unstack(seconds))), se3.ARRAYS)
    for row, (first, second, ratio) in zip(np.stack(together, axis=-1), cases, strict=True):
        alone = se3.compose(se3.interpolate(first, second, ratio, se3.SCALARS), se3.invert(second))
        np.testing.assert_allclose(row, se3.normalize(alone, se3.SCALARS), atol=1e-13)
