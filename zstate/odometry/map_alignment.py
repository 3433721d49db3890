"""Where the odometry is in a map, by positions that one point of the robot had in both: yaw and translation.

One position shows no yaw, and the way between two shows it the better the longer it is, in any direction,
also in reverse and in curves. The errors of a GPS receiver are not independent: they wander for tens of
seconds (atmosphere, multipath), so the mean of many fixes is hardly better than one. With C their covariance,
and map positions z and odometry positions q about their means, which C^-1 weighs,
S = sum (C^-1)_jk z_j q_k^T determines the yaw: its posterior is a von Mises distribution about
atan2(S_10 - S_01, S_00 + S_11) with the concentration hypot(S_10 - S_01, S_00 + S_11) (Mardia and Jupp,
"Directional Statistics", 2000, for the distribution).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from zstate.checks import Floats

_WHITE = 0.1
"""The part of the standard deviation of a fix that differs from one to the next. It keeps C regular."""
_SCALE = 0.1
"""By this part, a way by wheels may be too long or too short: that does not change the yaw."""


class Fixes(NamedTuple):
    """Positions of one point, each at the instant ``t`` [s], (N,): ``there`` in the map and ``here`` in odom
    [m], (N, 2), and the ``variances`` of the former in each axis [m^2], (N,)."""

    t: Floats
    there: Floats
    here: Floats
    variances: Floats


class MapAlignment(NamedTuple):
    """A point of odom is at ``there + R(yaw) (point - here)`` in the map, with ``here`` the mean of the way.

    ``yaw_variance`` [rad^2] is infinite if the way shows no yaw; ``variance`` [m^2] is that of ``there`` in
    each axis. Both errors are independent. ``misfit`` is the sum of squares of what is left between both
    ways, normalised: chi-square with ``freedom`` degrees of freedom, or less, as a part of the way is free.
    """

    yaw: float
    yaw_variance: float
    there: Floats
    here: Floats
    variance: float
    misfit: float
    freedom: int

    def place(self, point: Floats) -> Floats:
        """A point of odom, (2,), in the map."""
        return self.there + turn(self.yaw).dot(point - self.here)

    def covariance(self, point: Floats) -> Floats:
        """That of x, y [m] and yaw [rad] of the base at a point of odom, (3, 3)."""
        x, y = turn(self.yaw).dot(point - self.here).tolist()
        shift = np.array((-y, x, 1.0))
        return np.diag((self.variance, self.variance, 0.0)) + self.yaw_variance * np.outer(shift, shift)


def align_in_map(fixes: Fixes, correlated_s: float) -> MapAlignment:
    """The alignment by at least one fix, whose errors are correlated over ``correlated_s`` [s]."""
    t, there, here, variances = fixes
    sigmas = np.sqrt(variances)
    apart = np.exp(-np.abs(t[:, None] - t[None, :]) / correlated_s)
    covariance = np.outer(sigmas, sigmas) * apart
    covariance[np.diag_indices_from(covariance)] += _WHITE**2 * variances
    inverse = np.linalg.inv(covariance)
    ones = inverse.sum(axis=1)
    information = float(ones.sum())
    weights = ones / information
    mean_there, mean_here = weights @ there, weights @ here
    z, q = there - mean_there, here - mean_here
    s = z.T @ inverse @ q
    along, across = float(s[0, 0] + s[1, 1]), float(s[1, 0] - s[0, 1])
    concentration = math.hypot(along, across)
    yaw_variance = 1.0 / concentration if concentration > 0.0 else math.inf
    yaw = math.atan2(across, along)
    left: Floats = z - np.dot(q, turn(yaw).T)
    errors: Floats = covariance + _SCALE**2 * np.dot(q, q.T)
    misfit = float(np.einsum("ni,nm,mi", left, np.linalg.inv(errors), left))
    return MapAlignment(
        yaw, yaw_variance, mean_there, mean_here, 1.0 / information, misfit, max(2 * len(t) - 3, 0)
    )


def turn(yaw: float) -> Floats:
    """The rotation by ``yaw`` [rad] in the plane, (2, 2)."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array(((cosine, -sine), (sine, cosine)))
