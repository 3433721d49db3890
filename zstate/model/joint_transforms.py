"""Poses ``parent_from_child`` of all edges of a robot, by their closed forms (``joint_forms.py``)."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zstate.checks import QUATERNION_TOLERANCE, Floats
from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.model.joint_forms import KINDS, JointTransform, edge_forms
from zstate.model.robot import RobotModel
from zstate.se3 import IDENTITY

if TYPE_CHECKING or kernel == "c":
    from zstate import _kernel
if TYPE_CHECKING or kernel == "reference":
    from zstate.model.reference_transforms import edge_poses


class JointTransforms:
    """Poses ``parent_from_child`` of all edges of a robot, from one position vector.

    Immutable, so any thread may use it. Positions must be finite and of the right length (not checked).
    """

    def __init__(self, model: RobotModel) -> None:
        self.forms = edge_forms(model)
        self._floats = [form for form in self.forms if form.kind == "floating"]
        quaternions = [range(form.column + 3, form.column + 7) for form in self._floats]
        self._quaternions = np.array(quaternions, dtype=np.intp).reshape(-1, 4)
        self._write = _writer(model.position_count, self.forms)

    def poses(self, positions: Floats, out: Floats | None = None) -> Floats:
        """``parent_from_child`` of every edge, rows as ``forms``: x y z [m], qx qy qz qw.

        ``positions`` (..., nq) give (..., E, 7), written into ``out`` if passed. The sign of a
        quaternion is arbitrary. Raises InvalidInput for a floating joint without a unit quaternion.
        """
        if out is None:
            out = np.empty((*positions.shape[:-1], len(self.forms), 7))
        positions = self.normalised(positions)
        # The extension reads and writes plain memory only.
        plain = out if _is_plain(out) else np.empty(out.shape)
        self._write(np.ascontiguousarray(positions, dtype=np.float64), plain)
        if plain is not out:
            out[...] = plain
        return out

    @property
    def has_floats(self) -> bool:
        """Whether there are floating joints, whose quaternions need a check."""
        return bool(self._floats)

    def has_unit_quaternions(self, positions: Floats) -> NDArray[np.bool_]:
        """Whether ``normalised`` accepts the quaternions of each row (N, nq)."""
        off = np.abs(self._norms(positions) - 1.0).max(axis=(1, 2), initial=0.0)
        return np.asarray(off) <= QUATERNION_TOLERANCE

    def normalised(self, positions: Floats) -> Floats:
        """``positions`` with the quaternions of floating joints at unit length.

        Raises InvalidInput if a length is off by more than ``QUATERNION_TOLERANCE``.
        """
        if not self._floats:
            return positions
        norms = self._norms(positions)
        if not np.all(np.abs(norms - 1.0) <= QUATERNION_TOLERANCE):
            worst = int(np.abs(norms - 1.0).argmax())
            form = self._floats[worst % len(self._floats)]
            raise InvalidInput(
                f"the floating joint of {form.parent!r} -> {form.child!r} was given a quaternion of length "
                f"{norms.item(worst):.6g}; its last four numbers are qx qy qz qw of length 1"
            )
        unit = positions.copy()
        unit[..., self._quaternions] = positions[..., self._quaternions] / norms
        return unit

    def _norms(self, positions: Floats) -> Floats:
        """The lengths of the quaternions, (..., floating joints, 1)."""
        norms: Floats = np.sqrt(np.square(positions[..., self._quaternions]).sum(axis=-1, keepdims=True))
        return norms


@lru_cache(maxsize=16)
def shared_transforms(model: RobotModel) -> JointTransforms:
    """The table of ``model``; the robots of a fleet that have one model share it."""
    return JointTransforms(model)


def _is_plain(array: Floats) -> bool:
    return array.flags.c_contiguous and array.dtype == np.float64


def _writer(width: int, forms: tuple[JointTransform, ...]) -> Callable[[Floats, Floats], object]:
    """Writes the poses of all edges for positions: in the extension, or in numpy without it."""
    return _compiled(width, forms).poses if kernel == "c" else edge_poses(forms)


def _compiled(width: int, forms: tuple[JointTransform, ...]) -> _kernel.Edges:
    """The same formulas in the C extension."""
    edges = ((KINDS.index(form.kind), 0, form.column, False, form.numbers(IDENTITY)) for form in forms)
    return _kernel.Edges(width, tuple(edges))
