"""Rotations as matrices: the exponential of a turn, its integrals, and cross products.

``[v]`` is the matrix of the cross product with v: ``[v] u = v x u``.
"""

from __future__ import annotations

import math

import numpy as np

from zstate.checks import Floats

SKEW = np.zeros((3, 9))
"""``(v @ SKEW).reshape(3, 3)`` is [v], the matrix of the cross product with v; also for rows of vectors."""
SKEW[0, 5], SKEW[0, 7] = -1.0, 1.0
SKEW[1, 2], SKEW[1, 6] = 1.0, -1.0
SKEW[2, 1], SKEW[2, 3] = -1.0, 1.0


IDENTITY = np.eye(3)


def skew(vector: Floats) -> Floats:
    """The matrix [v] of the cross product: ``skew(v) @ u = v x u``. (3, 3)"""
    return vector.dot(SKEW).reshape(3, 3)


def rotation_exp(vector: Floats) -> Floats:
    """The rotation matrix of a turn given as axis times angle [rad]: (3, 3)."""
    return gammas(vector)[0]


def gammas(vector: Floats) -> Floats:
    """Gamma_0, Gamma_1 and Gamma_2 of a turn [rad]: (3, 3, 3).

    Gamma_m = sum of [v]^n / (n + m)!: the exponential, its integral (the left Jacobian), and the integral of
    that (Hartley et al., appendix). With t = |v|^2 and c_m = sum of (-t)^n / (2n + m)!, Gamma_m is
    ``c_m + c_(m+1) [v] + c_(m+2) v v^T``, and c_m = 1/m! - t c_(m+2).
    """
    x, y, z = vector.tolist()
    t = x * x + y * y + z * z
    if t < 0.1:  # five terms are exact to 1e-15
        c3 = 1 / 6 - t * (1 / 120 - t * (1 / 5040 - t * (1 / 362880 - t / 39916800)))
        c4 = 1 / 24 - t * (1 / 720 - t * (1 / 40320 - t * (1 / 3628800 - t / 479001600)))
    else:
        angle = math.sqrt(t)
        c3 = (angle - math.sin(angle)) / (angle * t)
        c4 = (0.5 * t - 1.0 + math.cos(angle)) / (t * t)
    c1, c2 = 1.0 - t * c3, 0.5 - t * c4
    rows = list[float]()
    for one, skewed, squared in ((1.0 - t * c2, c1, c2), (c1, c2, c3), (c2, c3, c4)):
        sx, sy, sz = squared * x, squared * y, squared * z
        kx, ky, kz = skewed * x, skewed * y, skewed * z
        rows += (one + sx * x, sx * y - kz, sx * z + ky)
        rows += (sx * y + kz, one + sy * y, sy * z - kx)
        rows += (sx * z - ky, sy * z + kx, one + sz * z)
    return np.array(rows).reshape(3, 3, 3)
