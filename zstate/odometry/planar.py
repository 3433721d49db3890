"""Planar output: the states of a base as those of a robot on a plane, for planners that know x, y and yaw.

z, roll and pitch of the base are published as zero, and so are their rates. The estimators know nothing of
it: attitude is still that by gravity, and sensors are tilted by it. What is left out is an error of what is
published, so its square is a part of the covariances: they are those of the true base about the published
one. A variance of nearly zero would say that the base is on the plane.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from zstate import se3
from zstate.checks import Floats
from zstate.odometry.estimator import BaseCovariance, BaseState, BaseTwist
from zstate.odometry.map_estimator import MapState
from zstate.transform import UPPER_TRIANGLE, PoseWithCovariance, Transform


def in_plane(state: BaseState) -> BaseState:
    """The state with z, roll and pitch zero; its twist is that in the axes of the levelled base."""
    pose, left_out = _levelled(state.odom_from_base)
    level_from_base = pose.matrix[:3, :3].T @ state.odom_from_base.matrix[:3, :3]
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = level_from_base
    x, y, z, *roll_pitch, yaw = (turned @ np.concatenate(state.twist)).tolist()
    rates_left_out = np.array((0.0, 0.0, z, *roll_pitch, 0.0))
    covariance = BaseCovariance(
        state.covariance.pose + np.outer(left_out, left_out),
        turned @ state.covariance.twist @ turned.T + np.outer(rates_left_out, rates_left_out),
    )
    return replace(
        state,
        odom_from_base=PoseWithCovariance.of_pose(pose, covariance.pose[UPPER_TRIANGLE].tolist),
        twist=BaseTwist(np.array((x, y, 0.0)), np.array((0.0, 0.0, yaw))),
        covariance=covariance,
    )


def map_in_plane(state: MapState) -> MapState:
    """The state with z, roll and pitch of the base in the map zero, and z of map -> odom."""
    pose, left_out = _levelled(state.map_from_base)
    edge = state.map_from_odom
    x, y, _, *rotation = edge.pose7.tolist()
    return MapState(
        state.stamp,
        pose,
        Transform.from_pose7(edge.target, edge.source, (x, y, 0.0, *rotation), state.stamp),
        state.covariance + np.outer(left_out, left_out),
    )


def _levelled(pose: Transform) -> tuple[Transform, Floats]:
    """The pose with x, y and yaw alone, and what it leaves out, (6,), as of ``Transform.covariance``.

    The yaw is the direction of the base's x axis, which is not left out, whatever the tilt.
    """
    x, y, z = pose.translation.tolist()
    half = 0.5 * pose.rpy[2]
    level = (0.0, 0.0, math.sin(half), math.cos(half))
    levelled = Transform.from_pose7(pose.target, pose.source, (x, y, 0.0, *level), pose.stamp)
    tilt = pose.matrix[:3, :3] @ levelled.matrix[:3, :3].T
    roll, pitch, _ = se3.rotation_vector(se3.quaternion_from_matrix(tilt), se3.SCALARS)
    return levelled, np.array((0.0, 0.0, z, roll, pitch, 0.0))
