"""Measurements of the invariant filter: their derivatives, and poses and twists with covariances."""

from collections.abc import Callable

import numpy as np
import pytest
from helpers.filter_states import derivative, log_so3, moved, some_state

from zstate import InvalidInput
from zstate.odometry import measurements
from zstate.odometry.invariant_filter import FilterState, Floats, Measurement, updated, with_tracked
from zstate.odometry.rotations import rotation_exp

GYRO = np.array([0.3, -0.5, 0.8])


def mount() -> Floats:
    """imu_from_frame: off by a lever, and turned about all axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_exp(np.array([0.4, -1.1, 2.0]))
    matrix[:3, 3] = 0.3, -0.2, 0.5
    return matrix


KINDS: dict[str, Callable[[FilterState], Measurement]] = {
    "body velocity": lambda s: measurements.body_velocity(s, np.ones(3), np.eye(3), mount(), GYRO),
    "zero velocity": lambda s: measurements.zero_velocity(s, GYRO, 0.1, 0.01),
    "position": lambda s: measurements.position(s, np.ones(3), np.eye(3), mount()),
    "heading": lambda s: measurements.heading(s, 0.4, 1.0, mount()[:3, 0]),
    "contact": lambda s: measurements.contact(s, "foot1", np.ones(3), np.eye(3)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_jacobian_is_the_derivative_of_what_is_expected(kind: str):
    state, measure = some_state(), KINDS[kind]
    # The residual is measured minus expected.
    expected = derivative(lambda error: -measure(moved(state, error)).residual, len(state.covariance))
    np.testing.assert_allclose(measure(state).jacobian, expected, atol=1e-9)


def test_the_jacobian_of_a_pose_is_the_derivative_near_the_expected_pose():
    state = some_state()
    here, _ = measurements.frame_pose(state, mount())
    expected = derivative(
        lambda error: -measurements.pose(moved(state, error), here, np.eye(6), mount()).residual,
        len(state.covariance),
    )
    np.testing.assert_allclose(
        measurements.pose(state, here, np.eye(6), mount()).jacobian, expected, atol=1e-9
    )


@pytest.mark.parametrize("log_scale", [0.0, 0.3])
def test_another_odometry_that_is_where_the_body_is_differs_by_both_errors(log_scale: float):
    state = with_tracked(some_state(), "camera", 0.1)
    state = state._replace(tracked=(state.tracked[0]._replace(log_scale=log_scale),))

    def expected(error: Floats) -> Floats:
        return -measurements.tracking(moved(state, error), "camera", np.eye(6), mount()).residual

    measured = measurements.tracking(state, "camera", np.eye(6), mount())
    np.testing.assert_allclose(measured.jacobian, derivative(expected, len(state.covariance)), atol=1e-9)
    np.testing.assert_allclose(measured.residual, 0.0, atol=1e-12)


def test_the_pose_of_a_frame_has_the_covariance_of_its_errors_in_world_axes():
    state = some_state()

    def errors(error: Floats) -> Floats:
        truth, _ = measurements.frame_pose(moved(state, error), mount())
        return np.concatenate((truth[:3, 3] - estimate[:3, 3], log_so3(truth[:3, :3] @ estimate[:3, :3].T)))

    estimate, covariance = measurements.frame_pose(state, mount())
    by_error = derivative(errors, len(state.covariance))
    np.testing.assert_allclose(covariance, by_error @ state.covariance @ by_error.T, atol=1e-9)
    # p_w = R (R_f p_f + r) + p
    np.testing.assert_allclose(estimate[:3, :3], state.rotation @ mount()[:3, :3])
    np.testing.assert_allclose(estimate[:3, 3], state.position + state.rotation @ mount()[:3, 3])


def test_the_twist_of_a_frame_has_the_lever_of_its_mount_and_the_noise_of_the_gyro():
    state = some_state()

    def twist(error: Floats) -> Floats:
        return measurements.frame_twist(moved(state, error), mount(), GYRO, 0.0)[0]

    by_error = derivative(twist, len(state.covariance))
    by_gyro = derivative(lambda noise: measurements.frame_twist(state, mount(), GYRO + noise, 0.0)[0], 3)
    values, covariance = measurements.frame_twist(state, mount(), GYRO, 0.01)
    expected = by_error @ state.covariance @ by_error.T + 0.01 * by_gyro @ by_gyro.T
    np.testing.assert_allclose(covariance, expected, atol=1e-9)
    rate = GYRO - state.gyro_bias
    at_frame = state.rotation.T @ state.velocity + np.cross(rate, mount()[:3, 3])
    np.testing.assert_allclose(values, np.concatenate((at_frame, rate)) @ np.kron(np.eye(2), mount()[:3, :3]))


def test_positions_with_an_uncertain_yaw_lie_on_an_arc():
    """A base at (3, 4) m that turned about the origin by an angle of the standard deviation 0.6."""
    sigma, random = 0.6, np.random.default_rng(1)
    covariance = np.zeros((6, 6))
    # To first order the error of the position is t (-4, 3).
    covariance[:2, 5] = covariance[5, :2] = sigma**2 * np.array([-4.0, 3.0])
    covariance[:2, :2], covariance[5, 5] = sigma**2 * np.outer([-4.0, 3.0], [-4.0, 3.0]), sigma**2
    along = (np.cos(random.normal(0.0, sigma, 200_000)) - 1.0) * 5.0
    direction = np.array([0.6, 0.8])
    bent = measurements.yaw_curvature(covariance)
    np.testing.assert_allclose(bent, np.mean(along**2) * np.outer(direction, direction), rtol=0.02)
    # Both forms meet at small angles, where 1 - cos t is t^2 / 2, whose square has the mean 3/4 sigma^4.
    small = measurements.yaw_curvature(covariance * (0.0101 / sigma**2))
    np.testing.assert_allclose(small, 0.75 * 0.0101**2 * 25.0 * np.outer(direction, direction), rtol=0.02)


def test_a_measured_pose_moves_the_frame_to_it():
    state = some_state()
    here, _ = measurements.frame_pose(state, mount())
    there = here.copy()
    there[:3, :3] = rotation_exp(np.array([0.01, -0.02, 0.03])) @ here[:3, :3]
    there[:3, 3] += 0.01, 0.02, -0.03
    measurement = measurements.pose(state, there, np.eye(6) * 1e-10, mount())
    np.testing.assert_allclose(measurement.residual, [0.01, 0.02, -0.03, 0.01, -0.02, 0.03], atol=1e-12)
    np.testing.assert_allclose(
        measurements.frame_pose(updated(state, measurement), mount())[0], there, atol=1e-3
    )


def test_headings_differ_by_the_short_way_round():
    state = some_state(feet=0)._replace(rotation=rotation_exp(np.array([0.0, 0.0, 3.0])))
    residual = measurements.heading(state, -3.0, 1.0, np.eye(3)[0]).residual
    assert residual[0] == pytest.approx(2.0 * np.pi - 6.0)


def test_an_axis_within_six_degrees_of_the_vertical_has_no_heading():
    def heading(degrees: float) -> Measurement:
        turn = np.array([0.0, np.radians(degrees), 0.0])
        return measurements.heading(
            some_state(feet=0)._replace(rotation=rotation_exp(turn)), 0.0, 1.0, np.eye(3)[0]
        )

    with pytest.raises(InvalidInput, match="87 degrees from level"):
        heading(87.0)
    with pytest.raises(InvalidInput, match="84 degrees from level"):
        heading(84.001)
    assert heading(83.999).residual == pytest.approx(0.0)


def test_a_contact_that_is_not_there_is_refused_by_name():
    with pytest.raises(InvalidInput, match="'tail' is not in contact"):
        measurements.contact(some_state(), "tail", np.zeros(3), np.eye(3))
