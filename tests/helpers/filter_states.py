"""States of the invariant filter, and its error by the definition: matrices of SE_{2+k}(3)."""

import math
from collections.abc import Callable

import numpy as np

from zstate.odometry.invariant_filter import FilterState, Floats, Tracked
from zstate.odometry.rotations import rotation_exp


def some_state(feet: int = 2) -> FilterState:
    """A state far from zero in all of its parts, with a full covariance."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(15 + 3 * feet, 15 + 3 * feet)) * 0.05
    return FilterState(
        rotation_exp(rng.normal(size=3)),
        rng.normal(size=3),
        rng.normal(size=3) * 3.0,
        rng.normal(size=3) * 0.05,
        rng.normal(size=3) * 0.2,
        tuple(f"foot{i}" for i in range(feet)),
        rng.normal(size=(feet, 3)) * 3.0,
        root @ root.T,
    )


def log_so3(rotation: Floats) -> Floats:
    """The turn of a rotation, less than pi, from its trace and its antisymmetric part."""
    sines = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine = float(np.linalg.norm(sines))
    angle = math.atan2(sine, np.trace(rotation) - 1.0)
    return sines * (0.5 if sine < 1e-12 else angle / sine)


def moved(state: FilterState, error: Floats) -> FilterState:
    """``exp(error) state``, by the power series of the matrix exponential; biases are added."""
    size = 5 + len(state.contacts)
    algebra = np.zeros((size, size))
    algebra[:3, :3] = np.cross(np.eye(3), error[:3])
    first = 15 + 7 * len(state.tracked)
    algebra[:3, 3:] = np.concatenate((error[3:9], error[first:])).reshape(-1, 3).T
    matrix = _series(algebra) @ _group(state)
    errors = error[15:first].reshape(-1, 7)
    return state._replace(
        tracked=tuple(moved_pose(one, part) for one, part in zip(state.tracked, errors, strict=True)),
        rotation=matrix[:3, :3],
        velocity=matrix[:3, 3],
        position=matrix[:3, 4],
        contacts=matrix[:3, 5:].T,
        gyro_bias=state.gyro_bias + error[9:12],
        accel_bias=state.accel_bias + error[12:15],
    )


def moved_pose(tracked: Tracked, error: Floats) -> Tracked:
    """``exp(error) tracked``, and the logarithm of the scale plus its error."""
    algebra, pose = np.zeros((4, 4)), np.eye(4)
    algebra[:3, :3], algebra[:3, 3] = np.cross(np.eye(3), error[:3]), error[3:6]
    pose[:3, :3], pose[:3, 3] = tracked.rotation, tracked.position
    pose = _series(algebra) @ pose
    log_scale = tracked.log_scale + float(error[6])
    return Tracked(tracked.source, pose[:3, :3], pose[:3, 3], log_scale)


def _series(algebra: Floats) -> Floats:
    matrix = power = np.eye(len(algebra))
    for n in range(1, 30):
        power = power @ algebra / n
        matrix = matrix + power
    return matrix


def small_error(truth: FilterState, estimate: FilterState) -> Floats:
    """The right-invariant error of the definition X = exp(xi) X', to first order in xi."""
    product = _group(truth) @ np.linalg.inv(_group(estimate))
    biases = (truth.gyro_bias - estimate.gyro_bias, truth.accel_bias - estimate.accel_bias)
    points = product[:3, 3:].T
    return np.concatenate((log_so3(product[:3, :3]), points[0], points[1], *biases, points[2:].ravel()))


def derivative(function: Callable[[Floats], Floats], size: int) -> Floats:
    """The derivative of ``function`` at zero, by central differences."""
    step = 1e-5
    columns = [(function(step * row) - function(-step * row)) / (2.0 * step) for row in np.eye(size)]
    return np.array(columns).T


def _group(state: FilterState) -> Floats:
    """The matrix of SE_{2+k}(3)."""
    matrix = np.eye(5 + len(state.contacts))
    matrix[:3, :3] = state.rotation
    matrix[:3, 3:] = np.vstack((state.velocity, state.position, state.contacts)).T
    return matrix
