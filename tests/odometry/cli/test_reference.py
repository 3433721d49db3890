"""Errors of odometry against a reference, of paths whose errors are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.errors import InvalidInput
from zstate.odometry.cli.reference import PlanarTrajectory, ReferenceName, compared, parse_reference

COUNT = 400
STAMPS = np.arange(COUNT, dtype=np.int64) * 100_000_000
ANGLES = np.linspace(0.0, 1.5 * math.pi, COUNT)
CIRCLE = np.stack((10.0 * np.sin(ANGLES), 10.0 * (1.0 - np.cos(ANGLES))), axis=1)


def moved(points: np.ndarray, x: float, y: float, yaw: float) -> np.ndarray:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return points @ np.array(((cosine, sine), (-sine, cosine))) + (x, y)


def path(positions: np.ndarray, sigma: float | None) -> PlanarTrajectory:
    covariances = None if sigma is None else np.tile(sigma**2 * np.eye(2), (len(positions), 1, 1))
    return PlanarTrajectory(STAMPS[: len(positions)], positions, covariances)


def test_shift_and_turn_of_the_frame_are_no_error():
    found = compared("pose/gps", path(CIRCLE, 0.1), path(moved(CIRCLE, 5.0, -3.0, 2.5), 0.2))
    assert found.ate_m == pytest.approx(0.0, abs=1e-9)
    assert found.end_m == pytest.approx(0.0, abs=1e-9)
    assert found.nees == pytest.approx(0.0, abs=1e-9)
    assert found.positions == pytest.approx(CIRCLE, abs=1e-9)


def test_ate_is_the_root_of_the_mean_square_that_a_rigid_motion_leaves():
    """A straight way with errors of +-0.3 m across it by turns: neither shift nor turn takes them."""
    straight = np.stack((np.linspace(-5.0, 5.0, COUNT), np.zeros(COUNT)), axis=1)
    truth = straight + np.stack((np.zeros(COUNT), np.tile((0.3, -0.3, -0.3, 0.3), COUNT // 4)), axis=1)
    found = compared("pose/gps", path(straight, None), path(moved(truth, 1.0, 1.0, -1.0), None))
    assert found.ate_m == pytest.approx(0.3, rel=1e-3)
    assert found.end_m == pytest.approx(0.3, rel=1e-2)
    assert found.nees is None
    assert found.end_sigmas is None


def test_nees_of_right_covariances_is_two_and_of_halved_sigmas_eight():
    """Errors of x and y have 0.3^2 + 0.4^2 = 0.5^2; three numbers of the placement are fitted."""
    errors = np.random.default_rng(1).normal(0.0, 0.5, CIRCLE.shape)
    truth = moved(CIRCLE + errors, 3.0, 1.0, 1.0)
    expected = 2.0 - 3.0 / COUNT
    right = compared("pose/gps", path(CIRCLE, 0.3), path(truth, 0.4))
    # The mean of 400 has a standard deviation of sqrt(2 * 2 / 400).
    assert right.nees == pytest.approx(expected, abs=4.0 * 0.1)
    halved = compared("pose/gps", path(CIRCLE, 0.15), path(truth, 0.2))
    assert right.nees is not None
    assert halved.nees == pytest.approx(4.0 * right.nees, rel=1e-6)
    end = np.hypot(*(errors[-1])) / 0.5
    assert right.end_sigmas == pytest.approx(end, abs=0.3)


def test_covariances_of_the_odometry_are_turned_into_the_frame_of_the_reference():
    """Odometry that is uncertain along its x only, in a frame turned by 90 degrees: that is y there."""
    straight = np.stack((np.linspace(0.0, 10.0, COUNT), np.zeros(COUNT)), axis=1)
    claimed = np.tile(np.diag((1.0, 1e-6)), (COUNT, 1, 1))
    # Wrong along the way only, so that no motion of the frame takes it.
    bent = straight * np.where(straight[:, :1] > 5.0, 1.1, 1.0)
    odometry = PlanarTrajectory(STAMPS, straight, claimed)
    found = compared("pose/gps", odometry, path(moved(bent, 0.0, 0.0, math.pi / 2), 0.01))
    assert found.end_sigmas is not None
    assert found.end_sigmas < 1.5


def test_readings_are_compared_while_there_is_odometry():
    later = PlanarTrajectory(STAMPS[:100], CIRCLE[:100], None)
    assert compared("pose/gps", later, path(CIRCLE, None)).count == 100
    with pytest.raises(InvalidInput, match="pose/gps has 2 readings while there is odometry; 3 or more"):
        compared("pose/gps", PlanarTrajectory(STAMPS[:2], CIRCLE[:2], None), path(CIRCLE, None))


def test_robot_that_stood_still_has_an_error_as_well():
    still = np.zeros_like(CIRCLE)
    found = compared("pose/gps", path(still, 0.1), path(still + np.array((2.0, 1.0)), 0.1))
    assert found.nees == pytest.approx(0.0, abs=1e-9)


def test_reference_is_a_stream_with_its_noise():
    assert parse_reference("pose/gps") == ReferenceName("pose", "gps")
    assert parse_reference("odometry/laser:sigma=0.02") == ReferenceName("odometry", "laser", 0.02)
    for text, error in (
        ("gps", "a reference is pose/SENSOR or odometry/WRITER, not 'gps'"),
        ("poes/gps", "did you mean 'pose'"),
        ("pose/", "name"),
        ("pose/gps:sigma=x", "'sigma=x' is not sigma=METRES; write pose/gps:sigma=0.02"),
        ("pose/gps:sigma=-1", "sigma is a standard deviation above zero"),
    ):
        with pytest.raises(InvalidInput, match=error):
            parse_reference(text)
