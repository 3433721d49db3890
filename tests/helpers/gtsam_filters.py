"""GTSAM's filters beside the invariant filter: the same state, in the coordinates of both.

GTSAM's error is left-invariant, X = X' exp(xi), in the order rotation, position, velocity, feet; the error
here is right-invariant, in the order rotation, velocity, position, biases, feet. The adjoint of X maps the
former to the latter: a turn by phi in the axes of the body is R phi in those of the world, and moves v by [v]
R phi.
"""

from typing import Any

import gtsam
import numpy as np

from zstate.odometry import invariant_filter as iekf
from zstate.odometry.invariant_filter import FilterState, Floats


def imu_parameters(gyro: float, accel: float, integration: float) -> Any:
    """White noise by densities, with the gravity of the invariant filter."""
    parameters = gtsam.PreintegrationParams.MakeSharedU(-float(iekf.GRAVITY[2]))
    parameters.setGyroscopeCovariance(np.eye(3) * gyro**2)
    parameters.setAccelerometerCovariance(np.eye(3) * accel**2)
    parameters.setIntegrationCovariance(np.eye(3) * integration**2)
    return parameters


def contact_measurement(foot: int, point: Floats, *, touchdown: bool) -> Any:
    measurement = gtsam.ContactMeasurement()
    measurement.foot, measurement.bodyPoint, measurement.touchdown = foot, point, touchdown
    return measurement


def state_from_gtsam(rotation: Floats, columns: Floats, covariance: Floats) -> FilterState:
    """``columns`` (3, 2 + k) are position, velocity and feet; ``covariance`` (9 + 3k, 9 + 3k) is
    left-invariant.

    Biases are zero and known.
    """
    feet = columns.shape[1] - 2
    names = tuple(str(foot) for foot in range(feet))
    zero = np.zeros(3)
    blank = np.zeros((15 + 3 * feet, 15 + 3 * feet))
    state = FilterState(rotation, columns[:, 1], columns[:, 0], zero, zero, names, columns[:, 2:].T, blank)
    adjoint = right_from_left(state)
    return state._replace(covariance=adjoint @ covariance @ adjoint.T)


def right_from_left(state: FilterState) -> Floats:
    """The derivative of the invariant filter's error by GTSAM's: (15 + 3k, 9 + 3k)."""
    feet = len(state.feet)
    matrix = np.zeros((15 + 3 * feet, 9 + 3 * feet))
    matrix[0:3, 0:3] = state.rotation
    # Rows here, columns of GTSAM.
    places = [(3, 6, state.velocity), (6, 3, state.position)]
    places += [(15 + 3 * i, 9 + 3 * i, point) for i, point in enumerate(state.contacts)]
    for row, column, vector in places:
        matrix[row : row + 3, column : column + 3] = state.rotation
        matrix[row : row + 3, 0:3] = np.cross(vector, state.rotation, axisb=0, axisc=0)
    return matrix


def assert_same(state: FilterState, estimate: Any, covariance: Floats, tolerance: float) -> None:
    """``estimate`` is an ExtendedPose3 of GTSAM with as many feet, ``covariance`` its left-invariant one."""
    points = np.vstack((state.position, state.velocity, state.contacts)).T
    np.testing.assert_allclose(state.rotation, estimate.rotation().matrix(), atol=tolerance)
    np.testing.assert_allclose(points, estimate.xMatrix(), atol=tolerance)
    adjoint = right_from_left(state)
    np.testing.assert_allclose(state.covariance, adjoint @ covariance @ adjoint.T, atol=tolerance)
