"""Placement: what a pose that is set does to the estimate of a base, and the pose of an estimate that failed.

The world is turned and moved under the estimate by a transform T, ``X = T X'``. The right-invariant error xi
(``invariant_filter.py``) becomes ``Ad_T xi``: each part turns by the rotation R of T, and errors of points
become ``R xi_p + [t] R phi``. About the base, at the origin of such a world, the error of the yaw and that of
the position are what a placement makes known; all others stay.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zstate import se3
from zstate.checks import Floats
from zstate.odometry.fusion import Drift, Estimate, at_its_estimate, odom_pose
from zstate.odometry.invariant_filter import POSITION, ROTATION, VELOCITY, FilterState, without_tracked
from zstate.odometry.measurements import frame_pose
from zstate.odometry.rotations import skew
from zstate.transform import Transform

_LARGEST = 1e24
"""Variances above that are no estimate."""

_CERTAIN = 1e-4
"""[m] and [rad], the standard deviation of a pose that is set without a covariance."""

_LAST_POSITION, _LAST_ANGLE = 1e6, math.pi
"""[m] and [rad]: the largest standard deviations of a pose to start from again."""

_YAW = ROTATION.start + 2


class Placement(NamedTuple):
    """A pose of the base that is set at ``stamp``: odom_from_base, (4, 4), and its covariance, (6, 6)."""

    stamp: int
    odom_from_base: Floats
    covariance: Floats | None


def placed(estimate: Estimate, placement: Placement, imu_from_base: Floats) -> Estimate:
    """The estimate, without constant errors that are not in its covariance yet, with the base there."""
    placed_state = without_tracked(estimate.state)
    current, _ = frame_pose(placed_state, imu_from_base)
    turn = _yaw(placement.odom_from_base) - _yaw(current)
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = np.array(((cosine, -sine, 0.0), (sine, cosine, 0.0), (0.0, 0.0, 1.0)))
    state = _in_moved_world(placed_state, rotation, -rotation @ current[:3, 3])
    state = state._replace(covariance=_with_known_place(state, placement.covariance))
    state = _in_moved_world(state, np.eye(3), placement.odom_from_base[:3, 3])
    compasses = {
        name: compass._replace(offset=compass.offset - turn) for name, compass in estimate.compasses.items()
    }
    drift = Drift(state.position, estimate.drift.scale)
    estimate = estimate._replace(state=state, drift=drift, runs={}, compasses=compasses, altimeters={})
    return at_its_estimate(estimate)


def is_finite(state: FilterState) -> bool:
    """Whether all numbers of the state are finite, and its variances bounded."""
    vectors = state.velocity.dot(state.velocity) * state.position.dot(state.position)
    biases = state.gyro_bias.dot(state.gyro_bias) * state.accel_bias.dot(state.accel_bias)
    variances = float(state.covariance.trace())
    total = float(vectors + biases + state.rotation.sum() + state.covariance.sum())
    return math.isfinite(total) and 0.0 <= variances <= _LARGEST


def last_pose(estimate: Estimate, imu_from_base: Floats, odom: str, base: str) -> Transform:
    """The continuous pose of the base in a finite estimate, with variances that a filter can start from."""
    _, covariance = frame_pose(estimate.state, imu_from_base)
    matrix, corrected = odom_pose(estimate, imu_from_base)
    covariance += np.outer(corrected, corrected)
    largest = np.repeat((_LAST_POSITION, _LAST_ANGLE), 3) ** 2
    variances = np.diag(np.clip(covariance.diagonal(), _CERTAIN**2, largest))
    rotation = se3.quaternion_from_matrix(matrix[:3, :3])
    transform = Transform.from_pose7(odom, base, (*matrix[:3, 3].tolist(), *rotation))
    return transform.with_covariance(variances)


def _yaw(world_from_base: Floats) -> float:
    return math.atan2(world_from_base[1, 0], world_from_base[0, 0])


def _in_moved_world(state: FilterState, rotation: Floats, translation: Floats) -> FilterState:
    """The state and its error after the world has moved: points p are ``rotation @ p + translation``."""
    size = len(state.covariance)
    adjoint = np.eye(size)
    shift = skew(translation) @ rotation
    for start in (ROTATION.start, VELOCITY.start, POSITION.start, *range(15, size, 3)):
        adjoint[start : start + 3, start : start + 3] = rotation
        if start not in (ROTATION.start, VELOCITY.start):
            adjoint[start : start + 3, ROTATION] = shift
    return state._replace(
        rotation=rotation @ state.rotation,
        velocity=rotation @ state.velocity,
        position=rotation @ state.position + translation,
        contacts=state.contacts @ rotation.T + translation,
        covariance=adjoint @ state.covariance @ adjoint.T,
    )


def _with_known_place(state: FilterState, covariance: Floats | None) -> Floats:
    """The covariance of the error with another one of yaw and position, for a base at the origin."""
    size = len(state.covariance)
    place = [6, 7, 8, _YAW]
    change = np.eye(size)
    # Contacts stay where they are seen from the base.
    for start in range(15, size, 3):
        change[start : start + 3, POSITION] = -np.eye(3)
    known = change @ state.covariance @ change.T
    known[place, :] = known[:, place] = 0.0
    rows = [0, 1, 2, 5]
    given = np.eye(4) * _CERTAIN**2 if covariance is None else covariance[np.ix_(rows, rows)]
    known[np.ix_(place, place)] = given
    back = 2.0 * np.eye(size) - change
    return back @ known @ back.T
