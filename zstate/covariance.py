"""Covariances of poses: their check, and their way through products and inverses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from zstate import se3
from zstate.checks import Floats, real_numbers
from zstate.errors import InvalidInput


def carry_covariance(covariance: Floats, q: se3.Quaternion, arm: se3.Vector) -> Floats:
    """The covariance that an uncertain pose adds to a product of poses: (6, 6).

    The error of a pose of c in p is a displacement d [m] of c's origin, and a turn w [rad] about it, both in
    the axes of p: ``t + d`` and ``exp(w) R``. In ``a_from_b = a_from_p @ p_from_c @ c_from_b``, with the
    rotation q of a_from_p and ``arm`` from c's origin to b's in the axes of a, b turns by ``q w`` about c's
    origin, to first order: its own error is ``(q d - arm x q w, q w)``. So the covariance is J S J^T with

        J = [[Q, -[arm]x Q], [0, Q]],

    the adjoint of the rigid motion (Q, -arm). The error of p_from_c moves a against b as much as b against a,
    with the other sign, which a square does not show: where a path goes through the edge from c to p, q and
    arm are the same, those of a_from_p and from c's origin to b's. In particular the inverse c_from_p has
    the q of c_from_p, and the arm from c's origin to p's in the axes of c. Covariances of independent errors
    add. R. Smith, M. Self, P. Cheeseman, "Estimating Uncertain Spatial Relationships in Robotics" (1990);
    T. Barfoot, P. Furgale, "Associating Uncertainty With Three-Dimensional Poses" (2014), to second order
    in the errors, with the twist ``(d + t x w, w)`` of the same error.
    """
    turn = se3.to_matrix((0.0, 0.0, 0.0, *q))[:3, :3]
    x, y, z = arm
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = jacobian[3:, 3:] = turn
    jacobian[:3, 3:] = np.array(((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))) @ turn
    return jacobian @ covariance @ jacobian.T


def check_covariance(
    covariance: ArrayLike, what: str = "the covariance of a pose", size: int = 6
) -> list[float]:
    """The upper triangle of a covariance, (size, size): 21 numbers row by row of a pose.

    Raises InvalidInput unless it is finite, symmetric within 1e-6 of its largest number, and positive
    semidefinite.
    """
    matrix = real_numbers(covariance, what)
    if matrix.shape != (size, size):
        raise InvalidInput(f"{what} has shape ({size}, {size}); got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InvalidInput(f"{what} must be finite; leave it out if it is not known")
    tolerance = 1e-6 * float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > tolerance:
        row, column = np.unravel_index(np.abs(matrix - matrix.T).argmax(), (size, size))
        raise InvalidInput(
            f"{what} is symmetric; got {matrix[row, column]:g} in row {row}, column "
            f"{column}, and {matrix[column, row]:g} in row {column}, column {row}"
        )
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if smallest < -tolerance:
        raise InvalidInput(
            f"{what} has no negative eigenvalue; got {smallest:g}. Variances (the diagonal, in squares of "
            "units) are not negative, and limit the covariances in their row"
        )
    return matrix[np.triu_indices(size)].tolist()


def product_covariance(
    first: Floats | None, second: Floats | None, rotation: se3.Quaternion, arm: se3.Vector
) -> Floats:
    """The covariance of ``a_from_b @ b_from_c`` with those of both factors, None for an exact one.

    ``rotation`` is that of a_from_b, and ``arm`` the translation of b_from_c in the axes of a.
    """
    total = np.zeros((6, 6))
    if first is not None:
        total += carry_covariance(first, se3.IDENTITY[3:], arm)
    if second is not None:
        total += carry_covariance(second, rotation, (0.0, 0.0, 0.0))
    return total
