"""The pose from which an estimate that is not finite any more starts again."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate.odometry.fusion import started
from zstate.odometry.invariant_filter import initial_state
from zstate.odometry.placement import last_pose


@pytest.mark.parametrize(
    ("sigma", "position", "angle"), [(1e-6, 1e-4, 1e-4), (0.01, 0.01, 0.01), (1e7, 1e6, math.pi)]
)
def test_a_last_pose_is_known_to_0_1_mm_at_best_and_to_1000_km_at_worst(
    sigma: float, position: float, angle: float
):
    zero = np.zeros(3)
    state = initial_state(
        rotation=np.eye(3),
        velocity=zero,
        position=zero,
        gyro_bias=zero,
        accel_bias=zero,
        covariance=sigma**2 * np.eye(15),
    )
    pose = last_pose(started(0, state), np.eye(4), "odom", "base_link")
    assert pose.covariance is not None
    assert np.sqrt(np.diag(pose.covariance)) == pytest.approx([position] * 3 + [angle] * 3)
