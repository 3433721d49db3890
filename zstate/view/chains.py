"""Chains: many poses multiplied at once, in few operations.

A view does this thirty times a second and sleeps in between, so that each operation of numpy finds its
code and data gone from the caches: their number counts, not the size of the arrays. As dual quaternions
``r + e d`` with ``d = t r / 2`` (Clifford 1873) poses multiply by one bilinear form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zstate.se3 import Quaternion, multiply

Duals = NDArray[np.float64]
"""(N, 8): the rotation's quaternion x y z w, then the dual part in the same order."""


def duals_of(poses: NDArray[np.float64]) -> Duals:
    """Poses (N, 7), x y z qx qy qz qw, as dual quaternions."""
    rotations = poses[:, 3:]
    return np.concatenate((rotations, 0.5 * _product(poses[:, :3], rotations, _VECTOR_FIRST)), axis=1)


def poses_of(duals: Duals) -> NDArray[np.float64]:
    """The poses (N, 7) of dual quaternions of length one."""
    rotations, dual = duals[:, :4], duals[:, 4:]
    return np.concatenate((2.0 * _product(dual, rotations, _VECTOR), rotations), axis=1)


def compose(a_from_b: Duals, b_from_c: Duals) -> Duals:
    """a_from_c, row by row; a single row goes with all of the other."""
    return _product(a_from_b, b_from_c, _DUAL)


def invert(a_from_b: Duals) -> Duals:
    """b_from_a."""
    return a_from_b * _CONJUGATE


def _product(first: NDArray[np.float64], second: NDArray[np.float64], form: NDArray[np.float64]) -> Duals:
    """``sum_ij form[i, j, k] first_i second_j`` of each row."""
    matrices = (first @ form.reshape(len(form), -1)).reshape(len(first), *form.shape[1:])
    return (second[:, None] @ matrices)[:, 0]


def _quaternion_form() -> NDArray[np.float64]:
    units: list[Quaternion] = [
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.0, 0.0, 0.0, 1.0),
    ]
    return np.array([[multiply(first, second) for second in units] for first in units])


def _dual_form(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    form = np.zeros((8, 8, 8))
    form[:4, :4, :4] = form[:4, 4:, 4:] = form[4:, :4, 4:] = quaternion
    return form


_FORM = _quaternion_form()
_DUAL = _dual_form(_FORM)
_CONJUGATE = np.array((-1.0, -1.0, -1.0, 1.0) * 2)
_VECTOR_FIRST = np.ascontiguousarray(_FORM[:3])
"""A vector times a quaternion."""
_VECTOR = np.ascontiguousarray((_FORM * _CONJUGATE[None, :4, None])[:, :, :3])
"""The vector part of a quaternion times the conjugate of another."""
