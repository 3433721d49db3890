"""Planar output: what is kept, and that the covariances have what is left out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zstate import TransformBuffer
from zstate.odometry.estimator import BaseCovariance, BaseState, BaseTwist
from zstate.odometry.map_estimator import MapState
from zstate.odometry.planar import in_plane, map_in_plane
from zstate.se3 import to_matrix
from zstate.transform import PoseWithCovariance, Transform

STAMP = 1_700_000_000_000_000_000
SIGMAS = np.array((0.1, 0.2, 0.3, 0.01, 0.02, 0.03))


def state(
    place: tuple[float, float, float], rpy: tuple[float, float, float], twist: tuple[float, ...] = (0.0,) * 6
) -> BaseState:
    pose = Transform.from_rpy("odom", "base", place, rpy, stamp=STAMP).with_covariance(np.diag(SIGMAS**2))
    covariance = BaseCovariance(np.diag(SIGMAS**2), np.diag(SIGMAS**2))
    linear, angular = np.array(twist[:3]), np.array(twist[3:])
    return BaseState(STAMP, pose, BaseTwist(linear, angular), covariance, np.zeros(3), np.zeros(3), False)


def test_a_base_on_a_ramp_is_level_and_its_x_y_and_yaw_stay():
    found = in_plane(state((1.0, 2.0, 0.5), (0.1, -0.2, 0.7)))
    pose = found.odom_from_base
    assert pose.stamp == found.stamp == STAMP
    np.testing.assert_allclose(pose.translation, (1.0, 2.0, 0.0))
    np.testing.assert_allclose(pose.rpy, (0.0, 0.0, 0.7), atol=1e-12)


def test_the_velocity_is_in_the_axes_of_the_level_base():
    """1 m/s up a ramp of 0.3 rad, with 0.5 rad/s about the base's z axis."""
    found = in_plane(state((0.0, 0.0, 0.0), (0.0, -0.3, 1.2), (1.0, 0.0, 0.0, 0.0, 0.0, 0.5)))
    np.testing.assert_allclose(found.twist.linear, (math.cos(0.3), 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(found.twist.angular, (0.0, 0.0, 0.5 * math.cos(0.3)), atol=1e-12)
    left_out = math.sin(0.3)
    turned = 0.3**2 * math.cos(0.3) ** 2 + 0.1**2 * math.sin(0.3) ** 2
    assert found.covariance.twist[2, 2] == pytest.approx(turned + left_out**2)


def test_a_level_base_in_the_plane_is_as_it_was():
    before = state((1.0, 2.0, 0.0), (0.0, 0.0, 0.7), (1.0, 0.2, 0.0, 0.0, 0.0, 0.3))
    after = in_plane(before)
    np.testing.assert_allclose(after.odom_from_base.pose7, before.odom_from_base.pose7, atol=1e-12)
    np.testing.assert_allclose(np.concatenate(after.twist), np.concatenate(before.twist), atol=1e-12)
    for one, other in zip(after.covariance, before.covariance, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)


@pytest.mark.parametrize("rpy", [(0.0, -0.1, 0.0), (0.05, -0.1, 2.0), (-0.2, 0.1, -1.0)])
def test_the_truth_is_inside_of_what_a_lookup_claims_of_a_point_on_the_base(rpy: tuple[float, float, float]):
    """Of the camera 2 m ahead, the height that is left out is one sigma, and what is kept stays certain."""
    before = state((1.0, 2.0, 0.4), rpy)
    buffer = TransformBuffer()
    after = in_plane(before)
    assert isinstance(after.odom_from_base, PoseWithCovariance)
    np.testing.assert_allclose(after.odom_from_base.covariance, after.covariance.pose)
    buffer.insert(after.odom_from_base)
    buffer.insert_static(Transform("base", "camera", (2.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    found = buffer.lookup("odom", "camera", STAMP)
    truth = to_matrix(before.odom_from_base.pose7) @ (2.0, 0.0, 0.0, 1.0)
    assert found.covariance is not None
    away = truth[2] - found.translation[2]
    assert abs(away) > 0.19
    assert abs(away) < 1.1 * math.sqrt(found.covariance[2, 2])
    assert found.covariance[2, 2] < 1.1 * (away**2 + 0.3**2 + (2.0 * 0.03) ** 2)
    np.testing.assert_allclose(np.diag(after.covariance.pose)[[0, 1, 5]], SIGMAS[[0, 1, 5]] ** 2)
    np.testing.assert_allclose(np.linalg.eigvalsh(after.covariance.pose) >= 0.0, True)


def test_map_to_odom_to_base_is_level_in_the_map():
    odom = state((1.0, 2.0, 0.5), (0.1, -0.2, 0.7))
    there = Transform.from_rpy("map", "base", (-4.0, 3.0, 12.0), (0.1, -0.2, 1.9), stamp=STAMP)
    turned = np.eye(3)
    turned[:2, :2] = ((math.cos(1.2), -math.sin(1.2)), (math.sin(1.2), math.cos(1.2)))
    shift = there.translation - turned @ odom.odom_from_base.translation
    edge = Transform.from_rpy("map", "odom", shift.tolist(), (0.0, 0.0, 1.2), stamp=STAMP)
    found = map_in_plane(MapState(STAMP, there, edge, np.diag(SIGMAS**2)))
    together = found.map_from_odom.matrix @ in_plane(odom).odom_from_base.matrix
    np.testing.assert_allclose(together, found.map_from_base.matrix, atol=1e-12)
    np.testing.assert_allclose(found.map_from_base.translation, (-4.0, 3.0, 0.0))
    np.testing.assert_allclose(found.map_from_base.rpy, (0.0, 0.0, 1.9), atol=1e-12)
    assert found.covariance[2, 2] == pytest.approx(12.0**2 + 0.3**2)
